"""Positions, velocities and accelerations of a robot from the measured values of a recording.

A regression spline is fitted to each coordinate of the state that is measured, to its velocity, or
to both. The velocity of the engine's state is half a timestep older than the position, because the
integrators that are implicit in the velocity change the velocity first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.inverse_dynamics.spline import Readings, RegressionSpline, fit_spline
from mjfim.model.coordinates import dof_names
from mjfim.model.elements import is_rk4
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
        t: (n,) the times [s].
        lag: Time by which velocities of the engine's state are older than positions [s].
        qpos: (n, nq) positions [m or rad].
        qvel: (n, nv) velocities of the engine's state at these positions [m/s or rad/s].
        qacc: (n, nv) accelerations [m/s² or rad/s²].
        usable: (n, nv) True where readings of the degree of freedom are near.
        spacing: (nv,) distances of the knots of the coarsest splines [s].
        speed_sigma: (nv,) standard deviations of the velocities by noise [m/s or rad/s].
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
        """(n, w) mean inputs over the time of each point, each held over its sample.

        Args:
            delay: Time by which the measured values are late [s].
        """
        recorded, dt = self.recording.ctrl, self.recording.dt
        edges = dt * np.arange(len(recorded) + 1)

        # Before the first sample and after the last one, their controls are held.
        half = 0.5 * self.step
        middle = np.clip(self.t + self.lag - delay, half, edges[-1] - half)
        mean = np.empty((len(self.t), recorded.shape[1]))
        for place, column in enumerate(recorded.T):
            integral = np.concatenate([[0.0], dt * np.cumsum(column)])
            before = np.interp(middle - half, edges, integral)
            mean[:, place] = (np.interp(middle + half, edges, integral) - before) / self.step
        return mean

    def smoothed(self, values: Array) -> tuple[Array, np.ndarray]:
        """Values that were measured beside the motion, without noise of higher frequencies.

        Args:
            values: (M,) values at the times of the recording; NaN for missing ones.

        Returns:
            (n,) values at the points, and True where a measured one is near.
        """
        known = np.isfinite(values)
        t = self.recording.t[known]
        spacing = POINTS_PER_INTERVAL * self.step
        reading = Readings(t=t, values=values[known], sigma=1.0, derivative=0)
        spline = fit_spline([reading], spacing=spacing)
        return spline.at(self.t), _is_near(self.t, t, REACH * spacing)


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
    space, lag = system.space, engine_lag(system.model)
    curves = _curves(system, recording)
    y = recording.y - system.parameters.bias_derivative(recording.y.shape[1]) @ theta
    splines = {curve.key: _spline(system, recording, y, curve, lag) for curve in curves}

    # Points are as dense as the finest spline needs, but no denser than the rows.
    duration = float(recording.t[-1])
    period = duration / (len(recording.t) - 1)
    finest = min(spline.spacing for spline in splines.values())
    step = max(finest / POINTS_PER_INTERVAL, period, duration / most_points)
    count = int(duration / step * (1.0 + 1e-9)) + 1
    t = np.asarray(step * np.arange(count), dtype=np.float64)
    qpos, qvel, qacc = _motion(system, splines, t, lag)

    usable = np.ones((len(t), space.nv), dtype=bool)
    spacing, speed_sigma = np.zeros(space.nv), np.zeros(space.nv)
    for curve in curves:
        spline, dofs = splines[curve.key], list(curve.dofs)
        measured = recording.measured[:, curve.outputs].any(axis=1)
        reach = REACH * max(spline.spacing, step)
        usable[:, dofs] &= _is_near(t, recording.t[measured], reach)[:, None]
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
        key: Address in qpos; negative for the integral of an angular velocity.
        values: Output that measures it; None for none.
        slopes: Output that measures its slope; None for none.
        dofs: Degrees of freedom that it moves.
        in_quaternion: Whether it is a component of a quaternion.
    """

    key: int
    values: int | None
    slopes: int | None
    dofs: tuple[int, ...]
    in_quaternion: bool = False

    @property
    def outputs(self) -> list[int]:
        """The outputs."""
        return [output for output in (self.values, self.slopes) if output is not None]


