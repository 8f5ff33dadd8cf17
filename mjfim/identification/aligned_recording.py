"""Recordings aligned with the sample grid of an experiment.

The control is resampled to the grid. Measured values keep their times: they are not interpolated,
because that would colour their noise. Predictions are interpolated instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import mujoco
import numpy as np

from mjfim.arrays import Array, freeze, record
from mjfim.errors import RecordingError, listed, unknown
from mjfim.experiment.system import System
from mjfim.model.control_laws import MEASURED_SUMS, ControlLaw
from mjfim.model.variants import STATED
from mjfim.plant.outputs import outputs_by_state
from mjfim.plant.running_law import ON
from mjfim.records.trajectory import Recording, Trajectory


def inputs_of_laws(system: System, t: Array, rows: Array, held: Array, y: Array) -> Array:
    """Inputs of a simulation with control laws.

    Args:
        system: The system, with laws.
        t: (M,) times of the rows, from 0 [s].
        rows: (M-1, w) columns of the log from each row to the next one.
        held: (N, w) means of these columns over the samples of the grid.
        y: (M, ny) measured values in the order of the outputs.

    Returns:
        (N, w + further) inputs: held columns, or points of those that are interpolated, and for
        every law with an integral the columns `MEASURED_SUMS`.
    """
    assert system.laws is not None
    inputs = np.array(held)
    samples = np.arange(len(held)) * system.dt

    # Beyond the last row with a command, this command is held.
    for column in np.flatnonzero(~system.laws.held):
        inputs[:, column] = np.interp(samples, t[:-1], rows[:, column])

    sums = [_measured_sums(system, law, t, inputs, y) for law in system.laws.integrating]
    return np.concatenate([inputs, *sums], axis=1)


def _measured_sums(system: System, law: ControlLaw, t: Array, inputs: Array, y: Array) -> Array:
    """(N, 4) `MEASURED_SUMS` at the begin of every sample, before its own evaluation of the law.

    They are zero, and the integral is that of the begin of the recording, where the position is not
    measured.
    """
    N = len(inputs)
    unknown = np.zeros((N, len(MEASURED_SUMS)))
    unknown[:, -1] = 1.0
    output = outputs_by_state(system.model, system.outputs).get(law.q)
    position = np.full(len(y), np.nan) if output is None else y[:, output]
    measured = np.isfinite(position)
    if not measured.any():
        return unknown

    # Errors at all evaluations of the law in the recording.
    substeps, timestep = system.grid.substeps, float(system.model.opt.timestep)
    steps = np.arange(0, N * substeps, law.tick)
    sample = steps // substeps
    q = np.interp(steps * timestep, t[measured], position[measured])
    reference = inputs[sample, law.columns["reference"]]
    if law.interpolated:
        points = np.arange(N) * substeps
        reference = np.interp(steps, points, inputs[:, law.columns["reference"]])
    errors = law.tick * timestep * (reference - q)
    if "gain" in law.columns:
        errors = errors * inputs[sample, law.columns["gain"]]

    # The sum begins anew at every evaluation at which the law is off.
    total = np.concatenate([[0.0], np.cumsum(errors)])
    begun = np.zeros(len(steps) + 1, dtype=np.intp)
    if "enable" in law.columns:
        off = inputs[sample, law.columns["enable"]] < ON
        begun[1:] = np.maximum.accumulate(np.where(off, np.arange(1, len(steps) + 1), 0))

    # Number of evaluations before each sample.
    count = -(-(np.arange(N) * substeps) // law.tick)
    since = begun[count]
    place = np.minimum(since, len(steps) - 1)
    return np.column_stack([total[count] - total[since], reference[place], q[place], since == 0])


# Largest distance from the grid [sample periods] at which a time stamp counts as lying on it.
GRID_TOLERANCE = 0.01

# Edges of samples are moved by this time [sample periods] before they are compared with time
# stamps, so that round-off does not decide.
EDGE_TOLERANCE = 1e-9

# Smallest number of rows of a recording.
MIN_ROWS = 3

# Number of samples that are simulated to find the sign of a quaternion at the first row.
SAMPLES_FOR_SIGN = 4

# Smallest norm of an interpolated quaternion in a denominator.
SMALLEST_NORM = 1e-12


@record
class AlignedRecording:
    """A recording on the sample grid of an experiment.

    Attributes:
        name: Name of the recording.
        t: (M,) times of the rows since the first one [s].
        y: (M, ny) measured values in the order of the experiment's outputs [y-unit]; NaN where not
            measured.
        ctrl: (N, nu) control held over each sample of the grid, which covers all rows [u-unit], or
            what control laws read (`mjfim.model.control_laws.ControlLaws`).
        dt: Sample period of the grid [s].
        on_grid: True where every time stamp lies on the grid.
    """

    name: str
    t: Array
    y: Array
    ctrl: Array
    dt: float
    on_grid: bool

    def __post_init__(self) -> None:
        freeze(self, "t", "y", "ctrl")

    @property
    def size(self) -> int:
        """Memory that the recording takes [bytes]."""
        return self.t.nbytes + self.y.nbytes + self.ctrl.nbytes

    def first_rows(self, count: int) -> AlignedRecording:
        """The first `count` rows, with all controls; a shorter recording is unchanged."""
        return replace(self, t=self.t[:count], y=self.y[:count])

    @cached_property
    def measured(self) -> np.ndarray:
        """(M, ny) True where there is a measured value."""
        return np.isfinite(self.y)

    def measured_rows_near(self, output: int, row: int, count: int) -> np.ndarray:
        """Rows near a place that have a measured value of an output.

        Args:
            output: Index of the output.
            row: The place: rows before it, and this row and those after it.
            count: Largest number of rows on either side.

        Returns:
            (n,) ascending indices of rows.
        """
        column = self.measured[:, output]
        reach = count
        while True:
            first, last = max(row - reach, 0), min(row + reach, len(column))
            rows = first + np.flatnonzero(column[first:last])
            middle = int(np.searchsorted(rows, row))

            # The search goes on where values are missing.
            has_before = middle >= count or first == 0
            has_after = len(rows) - middle >= count or last == len(column)
            if has_before and has_after:
                return rows[max(middle - count, 0) : middle + count]
            reach *= 4


def on_grid_of(system: System, recordings: Sequence[Recording]) -> System:
    """A system whose samples are so short that rows of recordings lie on their edges.

    A control that changes inside a sample acts on the robot when it changes, not as a mean over
    the sample. So samples are shortened down to single engine steps, which cannot be divided.

    Args:
        system: System as the experiment states it.
        recordings: Recordings in SI units.

    Returns:
        The system with the longest such samples, at most those that the experiment states; with
        samples of one engine step where rows lie inside engine steps.
    """
    stated = system.grid.substeps
    timestep = system.dt / stated
    times = [recording.t - recording.t[0] for recording in recordings if len(recording.t)]
    if system.variant != STATED or all(_lie_on_grid(t, system.dt) for t in times):
        return system

    # Engine steps after which there are rows; their common divisors are possible samples.
    substeps = 1
    if all(_lie_on_grid(t, timestep) for t in times):
        steps = np.concatenate([np.rint(t / timestep).astype(np.int64) for t in times])
        common = int(np.gcd.reduce(steps))
        substeps = max(k for k in range(1, stated + 1) if common % k == 0)
    return system.with_substeps(substeps)


def _lie_on_grid(t: Array, dt: float) -> bool:
    """Whether all times t: (M,) [s] are multiples of the period dt [s].

    False for times that are missing, which `align` refuses.
    """
    return bool(np.abs(t - np.rint(t / dt) * dt).max() <= GRID_TOLERANCE * dt)


def align(system: System, recording: Recording) -> AlignedRecording:
    """Align a recording with the sample grid of a system.

    Args:
        system: System that defines the grid, the controls and the outputs.
        recording: Recording in SI units.

    Returns:
        The recording on the grid.

    Raises:
        RecordingError: Time, control or columns of the recording do not fit the experiment.
    """
    dt = system.dt
    t = _times(recording)
    rows = _control(system, recording)
    names = system.outputs.names
    if not set(names) & set(recording.outputs):
        raise RecordingError(
            f"{recording.name}: no measured column; "
            f"{unknown('column', listed(recording.outputs), names)}"
        )

    # An array in the order of the outputs is shared.
    y = recording.y if recording.outputs == tuple(names) else _in_order(system, recording)

    # Time stamps that nearly lie on the grid are moved onto it.
    sample = np.rint(t / dt)
    on_grid = _lie_on_grid(t, dt)
    if on_grid:
        t = sample * dt

    # The control needs no resampling where there is one row per sample.
    ctrl = rows
    if not on_grid or not np.array_equal(sample, np.arange(len(t))):
        ctrl = resample_control(t, rows, dt)
    if system.laws is not None:
        ctrl = inputs_of_laws(system, t, rows, ctrl, y)

    return AlignedRecording(
        name=recording.name,
        t=t,
        y=_with_continuous_quaternions(system, ctrl, y),
        ctrl=ctrl,
        dt=dt,
        on_grid=on_grid,
    )


def _times(recording: Recording) -> Array:
    """(M,) times since the first row [s].

    Raises RecordingError for too few rows or times that do not increase.
    """
    count = len(recording.t)
    if count < MIN_ROWS:
        raise RecordingError(
            f"{recording.name}: too few rows ({count}); an identification needs at least {MIN_ROWS}"
        )

    # A comparison with NaN is False, so that missing times are found as well.
    t = recording.t - recording.t[0]
    increases = np.diff(t) > 0.0
    if not increases.all():
        row = int(np.argmin(increases)) + 2
        raise RecordingError(f"{recording.name}: column 't' does not increase in data row {row}")

    return np.asarray(t)


def _control(system: System, recording: Recording) -> Array:
    """(M-1, nu) control from each row to the next one.

    Raises RecordingError where values are missing.
    """
    rows = len(recording.t) - 1
    ctrl = recording.ctrl[:rows]
    if ctrl.shape != (rows, len(system.inputs)):
        raise RecordingError(
            f"{recording.name}: the control has shape {recording.ctrl.shape}; "
            f"expected {rows} rows of {len(system.inputs)} values"
        )

    finite = np.isfinite(ctrl).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite)) + 1
        raise RecordingError(
            f"{recording.name}: the control in data row {row} is NaN; only the last row may omit it"
        )
    return np.asarray(ctrl)


def _in_order(system: System, recording: Recording) -> Array:
    """(M, ny) measured values in the order of the outputs, NaN for those without a column."""
    names = system.outputs.names
    y = np.full((len(recording.t), len(names)), np.nan)
    for name, column in zip(recording.outputs, recording.y.T, strict=True):
        if name in names:
            y[:, names.index(name)] = column
    return y


def changes_within_samples(t: Array, ctrl: Array, dt: float) -> float:
    """Share of the changes of a control that lie inside a sample of the grid.

    The control of such a sample is replaced by its mean, so that the change acts earlier or later
    than it did on the robot.

    Args:
        t: (M,) times of the rows [s].
        ctrl: (M-1, nu) control that is held from each row to the next one [u-unit].
        dt: Sample period of the grid [s].

    Returns:
        The share, 0 for a control that never changes.
    """
    changed = np.any(np.diff(ctrl, axis=0) != 0.0, axis=1)
    if not changed.any():
        return 0.0

    place = (t[1:-1][changed] - t[0]) / dt
    return float(np.mean(np.abs(place - np.rint(place)) > GRID_TOLERANCE))


def resample_control(t: Array, ctrl: Array, dt: float) -> Array:
    """Mean of a held control over each sample period.

    The integral of the control is that of the recording, and so is the impulse on the robot.

    Args:
        t: (M,) times of the rows, from 0 [s].
        ctrl: (M-1, nu) control that is held from each row to the next one [u-unit].
        dt: Sample period [s].

    Returns:
        (N, nu) means [u-unit], with `N dt >= t[-1]`.
    """
    N = max(int(np.ceil(t[-1] / dt - GRID_TOLERANCE)), 1)
    edges = np.arange(N + 1) * dt

    # Integral of the control at every row; the last control is held beyond the last edge.
    extended_t = np.append(t, max(edges[-1], t[-1]) + dt)
    held = np.concatenate([ctrl, ctrl[-1:]])
    integral = np.cumsum(held * np.diff(extended_t)[:, None], axis=0)
    integral = np.concatenate([np.zeros((1, ctrl.shape[1])), integral])

    # Means over the samples are differences of the integral at their edges.
    at_edges = np.column_stack([np.interp(edges, extended_t, column) for column in integral.T])
    mean = np.diff(at_edges, axis=0) / dt

    # Where the control does not change within a sample, its value is taken directly, because the
    # difference of two long sums has round-off.
    margin = EDGE_TOLERANCE * dt
    first = np.searchsorted(t, edges[:-1] + margin, side="right") - 1
    last = np.searchsorted(t, edges[1:] - margin, side="left") - 1
    first, last = np.clip([first, last], 0, len(ctrl) - 1)
    return np.where((first == last)[:, None], ctrl[first], mean)


def _with_continuous_quaternions(system: System, ctrl: Array, y: Array) -> Array:
    """(M, ny) outputs in which the signs of measured quaternions are continuous.

    The quaternions q and -q describe one orientation. The first sign is that of the model at the
    guess. The array y: (M, ny) is not changed.
    """
    quaternions = _quaternion_outputs(system)
    if not quaternions:
        return y

    y = np.array(y)
    guess = system.parameters.guess[None]
    predicted, _ = system.plant.measure(guess, ctrl[:SAMPLES_FOR_SIGN])

    for columns in quaternions:
        previous = predicted[0, 0, columns]
        for row in y:
            if not np.isfinite(row[columns]).all():
                continue
            if not previous @ row[columns] >= 0.0:
                row[columns] *= -1.0
            previous = np.array(row[columns])
    return y


def _quaternion_outputs(system: System) -> list[list[int]]:
    """Indices of the four outputs of every quaternion that is measured completely.

    Quaternions are positions of joints or values of sensors.
    """
    outputs = system.outputs.outputs
    model = system.model
    kinds = (int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT))

    states = [q for q, _ in system.space.quaternions]
    sensors = model.sensor_adr[np.isin(model.sensor_type, kinds)].tolist()
    found = [[i for i, each in enumerate(outputs) if each.state in range(q, q + 4)] for q in states]
    found += [
        [i for i, each in enumerate(outputs) if each.sensor in range(first, first + 4)]
        for first in sensors
    ]
    return [columns for columns in found if len(columns) == 4]


def measured_trajectory(
    system: System, recording: Recording, end: float = np.inf
) -> Trajectory | None:
    """The recorded motion as a trajectory, for animations.

    Missing positions are interpolated linearly. Velocities that were not measured are NaN, and so
    are controls that control laws have computed.

    Args:
        system: System that was recorded.
        recording: Recording in SI units.
        end: Time since the first row at which the trajectory ends, if the recording is longer [s].

    Returns:
        The trajectory; None where not every position was measured.
    """
    model = system.model
    measured = outputs_by_state(model, system.outputs)
    last = end + GRID_TOLERANCE * system.dt
    rows = int(np.searchsorted(recording.t - recording.t[0], last, side="right"))
    recording = recording.first_rows(max(rows, 2))

    # Joints that physical terms have added show a robot that is not deflected.
    y = _in_order(system, recording)
    qpos = np.tile(model.qpos0, (len(recording.t), 1))
    layout = system.source.layout
    for q in range(model.nq) if layout is None else layout.qpos.tolist():
        column = y[:, measured[q]] if q in measured else np.full(len(y), np.nan)
        finite = np.isfinite(column)
        if not finite.any():
            return None
        qpos[:, q] = np.interp(recording.t, recording.t[finite], column[finite])

    # Interpolated quaternions are scaled to unit length.
    for q, _ in system.space.quaternions:
        norms = np.linalg.norm(qpos[:, q : q + 4], axis=1, keepdims=True)
        qpos[:, q : q + 4] /= np.maximum(norms, SMALLEST_NORM)

    known = [dof for dof in range(model.nv) if model.nq + dof in measured]
    qvel = np.full((len(y), model.nv), np.nan)
    qvel[:, known] = y[:, [measured[model.nq + dof] for dof in known]]
    ctrl = recording.ctrl
    if system.laws is not None:
        ctrl = np.full((len(y) - 1, model.nu), np.nan)
    return Trajectory(
        t=recording.t,
        qpos=qpos,
        qvel=qvel,
        act=np.zeros((len(y), model.na)),
        ctrl=ctrl,
    )
