"""Measured motion of a robot: positions, velocities and accelerations, and forces of its actuators.

A regression spline is fitted to each coordinate of the state that is measured, to its velocity, or
to both. It has degree 5 and equidistant knots. The number of these has the smallest information
criterion of Schwarz, n log(mean square) + m log n: more of them follow noise, fewer do not follow
the motion. The velocity of the engine's state is half a timestep older than the position, because
the integrators that are implicit in the velocity change the velocity first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, RecordingError, listed
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.segments import SIGMA_PER_MEDIAN, measured_states
from mjfim.model.coordinates import actuator_names, dof_names
from mjfim.model.elements import element_name, is_rk4
from mjfim.model.units import acts_at_joint

# Degree of the spline. Its second derivative is a cubic spline.
DEGREE = 5

# Largest number of coefficients over the number of times with a value. With more, a spline through
# values without noise swings between them.
MOST_COEFFICIENTS = 0.5

# Smallest number of knot intervals.
FEWEST_INTERVALS = 8

# Number of halvings of the distance of the knots without improvement after which the search ends.
HALVINGS_WITHOUT_IMPROVEMENT = 3

# Weight of a smooth continuation over gaps, relative to that of the data.
CONTINUATION = 1e-10

# Smallest mean square of the residuals over that of the data: what rounding leaves.
ROUNDING = 1e-26

# Values farther from the spline than this multiple of the median distance, as a standard deviation,
# are left out.
OUTLIER = 8.0

# Standard deviation of a number that is rounded to multiples of 1.
UNIFORM_SIGMA = 12.0**-0.5

# Rounds in which outliers are left out, at most: a spline through outliers hides smaller ones.
MAX_OUTLIER_ROUNDS = 3

# Number of frequencies at which the noise of a derivative is integrated.
FREQUENCIES = 400


@record
class Readings:
    """Measured values of a curve, or of its slope.

    Attributes:
        t: (n,) their times, which increase [s].
        values: (n,) the values [unit, or unit/s].
        sigma: Standard deviation of their noise.
        derivative: 0 for values, 1 for slopes.
    """

    t: Array
    values: Array
    sigma: float
    derivative: int


@dataclass(frozen=True, kw_only=True, eq=False)
class RegressionSpline:
    """A fitted spline.

    Attributes:
        curve: The spline.
        t: (n,) times of the readings to which it is fitted [s].
        spacing: Distance of its knots [s].
        variance: Mean square of the residuals over the stated variances.
        weights: Values and slopes per second, over the variances of their noise.
    """

    curve: scipy.interpolate.BSpline
    t: Array
    spacing: float
    variance: float
    weights: tuple[float, float]

    def at(self, t: Array, derivative: int = 0) -> Array:
        """(n,) values of a derivative at the times t: (n,)."""
        return np.asarray(self.curve(t, nu=derivative))

    def sigma(self, derivative: int) -> float:
        """Standard deviation of a derivative by the noise of the readings [unit, unit/s, unit/s²].

        The spline passes all frequencies up to pi / spacing.
        """
        limit = np.pi / self.spacing
        omega = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * limit
        of_values, of_slopes = self.weights
        density = omega ** (2 * derivative) / (of_values + of_slopes * omega**2)
        variance = self.variance * float(density.mean()) * limit / np.pi
        return float(np.sqrt(variance))


def fit_spline(
    readings: Sequence[Readings], anchor: float = 0.0, *, spacing: float | None = None
) -> RegressionSpline:
    """Fit a spline to readings of a curve.

    Args:
        readings: Values, slopes or both.
        anchor: First value of a curve of which only the slope is measured [unit].
        spacing: Distance of the knots, nearly [s]; None where the readings choose it.
    """
    left = list(readings)
    spline = _chosen(left, anchor, spacing)
    # Single wrong values, as of a disturbed encoder, would draw a spline to them, and hide where
    # the noise begins.
    for _ in range(MAX_OUTLIER_ROUNDS):
        kept = [_without_outliers(spline, reading) for reading in left]
        if all(len(after.t) == len(before.t) for after, before in zip(kept, left, strict=True)):
            break
        left = kept
        spline = _chosen(left, anchor, spacing)
    return spline


def _without_outliers(spline: RegressionSpline, reading: Readings) -> Readings:
    """The readings that are not far from their spline."""
    distance = np.abs(reading.values - spline.at(reading.t, reading.derivative))
    usual = SIGMA_PER_MEDIAN * float(np.median(distance))
    # Where a joint rests most of the time, the usual distance is less than an encoder resolves.
    step = min(np.diff(np.unique(reading.values)).tolist(), default=0.0)
    usual = max(usual, UNIFORM_SIGMA * step)
    kept = (distance <= OUTLIER * usual) | (usual == 0.0)
    return replace(reading, t=reading.t[kept], values=reading.values[kept])


def _chosen(readings: Sequence[Readings], anchor: float, spacing: float | None) -> RegressionSpline:
    """The spline with a distance of the knots, or that with the smallest criterion."""
    times = np.unique(np.concatenate([reading.t for reading in readings]))
    duration = float(times[-1] - times[0])
    most = max(int(MOST_COEFFICIENTS * len(times)) - DEGREE, 1)

    def tried(intervals: float) -> tuple[float, int, RegressionSpline]:
        """The criterion of a spline with about so many intervals, their number, the spline."""
        count = int(np.clip(round(intervals), 1, most))
        criterion, spline = _fitted(readings, anchor, times, count)
        return criterion, count, spline

    if spacing is not None:
        return tried(duration / spacing)[2]

    best, since = tried(FEWEST_INTERVALS), 0
    intervals = best[1]
    while since < HALVINGS_WITHOUT_IMPROVEMENT and intervals < most:
        intervals = min(2 * intervals, most)
        found, since = tried(intervals), since + 1
        if found[0] < best[0]:
            best, since = found, 0
    others = [tried(factor * best[1]) for factor in (np.sqrt(0.5), np.sqrt(2.0))]
    return min(best, *others, key=lambda each: each[0])[2]


def _fitted(
    readings: Sequence[Readings], anchor: float, times: Array, intervals: int
) -> tuple[float, RegressionSpline]:
    """The information criterion of the spline with a number of knot intervals, and this spline."""
    begin, duration = float(times[0]), float(times[-1] - times[0])
    spacing, size = duration / intervals, intervals + DEGREE
    knots = np.asarray(begin + spacing * np.arange(-DEGREE, size + 1), dtype=np.float64)

    # Normal equations, whose matrix has a band.
    bases = [_basis(reading, knots) / reading.sigma for reading in readings]
    values = [reading.values / reading.sigma for reading in readings]
    largest = max(reading.sigma for reading in readings)
    normal = largest**2 * sum(basis.T @ basis for basis in bases)
    right = largest**2 * sum(basis.T @ value for basis, value in zip(bases, values, strict=True))
    # Slopes show a curve up to a constant, which one more row holds for now.
    without_values = all(reading.derivative for reading in readings)
    if without_values:
        first = scipy.sparse.csr_array(([1.0], ([0], [0])), (size, size))
        normal = normal + float(normal.diagonal().mean()) * first
    coefficients = _solved(normal, right)
    if without_values:
        coefficients += anchor - float(
            scipy.interpolate.BSpline(knots, coefficients, DEGREE)(begin)
        )

    # The variance of the noise is unknown to the criterion.
    squares = sum(
        max(float(np.sum((value - basis @ coefficients) ** 2)), ROUNDING * float(value @ value))
        for basis, value in zip(bases, values, strict=True)
    )
    count = sum(len(reading.t) for reading in readings)
    mean = max(squares / count, float(np.finfo(float).tiny))
    of_values, of_slopes = (
        sum(len(r.t) / r.sigma**2 / duration for r in readings if r.derivative == derivative)
        for derivative in (0, 1)
    )
    spline = RegressionSpline(
        curve=scipy.interpolate.BSpline(knots, coefficients, DEGREE),
        t=times,
        spacing=spacing,
        variance=mean * count / max(count - size, 1),
        weights=(of_values, of_slopes),
    )
    return float(count * np.log(mean) + size * np.log(count)), spline


def _basis(reading: Readings, knots: Array) -> scipy.sparse.csr_array:
    """(n, size) values at the times of readings of the B-splines, or of their derivatives."""
    t = np.clip(reading.t, knots[DEGREE], knots[-DEGREE - 1])
    if not reading.derivative:
        design = scipy.interpolate.BSpline.design_matrix(t, knots, DEGREE)
        return scipy.sparse.csr_array(design)
    # The derivative of a spline has the differences of its coefficients as coefficients.
    lower = scipy.interpolate.BSpline.design_matrix(t, knots[1:-1], DEGREE - 1)
    differences = _differences(len(knots) - DEGREE - 1, 1)
    return scipy.sparse.csr_array(lower @ differences / (knots[1] - knots[0]))


def _differences(size: int, order: int) -> scipy.sparse.csr_array:
    """(size - order, size) matrix of differences between successive coefficients."""
    found = scipy.sparse.eye_array(size, format="csr")
    for _ in range(order):
        found = found[1:] - found[:-1]
    return scipy.sparse.csr_array(found)


def _solved(normal: scipy.sparse.csr_array, right: Array) -> Array:
    """(m,) solution of normal equations, with a smooth continuation where there are no data."""
    size = len(right)
    change = _differences(size, min(DEGREE // 2 + 1, size - 1))
    continuation = CONTINUATION * float(normal.diagonal().mean())
    total = normal + continuation * (change.T @ change)
    band = np.zeros((DEGREE + 1, size))
    for offset in range(min(DEGREE + 1, size)):
        band[DEGREE - offset, offset:] = total.diagonal(offset)
    return np.asarray(scipy.linalg.solveh_banded(band, right))


# Number of points of the motion for each interval between the knots of the finest spline.
POINTS_PER_INTERVAL = 4

# A point of the motion counts where a reading is at most so many intervals between knots away.
REACH = 1.5

# Smallest number of readings to which a spline is fitted.
FEWEST_READINGS = 8


@record
class MeasuredMotion:
    """Motion of a robot at n equidistant times.

    Attributes:
        recording: The recording.
        t: (n,) the times [s].
        lag: Time by which velocities of the engine's state are older than positions [s].
        qpos: (n, nq) positions [m or rad].
        qvel: (n, nv) velocities of the engine's state at these positions [m/s or rad/s].
        qacc: (n, nv) accelerations [m/s² or rad/s²].
        usable: (n, nv) True where readings of the degree of freedom are near.
        spacing: (nv,) distances of the knots of the coarsest splines [s].
        sigma: (3, nv) standard deviations of positions, velocities and accelerations by noise
            [m or rad, per s, per s²].
    """

    recording: AlignedRecording
    t: Array
    lag: float
    qpos: Array
    qvel: Array
    qacc: Array
    usable: np.ndarray
    spacing: Array
    sigma: Array

    @property
    def step(self) -> float:
        """Time between two points [s]."""
        return float(self.t[1] - self.t[0])

    def control(self, delay: float) -> Array:
        """(n, w) mean inputs over the time of each point, each held over its sample.

        Args:
            delay: Time by which the measured values are late [s].
        """
        recorded, dt = self.recording.ctrl, self.recording.dt
        edges = dt * np.arange(len(recorded) + 1)

        # Before the first sample and after the last one, their controls are held.
        half = 0.5 * self.step
        middle = np.clip(self.t + self.lag - delay, half, edges[-1] - half)
        ends = middle + np.array([[-half], [half]])
        mean = np.empty((len(self.t), recorded.shape[1]))
        for place, column in enumerate(recorded.T):
            integral = np.append(0.0, dt * np.cumsum(column))
            mean[:, place] = np.diff(np.interp(ends, edges, integral), axis=0)[0] / self.step
        return mean

    def smoothed(self, values: Array) -> tuple[Array, np.ndarray, float]:
        """Values that were measured beside the motion, without noise of higher frequencies.

        Args:
            values: (M,) values at the times of the recording; NaN for missing ones.

        Returns:
            (n,) values at the points, True where a measured one is near, and the standard
            deviation of the values by noise.
        """
        known = np.isfinite(values)
        t = self.recording.t[known]
        spacing = POINTS_PER_INTERVAL * self.step
        reading = Readings(t=t, values=values[known], sigma=1.0, derivative=0)
        spline = fit_spline([reading], spacing=spacing)
        return spline.at(self.t), _is_near(self.t, t, REACH * spacing), spline.sigma(0)


def measured_motion(
    system: System, recording: AlignedRecording, theta: Array, most_points: int
) -> MeasuredMotion:
    """Motion of a recording.

    Args:
        system: The system.
        recording: The recording.
        theta: (p,) parameters, of which the biases of outputs matter.
        most_points: Largest number of points.

    Raises:
        RecordingError: A degree of freedom was not measured, or too seldom.
    """
    # A velocity of the engine's state is older than the position.
    space = system.space
    lag = 0.0 if is_rk4(system.model) else 0.5 * float(system.model.opt.timestep)
    curves = _curves(system, recording)
    y = recording.y - system.parameters.bias_derivative(recording.y.shape[1]) @ theta
    splines: dict[int, RegressionSpline] = {}
    for key, (outputs, _) in curves.items():
        readings = []
        for derivative, output in outputs.items():
            known = recording.measured[:, output]
            readings.append(
                Readings(
                    t=recording.t[known] - derivative * lag,
                    values=y[known, output],
                    sigma=float(system.noise.sigma[output]),
                    derivative=derivative,
                )
            )
        # Where only its slope is measured, a curve begins as the experiment says.
        anchor = float(system.nominal_initial_state[key]) if key >= 0 else 0.0
        splines[key] = fit_spline(readings, anchor)

    # Points are as dense as the finest spline needs, but no denser than the rows.
    duration = float(recording.t[-1])
    period = duration / (len(recording.t) - 1)
    finest = min(spline.spacing for spline in splines.values())
    step = max(finest / POINTS_PER_INTERVAL, period, duration / most_points)
    count = int(duration / step * (1.0 + 1e-9)) + 1
    t = np.asarray(step * np.arange(count), dtype=np.float64)
    qpos, qvel, qacc = _motion(system, splines, t, lag)

    usable = np.ones((len(t), space.nv), dtype=bool)
    spacing, sigma = np.zeros(space.nv), np.zeros((3, space.nv))
    for key, (_, dofs) in curves.items():
        spline, own = splines[key], list(dofs)
        reach = REACH * max(spline.spacing, step)
        usable[:, own] &= _is_near(t, spline.t, reach)[:, None]
        spacing[own] = np.maximum(spacing[own], spline.spacing)
        # A rotation is twice a combination of the changes of a unit quaternion.
        factor = 2.0 if len(dofs) > 1 else 1.0
        own_sigma = factor * np.array([[spline.sigma(derivative)] for derivative in range(3)])
        sigma[:, own] = np.maximum(sigma[:, own], own_sigma)
    return MeasuredMotion(
        recording=recording,
        t=t,
        lag=lag,
        qpos=qpos,
        qvel=qvel,
        qacc=qacc,
        usable=usable,
        spacing=spacing,
        sigma=sigma,
    )


# ---- curves


# A number that changes with time: the outputs that measure it (0) and its slope (1), and the
# degrees of freedom that it moves, three for a component of a quaternion. Its key is its address in
# qpos, or negative for the integral of an angular velocity.
Curves = dict[int, tuple[dict[int, int], tuple[int, ...]]]


def _curves(system: System, recording: AlignedRecording) -> Curves:
    """The curves of all degrees of freedom. Raises RecordingError where one was not measured."""
    space = system.space
    output_of = measured_states(system, recording)

    def measured(*addresses: int) -> dict[int, int]:
        """The outputs that measure a number of the state, and its slope, by the derivative."""
        places = enumerate(addresses)
        return {derivative: output_of[place] for derivative, place in places if place in output_of}

    curves: Curves = {
        q: (measured(q, space.nq + v), (v,))
        for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)
    }
    for q, v in space.quaternions:
        dofs = tuple(range(v, v + 3))
        curves |= {q + i: (measured(q + i), dofs) for i in range(4)}
        if all(space.nq + dof in output_of for dof in dofs):
            curves |= {-1 - dof: ({1: output_of[space.nq + dof]}, (dof,)) for dof in dofs}

    missing = sorted({dof for outputs, dofs in curves.values() if not outputs for dof in dofs})
    if missing:
        names = dof_names(system.model)
        unmeasured = listed([names[dof] for dof in missing])
        raise RecordingError(
            f"{recording.name}: no measured position or velocity of {unmeasured}; the equation of "
            "motion needs those of every degree of freedom (orientations as quaternions): add "
            'columns such as `qpos:<joint>`, or state fit.start = "measured"'
        )
    counts = recording.measured.sum(axis=0)
    fewest = min(int(counts[list(outputs.values())].min()) for outputs, _ in curves.values())
    if fewest < FEWEST_READINGS:
        raise RecordingError(
            f"{recording.name}: a degree of freedom has only {fewest} measured values; "
            f"velocities and accelerations need at least {FEWEST_READINGS}"
        )
    return curves


def _is_near(t: Array, readings: Array, reach: float) -> np.ndarray:
    """(n,) True for times with a reading at most `reach` before and one after them [s]."""
    margin = 1e-9 * reach
    after = np.searchsorted(readings, t - margin)
    before = np.searchsorted(readings, t + margin, side="right") - 1
    ends = np.concatenate([[-np.inf], readings, [np.inf]])
    return np.asarray((ends[after + 1] - t <= reach) & (t - ends[before + 1] <= reach))


def _motion(
    system: System, splines: Mapping[int, RegressionSpline], t: Array, lag: float
) -> tuple[Array, Array, Array]:
    """(n, nq) positions, (n, nv) velocities and (n, nv) accelerations at the times t: (n,)."""
    space = system.space
    qpos = np.empty((len(t), space.nq))
    qvel = np.empty((len(t), space.nv))
    qacc = np.empty((len(t), space.nv))
    # Measured angular velocities replace the slopes of a quaternion.
    key_of = {v: q for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)}
    key_of |= {-1 - key: key for key in splines if key < 0}
    for q in space.scalar_q.tolist():
        qpos[:, q] = splines[q].at(t)
    for dof, key in key_of.items():
        qvel[:, dof], qacc[:, dof] = splines[key].at(t - lag, 1), splines[key].at(t, 2)

    for q, v in space.quaternions:

        def at(times: Array, derivative: int = 0, first: int = q) -> Array:
            """(n, 4) components of the quaternion, or their derivatives."""
            components = [splines[first + i].at(times, derivative) for i in range(4)]
            return np.stack(components, axis=1)

        position = at(t)
        qpos[:, q : q + 4] = position / np.linalg.norm(position, axis=1, keepdims=True)
        if v not in key_of:
            qvel[:, v : v + 3] = _turning(at(t - lag), at(t - lag, 1))
            qacc[:, v : v + 3] = _turning(position, at(t, 2))
    return qpos, qvel, qacc


def _turning(quaternion: Array, change: Array) -> Array:
    """(n, 3) twice the imaginary part of `z* dz / |z|²`: quaternions z and changes dz, (n, 4)."""
    w, dw = quaternion[:, :1], change[:, :1]
    axis, d_axis = quaternion[:, 1:], change[:, 1:]
    imaginary = w * d_axis - dw * axis - np.cross(axis, d_axis)
    return np.asarray(2.0 * imaginary / np.sum(quaternion**2, axis=1, keepdims=True))


# Sensors of forces of single actuators, and of all actuators on a joint.
ACTUATOR_FORCE = int(mujoco.mjtSensor.mjSENS_ACTUATORFRC)
JOINT_FORCE = int(mujoco.mjtSensor.mjSENS_JOINTACTFRC)


@record
class MeasuredForce:
    """A measured force of actuators.

    Attributes:
        output: Index of the output.
        actuator: Address of the force of a single actuator; -1 for all on a joint.
        dof: Degree of freedom of the joint; -1 for a single actuator.
        name: Name of the actuator or joint.
        is_modelled: Whether the log shows the controls that the model needs for it.
    """

    output: int
    actuator: int
    dof: int
    name: str
    is_modelled: bool

    @property
    def is_of_joint(self) -> bool:
        """True for the force of all actuators on a joint."""
        return self.dof >= 0


def measured_forces(
    system: System, recordings: Sequence[AlignedRecording]
) -> tuple[MeasuredForce, ...]:
    """Forces of actuators that are measured in a recording, those of joints last.

    Raises:
        ExperimentError: The control of an actuator is computed by a control law, and a recording
            does not hold its force.
    """
    model = system.model
    names = actuator_names(model)
    laws = () if system.laws is None else system.laws.laws
    controlled = [names.index(law.actuator) for law in laws]
    by_address = {output.sensor: i for i, output in enumerate(system.outputs.outputs)}
    found = []
    for sensor in range(model.nsensor):
        output = by_address.get(int(model.sensor_adr[sensor]))
        kind, element = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
        if (
            output is None
            or kind not in (JOINT_FORCE, ACTUATOR_FORCE)
            or not any(recording.measured[:, output].any() for recording in recordings)
        ):
            continue
        of_joint = kind == JOINT_FORCE
        found.append(
            MeasuredForce(
                output=output,
                actuator=-1 if of_joint else int(model.actuator_outadr[element]),
                dof=int(model.jnt_dofadr[element]) if of_joint else -1,
                name=element_name(model, "joint" if of_joint else "actuator", element),
                is_modelled=not controlled if of_joint else element not in controlled,
            )
        )
    for law, actuator in zip(laws, controlled, strict=True):
        outputs = [force.output for force in found if _contains(model, force, actuator)]
        for recording in recordings:
            if recording.measured[:, outputs].sum() < FEWEST_READINGS:
                raise ExperimentError(
                    f"{system.experiment.source}: controllers.{law.actuator}: the equation of "
                    f"motion needs the control of {law.actuator}, which this law computes, or its "
                    f"measured force, which {recording.name} does not hold; add a sensor "
                    "`actuatorfrc` or `jointactuatorfrc` to the model and its column to the log, "
                    'or remove fit.start = "inverse_dynamics"'
                )
    return tuple(sorted(found, key=lambda force: force.is_of_joint))


def _contains(model: mujoco.MjModel, force: MeasuredForce, actuator: int) -> bool:
    """Whether a measured force contains all of the force of an actuator."""
    if not force.is_of_joint:
        return force.actuator == int(model.actuator_outadr[actuator])
    at_joint = acts_at_joint(model, actuator)
    return at_joint and force.dof == int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])
