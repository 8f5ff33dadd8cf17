"""A closed loop simulated by a plain loop over engine steps, one simulation and one law at a time.

It shares no code with `mjfim.plant.closed_loop`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline

import mjfim

ARM = Path(__file__).resolve().parents[2] / "models" / "two_joint_arm.xml"


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
            return float(values[0] * x)
        if x > edges[-1]:
            return float(integral[-1] + values[-1] * (x - edges[-1]))
        return float(np.interp(x, edges, integral))

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
    h = float(model.opt.timestep)
    substeps = round(dt / h)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = np.split(start, [model.nq, model.nq + model.nv])

    states, controls = [np.array(start)], []
    memory: dict[int, dict[str, Any]] = {}
    for a, law in laws.items():
        q = float(data.joint(law.joint).qpos[0])
        v = float(data.joint(law.joint).qvel[0])
        memory[a] = {"t": [-1.0, 0.0], "q": [q - v, q], "v": [v, v]}
        memory[a] |= {"held": None, "integral": law.integral, "filtered": None}
        memory[a] |= {"profile": None}
        memory[a] |= {"last": q - v * (law.tick * h + law.feedback_latency), "vf": v, "r": None}

    for step in range(samples * substeps):
        for a, signals in columns.items():
            if a not in laws:
                data.ctrl[a] = signals["ctrl"][step // substeps]
        for a, law in laws.items():
            if step % law.tick == 0:
                q, v = (
                    float(x[0]) for x in (data.joint(law.joint).qpos, data.joint(law.joint).qvel)
                )
                data.ctrl[a] = evaluate(law, memory[a], columns[a], step * h, (q, v), dt, h)
        controls.append(np.array(data.ctrl))
        mujoco.mj_step(model, data)
        if (step + 1) % substeps == 0:
            states.append(np.concatenate([data.qpos, data.qvel, data.act]))
    return np.array(states), np.array(controls)


def evaluate(
    law: PlainLaw,
    memory: dict[str, Any],
    signals: dict[str, np.ndarray],
    t: float,
    state: tuple[float, float],
    dt: float,
    h: float,
) -> float:
    """Control of one law at one tick."""
    T = law.tick * h
    width = dt if law.linear else min(T, dt)
    share = 1.0 - math.exp(-T / law.time_constant) if law.time_constant else 1.0

    r = command(t - law.latency, signals["reference"], dt, width)
    previous = r if memory["filtered"] is None else memory["filtered"]
    filtered = previous + share * (r - previous)
    memory["filtered"] = filtered
    if math.isfinite(law.acceleration):
        p, s = memory["profile"] or (filtered, 0.0)
        # The latest row of the log that counts at this tick; a jump counts at two ticks.
        rows = signals["reference"]
        latest = math.ceil((t - law.latency + width) / dt - 1e-9) - 1
        row = float(rows[min(max(latest, 0), len(rows) - 1)])
        has_jumped = abs(row - memory.get("row", row)) > law.jump
        is_jump = has_jumped or memory.get("jumped", False)
        memory["row"], memory["jumped"] = row, has_jumped
        if is_jump:
            p, s = filtered, 0.0
        else:
            e, a = filtered - p, law.acceleration
            # The fastest velocity from which a T per tick brakes to zero at the reference.
            braking = math.sqrt((a * T / 2) ** 2 + 2 * a * abs(e)) - a * T / 2
            target = math.copysign(min(braking, abs(e) / T), e)
            s = min(max(target, s - a * T), s + a * T)
            p += T * s
        previous = p if memory["profile"] is None else memory["profile"][0]
        memory["profile"], filtered = (p, s), p
    velocity = 0.0
    if law.reference_difference:
        velocity = (filtered - previous) / T
    elif "reference_velocity" in signals:
        rv = command(t - law.latency, signals["reference_velocity"], dt, width)
        before = rv if memory["r"] is None else memory["r"]
        velocity = memory["r"] = before + share * (rv - before)

    q, v = state
    if t > 0.0:
        for key, value in (("t", t), ("q", q), ("v", v)):
            memory[key].append(value)
    past = t - law.feedback_latency
    q = float(CubicHermiteSpline(memory["t"], memory["q"], memory["v"])(past))
    v = float(np.interp(past, memory["t"], memory["v"]))
    if law.difference:
        v, memory["last"] = (q - memory["last"]) / T, q
    if law.velocity_time_constant:
        memory["vf"] += (1.0 - math.exp(-T / law.velocity_time_constant)) * (v - memory["vf"])
        v = memory["vf"]

    sample = min(int(t / dt + 1e-9), len(signals["reference"]) - 1)
    gain = float(signals["gain"][sample]) if "gain" in signals else 1.0
    step = gain * law.ki * T * (filtered - q)
    limit = law.integral_limit
    memory["integral"] = min(max(memory["integral"] + step, -limit), limit)

    u = gain * (law.kp * (filtered - q) + law.kd * (velocity - v)) + memory["integral"]
    if "feedforward" in signals:
        u += command(t - law.latency, signals["feedforward"], dt, width)
    u = min(max(u, law.low), law.high)
    if memory["held"] is not None:
        change = law.slew * T
        u = min(max(u, memory["held"] - change), memory["held"] + change)
    if "enable" in signals and signals["enable"][sample] < 0.5:
        u, memory["integral"] = 0.0, 0.0
    memory["held"] = u
    return float(u)


def arm_experiment(controllers: dict[str, Any], **tables: Any) -> mjfim.Experiment:
    """The two-joint arm with laws, at 500 Hz on an engine at 1 kHz."""
    values: dict[str, Any] = {
        "model": str(ARM),
        "rate": 500.0,
        "initial": {"keyframe": "hanging"},
        "noise": {"state": 1e-4},
        "parameters": {"damping": {"target": "joint/shoulder:damping"}},
        "controllers": controllers,
    }
    return mjfim.Experiment(**{**values, **tables})
