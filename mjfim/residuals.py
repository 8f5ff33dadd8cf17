"""Recordings against the model: aligned on the sample grid, their whitened residuals and the Jacobian of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mjfim.errors import RecordingError, SimulationDiverged, unknown
from mjfim.identifiability import COARSER, Null
from mjfim.plant import SENSITIVITY_STEP
from mjfim.sensing import components
from mjfim.setup import Setup
from mjfim.trajectory import Array, Recording, Trajectory


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of all recordings, then prior rows, then pins, and their Jacobian. r: (n,), J: (n, p)."""

    r: Array
    J: Array


class Fit:
    """Residuals of an experiment against recordings, as functions of the unknowns. Evaluates each of them once.

    The unknowns are theta, whose start deviations are those of the first recording, then the start deviations of every
    further recording.
    data_only: leave priors and bounds out
    """

    def __init__(self, setup: Setup, recordings: Sequence[Recording], data_only: bool = False) -> None:
        self.setup = setup
        self.data_only = data_only
        self.recordings = [aligned(setup, r) for r in recordings]
        if not self.recordings:
            raise RecordingError("identify needs at least one recording")
        self.masks = [_used(r) for r in self.recordings]
        if not any(mask.any() for mask in self.masks):
            raise RecordingError("the recordings hold no measured value after t = 0")
        p = setup.parameters
        self.starts = np.flatnonzero(p.start(setup.space.nx).any(axis=0))
        self.pins = np.zeros((0, len(p)))
        self.pinned_at = np.array(p.guess)
        self._key: bytes = b""
        self._value: Residuals | None = None

    def sensed(self, theta: Array) -> list[tuple[Array, Array]]:
        """Whitened rows of G: (n, p) along each recording at theta: (p,), and their change with a longer difference step.

        Raises SimulationDiverged.
        """
        plant, noise, found = self.setup.plant, self.setup.noise, []
        for recording, mask in zip(self.recordings, self.masks, strict=True):
            steps = (SENSITIVITY_STEP, COARSER * SENSITIVITY_STEP)
            fine, coarse = (plant.predict(theta, recording.ctrl, step) for step in steps)
            if fine is None:
                raise SimulationDiverged(f"{recording.name}: the simulation diverges under its control")
            error = np.zeros_like(fine[1]) if coarse is None else coarse[1] - fine[1]
            found.append((noise.whiten_present(fine[1], mask), noise.whiten_present(error, mask)))
        return found

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(sum(mask.sum() for mask in self.masks))

    def pin(self, theta0: Array, null: Null) -> None:
        """Hold what no recording shows at its start, to one size of each parameter. null: of all p parameters"""
        size = self.setup.parameters.step
        self.pins = np.linalg.qr(null.directions / size[:, None])[0].T / size
        self.pinned_at, self._key = np.array(theta0), b""

    def whole(self, theta: Array) -> Array:
        """Unknowns from theta: (p,), every recording starting as the first."""
        return np.concatenate([theta, np.tile(theta[self.starts], len(self.recordings) - 1)])

    def of(self, unknowns: Array, recording: int) -> Array:
        """(p,) theta of one recording."""
        theta, further = np.array(unknowns[: len(self.setup.parameters)]), unknowns[len(self.setup.parameters) :]
        if recording and len(self.starts):
            theta[self.starts] = further.reshape(-1, len(self.starts))[recording - 1]
        return theta

    def columns(self, recording: int) -> np.ndarray:
        """(p,) places of one recording's theta among the unknowns."""
        places = np.arange(len(self.setup.parameters))
        if recording:
            places[self.starts] = len(places) + (recording - 1) * len(self.starts) + np.arange(len(self.starts))
        return places

    def at(self, theta: Array) -> Residuals | None:
        """Residuals and Jacobian at the unknowns; None where the simulation diverges."""
        key = np.asarray(theta).tobytes()
        if key != self._key:
            self._key, self._value = key, self._evaluate(np.asarray(theta))
        return self._value

    def _evaluate(self, theta: Array) -> Residuals | None:
        noise, p = self.setup.noise, self.setup.parameters
        rows, slopes = [], []
        for i, (recording, mask) in enumerate(zip(self.recordings, self.masks, strict=True)):
            predicted = self.setup.plant.predict(self.of(theta, i), recording.ctrl)
            if predicted is None:
                return None
            y, G = predicted
            rows.append(noise.whiten_present(np.where(mask, y - recording.y, 0.0), mask))
            own = noise.whiten_present(G, mask)
            slopes.append(np.zeros((len(own), len(theta))))
            slopes[-1][:, self.columns(i)] = own
        weight = self.whole(np.sqrt(np.diag(p.prior_information)) * (not self.data_only))
        rows.append((weight * (theta - self.whole(p.guess)))[weight > 0])
        slopes.append(np.diag(weight)[weight > 0])
        own = np.zeros((len(self.pins), len(theta)))
        own[:, : len(p)] = self.pins
        rows.append(self.pins @ (theta[: len(p)] - self.pinned_at))
        slopes.append(own)
        return Residuals(np.concatenate(rows), np.concatenate(slopes))