def _curves(system: System, recording: AlignedRecording) -> list[_Curve]:
    """The curves of all degrees of freedom. Raises RecordingError where one was not measured."""
    space = system.space
    has_values = np.asarray(recording.measured.any(axis=0))
    outputs = outputs_by_state(system.model, system.outputs)
    output_of = {address: i for address, i in outputs.items() if has_values[i]}

    curves = [
        _Curve(key=q, values=output_of.get(q), slopes=output_of.get(space.nq + v), dofs=(v,))
        for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)
    ]
    for q, v in space.quaternions:
        dofs = tuple(range(v, v + 3))
        curves += [
            _Curve(
                key=q + i, values=output_of.get(q + i), slopes=None, dofs=dofs, in_quaternion=True
            )
            for i in range(4)
        ]
        # Measured angular velocities replace the slopes of the quaternion.
        rates = [output_of.get(space.nq + dof) for dof in dofs]
        if None not in rates:
            curves += [
                _Curve(key=-1 - dof, values=None, slopes=output, dofs=(dof,))
                for dof, output in zip(dofs, rates, strict=True)
            ]

    missing = sorted({dof for curve in curves if not curve.outputs for dof in curve.dofs})
    if missing:
        names = dof_names(system.model)
        unmeasured = listed([names[dof] for dof in missing])
        raise RecordingError(
            f"{recording.name}: no measured position or velocity of {unmeasured}; the equation of "
            "motion needs those of every degree of freedom (orientations as quaternions): add "
            'columns such as `qpos:<joint>`, or state fit.start = "measured"'
        )
    counts = recording.measured.sum(axis=0)
    fewest = min(int(counts[output]) for curve in curves for output in curve.outputs)
    if fewest < FEWEST_READINGS:
        raise RecordingError(
            f"{recording.name}: a degree of freedom has only {fewest} measured values; "
            f"velocities and accelerations need at least {FEWEST_READINGS}"
        )
    return curves


def _spline(
    system: System, recording: AlignedRecording, y: Array, curve: _Curve, lag: float
) -> RegressionSpline:
    """The spline of a curve; where only its slope is measured, it begins as the experiment says."""
    readings = []
    for derivative, output in enumerate((curve.values, curve.slopes)):
        if output is not None:
            known = recording.measured[:, output]
            readings.append(
                Readings(
                    t=recording.t[known] - derivative * lag,
                    values=y[known, output],
                    sigma=float(system.noise.sigma[output]),
                    derivative=derivative,
                )
            )
    anchor = float(system.nominal_initial_state[curve.key]) if curve.key >= 0 else 0.0
    return fit_spline(readings, anchor)


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
    for q, v in zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True):
        qpos[:, q] = splines[q].at(t)
        qvel[:, v] = splines[q].at(t - lag, 1)
        qacc[:, v] = splines[q].at(t, 2)

    for q, v in space.quaternions:

        def at(times: Array, derivative: int = 0, first: int = q) -> Array:
            """(n, 4) components of the quaternion, or their derivatives."""
            components = [splines[first + i].at(times, derivative) for i in range(4)]
            return np.stack(components, axis=1)

        position = at(t)
        qpos[:, q : q + 4] = position / np.linalg.norm(position, axis=1, keepdims=True)
        if -1 - v in splines:
            for dof in range(v, v + 3):
                qvel[:, dof] = splines[-1 - dof].at(t - lag, 1)
                qacc[:, dof] = splines[-1 - dof].at(t, 2)
        else:
            qvel[:, v : v + 3] = _turning(at(t - lag), at(t - lag, 1))
            qacc[:, v : v + 3] = _turning(position, at(t, 2))
    return qpos, qvel, qacc


def _turning(quaternion: Array, change: Array) -> Array:
    """(n, 3) twice the imaginary part of `z* dz / |z|²`: quaternions z and changes dz, (n, 4)."""
    w, dw = quaternion[:, :1], change[:, :1]
    axis, d_axis = quaternion[:, 1:], change[:, 1:]
    imaginary = w * d_axis - dw * axis - np.cross(axis, d_axis)
    return np.asarray(2.0 * imaginary / np.sum(quaternion**2, axis=1, keepdims=True))
