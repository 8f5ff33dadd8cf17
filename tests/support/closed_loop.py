"""A closed loop simulated by a plain loop over engine steps, one simulation and one law at a time.

It shares no code with `mjfim.plant.closed_loop`.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

import mjfim
from tests.support.paths import MODELS

ARM = MODELS / "two_joint_arm.xml"


@dataclass
class PlainLaw:
    """One law, with the names of the table `[controllers]`."""

    joint: str
    tick: int
    kp: float = 0.0
    kd: float = 0.0
    ki: float = 0.0
    integral: float = 0.0
    integral_limit: float = math.inf
    low: float = -math.inf
    high: float = math.inf
    slew: float = math.inf
    latency: float = 0.0
    time_constant: float = 0.0
    feedback_latency: float = 0.0
    velocity_time_constant: float = 0.0
    acceleration: float = math.inf
    jump: float = math.inf
    linear: bool = False
    difference: bool = False
    reference_difference: bool = False


def command(t: float, values: np.ndarray, dt: float, width: float) -> float:
    """Mean over [t, t + width] of a staircase that holds its first and last value for ever."""
    edges = np.arange(len(values) + 1) * dt
    integral = np.concatenate([[0.0], np.cumsum(values) * dt])

    def at(x: float) -> float:
        if x < 0.0:
            return values[0] * x
        if x > edges[-1]:
            return integral[-1] + values[-1] * (x - edges[-1])
        return np.interp(x, edges, integral)

    return (at(t + width) - at(t)) / width


def simulate(
    model: Any,
    laws: dict[int, PlainLaw],
    columns: dict[int, dict[str, np.ndarray]],
    dt: float,
    samples: int,
    start: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """(samples + 1, ns) states at the samples and (steps, nu) controls of all engine steps.

    laws: by the number of the actuator. columns: of each actuator, by quantity, or "ctrl".
    """
    h = model.opt.timestep
    substeps = round(dt / h)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = np.split(start, [model.nq, model.nq + model.nv])

    def measured(law: PlainLaw) -> tuple[float, float]:
        """Position and velocity of the joint of a law."""
        joint = data.joint(law.joint)
        return joint.qpos[0], joint.qvel[0]

    states, controls, running = [np.array(start)], [], {}
    for a, law in laws.items():
        running[a] = controls_of(law, columns[a], measured(law), dt, h)
        next(running[a])

    for step in range(samples * substeps):
        for a, signals in columns.items():
            if a not in laws:
                data.ctrl[a] = signals["ctrl"][step // substeps]
        for a, law in laws.items():
            if step % law.tick == 0:
                data.ctrl[a] = running[a].send((step * h, *measured(law)))
        controls.append(np.array(data.ctrl))
        mujoco.mj_step(model, data)
        if (step + 1) % substeps == 0:
            states.append(np.concatenate([data.qpos, data.qvel, data.act]))
    return np.array(states), np.array(controls)


def controls_of(
    law: PlainLaw, signals: dict[str, np.ndarray], start: tuple[float, float], dt: float, h: float
) -> Generator[float, tuple[float, float, float], None]:
    """The control of one law at each tick, to which time, position and velocity are sent."""
    T = law.tick * h
    width = dt if law.linear else min(T, dt)
    share = 1.0 - math.exp(-T / law.time_constant) if law.time_constant else 1.0
    rows = signals["reference"]
    # The control is that of commands late by whole ticks, and for the rest that of the tick before.
    by_ticks = math.isfinite(law.acceleration) or (dt + 1e-12 >= T and not law.linear)
    rest = (law.latency / T) % 1.0 if by_ticks else 0.0
    late = law.latency - rest * T

    def received(name: str) -> float:
        """Mean of a signal at this tick."""
        return command(t - late, signals[name], dt, width)

    # What is known before the first tick: the joint has always moved at its first velocity.
    q, v = start
    times, positions, velocities = [-1.0, 0.0], [q - v, q], [v, v]
    last_position = q - v * (T + law.feedback_latency)
    filtered_velocity, integral = v, law.integral
    filtered = profile = last_row = held = reference_velocity = last_goal = None
    speed, has_jumped, u = 0.0, False, 0.0

    while True:
        t, q, v = yield u
        r = received("reference")
        previous = r if filtered is None else filtered
        filtered = reference = previous + share * (r - previous)
        if math.isfinite(law.acceleration):
            before = reference if profile is None else profile
            # The latest row of the log that counts at this tick; a jump counts at two ticks.
            latest = math.ceil((t - late + width) / dt - 1e-9) - 1
            row = rows[min(max(latest, 0), len(rows) - 1)]
            jumps = last_row is not None and abs(row - last_row) > law.jump
            if jumps or has_jumped:
                profile, speed = reference, 0.0
            else:
                e, a = reference - before, law.acceleration
                # The fastest velocity from which a T per tick brakes to zero at the reference.
                braking = math.sqrt((a * T / 2) ** 2 + 2 * a * abs(e)) - a * T / 2
                target = math.copysign(min(braking, abs(e) / T), e)
                speed = min(max(target, speed - a * T), speed + a * T)
                profile = before + T * speed
            last_row, has_jumped = row, jumps
            reference = profile
        velocity = 0.0
        if law.reference_difference:
            velocity = 0.0 if last_goal is None else (reference - last_goal[0]) / T
        elif "reference_velocity" in signals:
            rv = received("reference_velocity")
            before = rv if reference_velocity is None else reference_velocity
            velocity = reference_velocity = before + share * (rv - before)
        added = received("feedforward") if "feedforward" in signals else 0.0
        latest = reference, velocity, added
        goals = [(1.0 - rest, *latest), (rest, *(last_goal or latest))]
        last_goal = latest

        if t > 0.0:
            times.append(t)
            positions.append(q)
            velocities.append(v)
        past = t - law.feedback_latency
        q = CubicHermiteSpline(times, positions, velocities)(past)
        v = np.interp(past, times, velocities)
        if law.difference:
            v, last_position = (q - last_position) / T, q
        if law.velocity_time_constant:
            decay = math.exp(-T / law.velocity_time_constant)
            v = filtered_velocity = v + decay * (filtered_velocity - v)

        sample = min(int(t / dt + 1e-9), len(rows) - 1)
        gain = signals["gain"][sample] if "gain" in signals else 1.0
        limit = law.integral_limit
        error = sum(part * goal for part, goal, *_ in goals) - q
        integral = min(max(integral + gain * law.ki * T * error, -limit), limit)

        u = 0.0
        for part, goal, velocity, added in goals:
            own = gain * (law.kp * (goal - q) + law.kd * (velocity - v)) + added + integral
            own = min(max(own, law.low), law.high)
            if held is not None:
                change = law.slew * T
                own = min(max(own, held - change), held + change)
            u += part * own
        if "enable" in signals and signals["enable"][sample] < 0.5:
            u, integral = 0.0, 0.0
        held = u


def arm_experiment(controllers: dict[str, Any], **tables: Any) -> mjfim.Experiment:
    """The two-joint arm with laws, at 500 Hz on an engine at 1 kHz."""
    values = {
        "model": str(ARM),
        "rate": 500.0,
        "initial": {"keyframe": "hanging"},
        "noise": {"state": 1e-4},
        "parameters": {"damping": "joint/shoulder:damping"},
        "controllers": controllers,
    }
    return mjfim.Experiment(**{**values, **tables})