def aligned(setup: Setup, recording: Recording) -> Recording:
    """The recording on the experiment's sample grid and in the order of its outputs (absent ones NaN).

    Raises RecordingError where time, control or columns do not fit.
    """
    names, where = setup.outputs.names, recording.name
    t = recording.t - recording.t[0]
    if len(t) < 3:
        raise RecordingError(f"{where}: too few rows ({len(t)}); an identification needs at least 3")
    if np.abs(t - np.arange(len(t)) * setup.dt).max() > 0.01 * setup.dt:
        raise RecordingError(f"{where}: column 't' is not the experiment's grid of {setup.experiment.rate:g} Hz")
    ctrl = recording.ctrl[: len(t) - 1]
    if not np.isfinite(ctrl).all():
        row = int(np.argmax(~np.isfinite(ctrl).all(axis=1)))
        raise RecordingError(f"{where}: the control in data row {row + 1} is NaN; only the last row may leave it out")
    shared = [name for name in names if name in recording.outputs]
    if not shared:
        raise RecordingError(f"{where}: no measured column; {unknown('column', ', '.join(recording.outputs), names)}")
    y = np.full((len(t), len(names)), np.nan)
    for name in shared:
        y[:, names.index(name)] = recording.y[:, recording.outputs.index(name)]
    return Recording(t, ctrl, _continuous(setup, ctrl, y), names, where)


def _continuous(setup: Setup, ctrl: Array, y: Array) -> Array:
    """Measured quaternions with the sign that follows from the model's start: q and -q are one orientation."""
    quaternions = _quaternions(setup)
    if not quaternions:
        return y
    predicted, _ = setup.plant.measure(setup.parameters.guess[None], ctrl[:4])
    for at in quaternions:
        last = predicted[0, 0, at]
        for row in y:
            if np.isfinite(row[at]).all():
                row[at] *= 1.0 if last @ row[at] >= 0.0 else -1.0
                last = np.array(row[at])
    return y


def _quaternions(setup: Setup) -> list[list[int]]:
    """Outputs that are the components of one quaternion, of a joint or of a sensor."""
    outputs, model = setup.outputs.outputs, setup.model
    kinds = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))
    first = [int(model.sensor_adr[i]) for i in range(model.nsensor) if int(model.sensor_type[i]) in kinds]
    joints = [[i for i, o in enumerate(outputs) if o.state in range(q, q + 4)] for q, _ in setup.space.quaternions]
    sensors = [[i for i, o in enumerate(outputs) if o.sensor in range(a, a + 4)] for a in first]
    return [found for found in (*joints, *sensors) if found]


def _used(recording: Recording) -> np.ndarray:
    """Measured values after the known start, (N+1, ny)."""
    mask = np.isfinite(recording.y)
    mask[0] = False
    return mask


def measured_trajectory(setup: Setup, recording: Recording) -> Trajectory | None:
    """The recorded motion as a trajectory, where every position was measured at most samples; else None.

    Gaps are bridged linearly; unmeasured velocities are zero. For pictures, not for estimation.
    """
    positions = [c for c in components(setup.model) if c.state < setup.model.nq]
    if any(c.name not in recording.outputs for c in positions):
        return None
    qpos = np.empty((len(recording.t), setup.model.nq))
    for component in positions:
        column = recording.y[:, recording.outputs.index(component.name)]
        seen = np.isfinite(column)
        if not seen.any():
            return None
        qpos[:, component.state] = np.interp(recording.t, recording.t[seen], column[seen])
    for q, _ in setup.space.quaternions:
        qpos[:, q : q + 4] /= np.maximum(np.linalg.norm(qpos[:, q : q + 4], axis=1, keepdims=True), 1e-12)
    n = len(qpos)
    return Trajectory(recording.t, qpos, np.zeros((n, setup.model.nv)), np.zeros((n, setup.model.na)), recording.ctrl)
