"""A design as a robot's controller plays it, at the controller's own rate: state, control, the gains about them (design.csv),
and the joint motion that a position-controlled robot follows (reference.csv). No interpolation: rows are engine steps.

Feedback: `u = ctrl + gain (planned - measured)`, the difference in the tangent space: rotations of ball and free joints as
rotation vectors in the measured body's frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.engine import Engine
from mjfim.errors import RecordingError, SimulationDiverged
from mjfim.limits import forwarded
from mjfim.models import actuator_names
from mjfim.sensing import components
from mjfim.setup import Setup
from mjfim.tables.files import read_table
from mjfim.trajectory import Array, Trajectory, freeze


@dataclass(frozen=True, eq=False)
class Playback:
    """A design at the controller's rate, M rows and the end.

    t: (M+1,) [s];  state: (M+1, nq+nv+na) planned;  ctrl: (M, nu) held over each row
    gain: (M, nu, nx) K, held over each sample of the design
    """

    t: Array
    state: Array
    ctrl: Array
    gain: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "state", "ctrl", "gain")

    @property
    def period(self) -> float:
        """Of the controller [s]."""
        return float(self.t[-1] - self.t[0]) / len(self.ctrl)


def playback_of(setup: Setup, trajectory: Trajectory, gain: Array) -> Playback:
    """A designed trajectory at `playback_rate`, simulated again at the design's theta. gain: (N, nu, nx)

    Raises SimulationDiverged where it cannot be simulated.
    """
    rows = setup.substeps // setup.playback_steps
    engine = Engine(setup.plant.engine.model, setup.playback_steps)
    held = np.repeat(trajectory.ctrl, rows, axis=0)
    out = engine.rollout([setup.plant.model(setup.theta)], trajectory.state[:1], held[None])
    if not out.finite[0]:
        raise SimulationDiverged("the designed control diverges when it is simulated again")
    t = np.arange(len(held) + 1, dtype=np.float64) * (setup.dt / rows)
    return Playback(t, out.states[0], held, np.repeat(gain, rows, axis=0))


def activation_names(setup: Setup) -> tuple[str, ...]:
    """na columns `act:<actuator>`, with `[i]` where an actuator has several activations."""
    model, names = setup.model, [""] * setup.space.na
    for i, name in enumerate(actuator_names(model)):
        first, count = int(model.actuator_actadr[i]), int(model.actuator_actnum[i])
        for k in range(count):
            names[first + k] = f"act:{name}" if count == 1 else f"act:{name}[{k}]"
    return tuple(names)


def state_names(setup: Setup) -> tuple[str, ...]:
    """Columns of the state: `qpos:<joint>`, `qvel:<joint>` (with parts for ball and free joints), `act:<actuator>`."""
    return (*(c.name for c in components(setup.model)), *activation_names(setup))


def tangent_names(setup: Setup) -> tuple[str, ...]:
    """nx components of a deviation from the plan: as the state's columns, but `.rx`, `.ry`, `.rz` [rad] for rotations."""
    velocities = [c.name for c in components(setup.model) if c.state >= setup.space.nq]
    positions = [name.replace("qvel:", "qpos:", 1) for name in velocities]
    return (*positions, *velocities, *activation_names(setup))


def gain_names(setup: Setup) -> tuple[str, ...]:
    """Columns of K, row by row: `gain:<actuator>:<component>`."""
    return tuple(f"gain:{control}:{name}" for control in setup.controls for name in tangent_names(setup))


def design_columns(playback: Playback, setup: Setup) -> dict[str, Array]:
    """design.csv: t, state, ctrl, gains; the end has neither control nor gains."""
    M = len(playback.ctrl)
    ctrl = np.concatenate([playback.ctrl, np.full((1, len(setup.controls)), np.nan)])
    flat = playback.gain.reshape(M, -1)
    gain = np.concatenate([flat, np.full((1, flat.shape[1]), np.nan)])
    return {
        "t": playback.t,
        **dict(zip(state_names(setup), playback.state.T, strict=True)),
        **{f"ctrl:{name}": ctrl[:, i] for i, name in enumerate(setup.controls)},
        **dict(zip(gain_names(setup), gain.T, strict=True)),
    }


def reference_columns(playback: Playback, setup: Setup) -> dict[str, Array]:
    """reference.csv: what a position-controlled robot follows, and the feed-forward that goes with it. No empty field.

    qpos, qvel: planned;  qacc:<joint>: MuJoCo's acceleration there under the row's control
    force:<joint>: what the actuators apply at the joint. In the last row the last control is held on.
    """
    held = np.concatenate([playback.ctrl, playback.ctrl[-1:]])
    qpos, qvel, act = setup.space.split(playback.state)
    rows = Trajectory(playback.t, qpos, qvel, act, held)
    qacc, force = np.empty_like(qvel), np.empty_like(qvel)
    for k, data in forwarded(setup.model_at(setup.theta), rows, range(len(held))):
        qacc[k], force[k] = data.qacc, data.qfrc_actuator
    names = [c.name for c in components(setup.model)]
    dofs = [name.removeprefix("qvel:") for name in names[setup.space.nq :]]
    return {
        "t": playback.t,
        **dict(zip(names, np.concatenate([qpos, qvel], axis=1).T, strict=True)),
        **{f"qacc:{name}": qacc[:, i] for i, name in enumerate(dofs)},
        **{f"force:{name}": force[:, i] for i, name in enumerate(dofs)},
    }


def read_playback(path: Path, setup: Setup) -> Playback:
    """design.csv as it was written, at whatever rate. Raises RecordingError naming file and column."""
    table, space = read_table(path), setup.space
    controls = tuple(f"ctrl:{name}" for name in setup.controls)
    wanted = ("t", *state_names(setup), *controls, *gain_names(setup))
    missing = next((name for name in wanted if name not in table), None)
    if missing is not None:
        raise RecordingError(f"{path}: column {missing!r} is missing; it is no design.csv of this model")
    t = table["t"]
    if len(t) < 3:
        raise RecordingError(f"{path}: too few rows ({len(t)}); a playback needs at least 3")
    period = (t[-1] - t[0]) / (len(t) - 1)
    timestep = float(setup.model.opt.timestep)
    steps = round(period / timestep)
    if steps < 1 or not np.abs(t - np.arange(len(t)) * steps * timestep).max() <= 1e-6 * timestep * len(t):
        raise RecordingError(
            f"{path}: column 't' does not go from 0 in equal periods of whole timesteps ({timestep:g} s)"
        )
    parts = []
    for names, rows in ((state_names(setup), None), (controls, -1), (gain_names(setup), -1)):
        values = np.column_stack([table[name][:rows] for name in names])
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise RecordingError(f"{path}: column {names[column]!r} has no number in data row {row + 1}")
        parts.append(values)
    state, ctrl, gain = parts
    return Playback(
        np.arange(len(t)) * (steps * timestep), state, ctrl, gain.reshape(len(ctrl), len(controls), space.nx)
    )
