"""Positions, velocities and accelerations of a robot from the measured values of a recording.

A regression spline goes through the measured positions of each degree of freedom, and its slope
through the measured velocities (`regression_spline`). Orientations are splines of the components of
unit quaternions z: with the angular velocity w in the axes of the body,

    w = 2 Im(z* dz/dt),    dw/dt = 2 Im(z* d²z/dt²).

The engine's integrators except RK4 move positions by the new velocity, `q_k+1 = q_k + h v_k+1`. So
the velocity of the engine's state is the slope of the curve through its positions half a timestep
earlier, its mean acceleration over the step is the curvature at the beginning, and the control acts
half a timestep earlier. With these times, the motion of a simulation fulfils the equation of motion
of the engine's steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.regression_spline import Readings, RegressionSpline, fit_splines
from mjfim.model.coordinates import dof_names
from mjfim.model.integrators import is_rk4
from mjfim.plant.outputs import outputs_by_state

# Number of points of the motion for each interval between the knots of the finest spline.
POINTS_PER_INTERVAL = 4

# A point of the motion counts where a reading is at most so many intervals between knots away.
REACH = 1.5

# Smallest number of readings to which a spline is fitted.
FEWEST_READINGS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredMotion:
    """Motion of a robot at n equidistant times.

    Attributes:
        recording: The recording.
        t: (n,) times since the first row [s].
        lag: Time by which velocities and controls of the model's state belong to an earlier instant
            than its positions [s].
        qpos: (n, nq) positions.
        qvel: (n, nv) velocities of the model's state.
        qacc: (n, nv) mean accelerations of the model's steps.
        usable: (n, nv) True where readings are near.
        spacing: (nv,) distance of the knots of the splines [s].
        speed_sigma: (nv,) standard deviation of the velocities by noise [m/s or rad/s].
    """

    recording: AlignedRecording
    t: Array
    lag: float
    qpos: Array
    qvel: Array
    qacc: Array
    usable: np.ndarray
    spacing: Array
    speed_sigma: Array

    @property
    def step(self) -> float:
        """Time between two points [s]."""
        return float(self.t[1] - self.t[0])

    def control(self, delay: float) -> Array:
        """(n, nu) mean control over the time of each point.

        Args:
            delay: Time by which the readings lag [s].
        """
        mean = np.empty((len(self.t), self.recording.ctrl.shape[1]))
        for column in range(mean.shape[1]):
            mean[:, column] = self.held(column, delay)
        return mean

    def held(self, column: int, delay: float) -> Array:
        """(n,) mean over the time of each point of one input, held over each sample.

        Args:
            column: Index of the input.
            delay: Time by which the readings lag [s].
        """
        recorded, dt = self.recording.ctrl[:, column], self.recording.dt
        edges = dt * np.arange(len(recorded) + 1)
        integral = np.concatenate([[0.0], dt * np.cumsum(recorded)])

        # Before the first sample and after the last one, their controls are held.
        middle = self.t + self.lag - delay
        middle = np.clip(middle, 0.5 * self.step, edges[-1] - 0.5 * self.step)
        before = np.interp(middle - 0.5 * self.step, edges, integral)
        after = np.interp(middle + 0.5 * self.step, edges, integral)
        return np.asarray((after - before) / self.step)

    def smoothed(self, values: Array, reach: float) -> tuple[Array, np.ndarray]:
        """Values that were measured beside the motion, without noise of higher frequencies.

        Args:
            values: (M,) values in the rows of the recording; NaN where there is none.
            reach: Time within which a point needs a reading [s].

        Returns:
            (n,) values at the points, and (n,) True where readings are near.
        """
        known = np.isfinite(values)
        t = self.recording.t[known]
        reading = Readings(t=t, values=values[known, None], sigma=np.ones(1), derivative=0)
        spacing = POINTS_PER_INTERVAL * self.step
        spline = fit_splines([reading], np.zeros(1), spacing=spacing)[0]
        return spline.at(self.t), _is_near(self.t, t, reach)


def measured_motion(
    system: System, recording: AlignedRecording, theta: Array, most_points: int
) -> MeasuredMotion:
    """Motion of a recording.

    Args:
        system: The system that was recorded.
        recording: The recording.
        theta: (p,) parameters, of which only biases of outputs matter.
        most_points: Largest number of points.

    Returns:
        The motion.

    Raises:
        RecordingError: A degree of freedom was not measured; the message names it.
    """
    curves = _curves(system, recording)
    y = recording.y - system.parameters.bias_derivative(recording.y.shape[1]) @ theta
    lag = engine_lag(system.model)
    splines = _splines(system, recording, y, curves, lag)

    # Points are as dense as the finest spline needs, but no denser than the rows.
    duration = float(recording.t[-1])
    period = duration / (len(recording.t) - 1)
    finest = min(spline.spacing for spline in splines.values())
    step = max(finest / POINTS_PER_INTERVAL, period, duration / most_points)
    count = int(duration / step * (1.0 + 1e-9)) + 1
    t = np.asarray(step * np.arange(count), dtype=np.float64)

    qpos, qvel, qacc = _motion(system, splines, t, lag)
    usable = np.ones((len(t), system.space.nv), dtype=bool)
    spacing = np.zeros(system.space.nv)
    speed_sigma = np.zeros(system.space.nv)
    for curve in curves:
        spline, dofs = splines[curve.key], list(curve.dofs)
        reach = REACH * max(spline.spacing, step)
        near = _is_near(t, _times(recording, curve), reach)
        usable[:, dofs] &= near[:, None]
        spacing[dofs] = np.maximum(spacing[dofs], spline.spacing)

        # The angular velocity is twice a combination of the slopes of a unit quaternion.
        sigma = spline.slope_sigma * (2.0 if curve.in_quaternion else 1.0)
        speed_sigma[dofs] = np.maximum(speed_sigma[dofs], sigma)

    return MeasuredMotion(
        recording=recording,
        t=t,
        lag=lag,
        qpos=qpos,
        qvel=qvel,
        qacc=qacc,
        usable=usable,
        spacing=spacing,
        speed_sigma=speed_sigma,
    )


def engine_lag(model: mujoco.MjModel) -> float:
    """Time by which a velocity of the engine's state is older than the position [s]."""
    return 0.0 if is_rk4(model) else 0.5 * float(model.opt.timestep)


