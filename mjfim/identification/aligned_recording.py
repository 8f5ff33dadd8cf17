"""Recordings against the experiment's sample grid: the control on it, the measured values at their own times.

Nothing measured is interpolated, which would colour its noise; it is the prediction that is read between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.errors import RecordingError, unknown
from mjfim.experiment.system import System
from mjfim.plant.outputs import outputs_by_state
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

ON_GRID = 0.01  # of a sample period: stamps that close to the grid are meant to be on it


@dataclass(frozen=True, eq=False)
class AlignedRecording:
    """A recording as the fit sees it.

    t: (M,) [s] from its first row;  y: (M, ny) in the order of the experiment's outputs, NaN where not measured
    ctrl: (N, nu) held over each sample of the grid, which covers all rows;  dt: of the grid [s]
    even: every stamp lies on the grid
    """

    name: str
    t: Array
    y: Array
    ctrl: Array
    dt: float
    even: bool

    def __post_init__(self) -> None:
        freeze(self, "t", "y", "ctrl")

    @cached_property
    def measured(self) -> np.ndarray:
        """(M, ny) True where there is a value."""
        return np.isfinite(self.y)

    @cached_property
    def seen(self) -> tuple[np.ndarray, ...]:
        """Rows with a value, of every output."""
        return tuple(np.flatnonzero(column) for column in self.measured.T)


def align(system: System, recording: Recording) -> AlignedRecording:
    """A recording on the experiment's grid. Raises RecordingError where time, control or columns do not fit."""
    names, where, dt = system.outputs.names, recording.name, system.dt
    if len(recording.t) < 3:
        raise RecordingError(
            f"{where}: too few rows ({len(recording.t)}); an identification needs at least 3"
        )
    t = recording.t - recording.t[0]
    if not (np.diff(t) > 0.0).all():  # also where one is NaN
        row = int(np.argmin(np.diff(t) > 0.0)) + 2
        raise RecordingError(f"{where}: column 't' does not increase in data row {row}")
    ctrl = recording.ctrl[: len(t) - 1]
    if ctrl.shape != (len(t) - 1, len(system.controls)):
        raise RecordingError(
            f"{where}: the control has shape {recording.ctrl.shape}, wanted {len(t) - 1} rows of {len(system.controls)}"
        )
    if not np.isfinite(ctrl).all():
        row = int(np.argmax(~np.isfinite(ctrl).all(axis=1)))
        raise RecordingError(
            f"{where}: the control in data row {row + 1} is NaN; only the last row may leave it out"
        )
    shared = [name for name in names if name in recording.outputs]
    if not shared:
        raise RecordingError(
            f"{where}: no measured column; {unknown('column', ', '.join(recording.outputs), names)}"
        )
    y = np.full((len(t), len(names)), np.nan)
    for name in shared:
        y[:, names.index(name)] = recording.y[:, recording.outputs.index(name)]
    place = np.rint(t / dt)
    even = bool(np.abs(t - place * dt).max() <= ON_GRID * dt)
    t = place * dt if even else t
    if not even or not np.array_equal(place, np.arange(len(t))):
        ctrl = held(t, ctrl, dt)
    return AlignedRecording(where, t, _continuous(system, ctrl, y), ctrl, dt, even)


def held(t: Array, ctrl: Array, dt: float) -> Array:
    """(N, nu) means over each sample period of a control: (M-1, nu) that is held from t_i to t_i+1; N dt >= t_M-1.

    Its integral, and so the impulse on the robot, is that of the log.
    """
    N = max(int(np.ceil(t[-1] / dt - ON_GRID)), 1)
    edges = np.arange(N + 1) * dt
    total = np.concatenate(
        [np.zeros((1, ctrl.shape[1])), np.cumsum(ctrl * np.diff(t)[:, None], axis=0)]
    )
    reach = np.append(t, max(edges[-1], t[-1]) + dt)
    total = np.concatenate([total, total[-1:] + ctrl[-1:] * (reach[-1] - t[-1])])
    at = np.column_stack([np.interp(edges, reach, column) for column in total.T])
    mean = np.diff(at, axis=0) / dt
    # where nothing changes within a sample, the value itself, free of the round-off of a long sum
    first = np.clip(np.searchsorted(t, edges[:-1] + 1e-9 * dt, side="right") - 1, 0, len(ctrl) - 1)
    last = np.clip(np.searchsorted(t, edges[1:] - 1e-9 * dt, side="left") - 1, 0, len(ctrl) - 1)
    return np.asarray(np.where((first == last)[:, None], ctrl[first], mean))


def _continuous(system: System, ctrl: Array, y: Array) -> Array:
    """Measured quaternions with the sign that follows from the model's start: q and -q are one orientation."""
    quaternions = _quaternions(system)
    if not quaternions:
        return y
    predicted, _ = system.plant.measure(system.parameters.guess[None], ctrl[:4])
    for at in quaternions:
        last = predicted[0, 0, at]
        for row in y:
            if np.isfinite(row[at]).all():
                row[at] *= 1.0 if last @ row[at] >= 0.0 else -1.0
                last = np.array(row[at])
    return y


def _quaternions(system: System) -> list[list[int]]:
    """Outputs that are the components of one quaternion, of a joint or of a sensor."""
    outputs, model = system.outputs.outputs, system.model
    kinds = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))
    first = [
        int(model.sensor_adr[i]) for i in range(model.nsensor) if int(model.sensor_type[i]) in kinds
    ]
    joints = [
        [i for i, o in enumerate(outputs) if o.state in range(q, q + 4)]
        for q, _ in system.space.quaternions
    ]
    sensors = [[i for i, o in enumerate(outputs) if o.sensor in range(a, a + 4)] for a in first]
    return [found for found in (*joints, *sensors) if len(found) == 4]


def measured_trajectory(system: System, recording: Recording) -> Trajectory | None:
    """The recorded motion as a trajectory, where every position was measured at most samples; else None.

    Gaps are bridged linearly; velocities are zero. For pictures, not for estimation.
    """
    shown, nq = outputs_by_state(system.model, system.outputs), system.model.nq
    names = [system.outputs.names[shown[q]] if q in shown else "" for q in range(nq)]
    if any(name not in recording.outputs for name in names):
        return None
    qpos = np.empty((len(recording.t), nq))
    for q, name in enumerate(names):
        column = recording.y[:, recording.outputs.index(name)]
        seen = np.isfinite(column)
        if not seen.any():
            return None
        qpos[:, q] = np.interp(recording.t, recording.t[seen], column[seen])
    for q, _ in system.space.quaternions:
        qpos[:, q : q + 4] /= np.maximum(
            np.linalg.norm(qpos[:, q : q + 4], axis=1, keepdims=True), 1e-12
        )
    n = len(qpos)
    return Trajectory(
        t=recording.t,
        qpos=qpos,
        qvel=np.zeros((n, system.model.nv)),
        act=np.zeros((n, system.model.na)),
        ctrl=recording.ctrl,
    )