# ---- curves


@dataclass(frozen=True, kw_only=True)
class _Curve:
    """A number that changes with time, and the outputs that measure it or its slope.

    Attributes:
        key: Address of its position in qpos; minus 1 minus the address in qvel where only the slope
            is used.
        values: Output that measures it, or None.
        slopes: Output that measures its slope, or None.
        dofs: Degrees of freedom that depend on it.
        in_quaternion: True for a component of a quaternion.
    """

    key: int
    values: int | None
    slopes: int | None
    dofs: tuple[int, ...]
    in_quaternion: bool = False


def _curves(system: System, recording: AlignedRecording) -> list[_Curve]:
    """The curves of all degrees of freedom. Raises RecordingError where one was not measured."""
    space = system.space
    has_values = np.asarray(recording.measured.any(axis=0))
    outputs = outputs_by_state(system.model, system.outputs)
    output_of = {address: i for address, i in outputs.items() if has_values[i]}

    curves = []
    missing = []
    for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True):
        values, slopes = output_of.get(q), output_of.get(space.nq + v)
        if values is None and slopes is None:
            missing.append(v)
        curves.append(_Curve(key=q, values=values, slopes=slopes, dofs=(v,)))

    for q, v in space.quaternions:
        dofs = tuple(range(v, v + 3))
        components = [output_of.get(q + i) for i in range(4)]
        if any(output is None for output in components):
            missing += dofs
        for i, output in enumerate(components):
            curves.append(
                _Curve(key=q + i, values=output, slopes=None, dofs=dofs, in_quaternion=True)
            )

        # Measured angular velocities replace the slopes of the quaternion.
        rates = [output_of.get(space.nq + dof) for dof in dofs]
        if all(output is not None for output in rates):
            curves += [
                _Curve(key=-1 - dof, values=None, slopes=output, dofs=(dof,))
                for dof, output in zip(dofs, rates, strict=True)
            ]

    if missing:
        names = dof_names(system.model)
        unmeasured = listed([names[dof] for dof in missing])
        raise RecordingError(
            f"{recording.name}: no measured position or velocity of {unmeasured}; the equation of "
            "motion needs those of every degree of freedom (orientations as quaternions): add "
            'columns such as `qpos:<joint>`, or state fit.start = "measured"'
        )
    _require_readings(recording, curves)
    return curves


def _require_readings(recording: AlignedRecording, curves: Sequence[_Curve]) -> None:
    """Raise RecordingError where too few values were measured for accelerations."""
    for curve in curves:
        for output in (curve.values, curve.slopes):
            count = FEWEST_READINGS
            if output is not None:
                count = int(recording.measured[:, output].sum())
            if count < FEWEST_READINGS:
                raise RecordingError(
                    f"{recording.name}: a degree of freedom has only {count} measured values; "
                    f"velocities and accelerations need at least {FEWEST_READINGS}"
                )


def _splines(
    system: System,
    recording: AlignedRecording,
    y: Array,
    curves: Sequence[_Curve],
    lag: float,
) -> dict[int, RegressionSpline]:
    """Splines by the keys of their curves.

    Curves with readings in the same rows are fitted together, which takes the time of one.
    """
    sigma = system.noise.sigma
    groups: dict[tuple[object, ...], list[_Curve]] = {}
    for curve in curves:
        rows = [
            b"" if output is None else recording.measured[:, output].tobytes()
            for output in (curve.values, curve.slopes)
        ]
        ratio = 0.0
        if curve.values is not None and curve.slopes is not None:
            ratio = float(sigma[curve.slopes] / sigma[curve.values])
        groups.setdefault((*rows, ratio), []).append(curve)

    found: dict[int, RegressionSpline] = {}
    for members in groups.values():
        readings = []
        for derivative in (0, 1):
            outputs = [m.slopes if derivative else m.values for m in members]
            chosen = [output for output in outputs if output is not None]
            if chosen:
                known = recording.measured[:, chosen[0]]
                shift = lag if derivative else 0.0
                readings.append(
                    Readings(
                        t=recording.t[known] - shift,
                        values=y[known][:, chosen],
                        sigma=sigma[chosen],
                        derivative=derivative,
                    )
                )
        anchors = np.array([_anchor(system, member) for member in members])
        splines = fit_splines(readings, anchors)
        found |= {member.key: spline for member, spline in zip(members, splines, strict=True)}
    return found


def _anchor(system: System, curve: _Curve) -> float:
    """Stated initial position of a curve of which only the slope is measured."""
    return float(system.nominal_initial_state[curve.key]) if curve.key >= 0 else 0.0


def _times(recording: AlignedRecording, curve: _Curve) -> Array:
    """Times of the readings of a curve and of its slope [s]."""
    outputs = [output for output in (curve.values, curve.slopes) if output is not None]
    return recording.t[recording.measured[:, outputs].any(axis=1)]


def _is_near(t: Array, readings: Array, reach: float) -> np.ndarray:
    """(n,) True for times with a reading at most `reach` before and one after them [s].

    Args:
        t: (n,) times [s].
        readings: (m,) ascending times of readings [s].
        reach: Largest distance [s].
    """
    margin = 1e-9 * reach
    after = np.searchsorted(readings, t - margin)
    before = np.searchsorted(readings, t + margin, side="right") - 1
    exists = (after < len(readings)) & (before >= 0)
    last = len(readings) - 1
    gap_after = readings[np.clip(after, 0, last)] - t
    gap_before = t - readings[np.clip(before, 0, last)]
    return np.asarray(exists & (gap_after <= reach) & (gap_before <= reach))


def _motion(
    system: System, splines: Mapping[int, RegressionSpline], t: Array, lag: float
) -> tuple[Array, Array, Array]:
    """(n, nq) positions, (n, nv) velocities and (n, nv) accelerations at the times t: (n,)."""
    space = system.space
    qpos = np.empty((len(t), space.nq))
    qvel = np.empty((len(t), space.nv))
    qacc = np.empty((len(t), space.nv))

    for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True):
        qpos[:, q] = splines[q].at(t)
        qvel[:, v] = splines[q].at(t - lag, 1)
        qacc[:, v] = splines[q].at(t, 2)

    for q, v in space.quaternions:
        components = [splines[q + i] for i in range(4)]
        position = np.stack([spline.at(t) for spline in components], axis=1)
        norm = np.linalg.norm(position, axis=1, keepdims=True)
        qpos[:, q : q + 4] = position / norm

        for dof in range(v, v + 3):
            if -1 - dof in splines:
                qvel[:, dof] = splines[-1 - dof].at(t - lag, 1)
                qacc[:, dof] = splines[-1 - dof].at(t, 2)
        if -1 - v not in splines:
            earlier = np.stack([spline.at(t - lag) for spline in components], axis=1)
            rate = np.stack([spline.at(t - lag, 1) for spline in components], axis=1)
            change = np.stack([spline.at(t, 2) for spline in components], axis=1)
            qvel[:, v : v + 3] = _turning(earlier, rate)
            qacc[:, v : v + 3] = _turning(position, change)
    return qpos, qvel, qacc


def _turning(quaternion: Array, change: Array) -> Array:
    """(n, 3) twice the imaginary part of `z* dz / |z|²`: quaternions z and changes dz, (n, 4)."""
    w, dw = quaternion[:, :1], change[:, :1]
    axis, d_axis = quaternion[:, 1:], change[:, 1:]
    imaginary = w * d_axis - dw * axis - np.cross(axis, d_axis)
    return np.asarray(2.0 * imaginary / np.sum(quaternion**2, axis=1, keepdims=True))
