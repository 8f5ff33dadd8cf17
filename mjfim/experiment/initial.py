"""How an experiment begins: its state, the keyframes of a model, and signals of the control.

Controls are combinations of basis functions: splines of a bandwidth, Fourier series, or multisines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import by_name
from mjfim.experiment.system_tables import Initial, Signal
from mjfim.model.coordinates import joint_names
from mjfim.model.elements import names_of
from mjfim.model.limited_elements import quaternion_address, quaternion_joints
from mjfim.model.terms.term import StateLayout

# Degree of the splines.
SPLINE_DEGREE = 3

# Curves are linearly dependent if a singular value is below this fraction of the largest one.
DEPENDENCE_TOLERANCE = 1e-5

# Frequencies of successive actuators differ by this fraction of the first actuator's frequency.
FREQUENCY_SPREAD = 0.17

# Last frequency of a chirp over its first one, where the experiment file does not state it.
CHIRP_SPAN = 5.0

# A quaternion whose norm is below this number states no rotation.
NO_ROTATION = 1e-6


def spline_basis(
    t: Array,
    horizon: float,
    bandwidth: float,
    starts_at_rest: bool,
    ends_at_rest: bool,
    periodic: bool,
) -> Array:
    """Cubic B-splines with a knot every 1 / (2 bandwidth) seconds.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        bandwidth: Highest frequency that the splines have to represent [Hz].
        starts_at_rest: Whether value and slope are zero at the beginning.
        ends_at_rest: Whether value and slope are zero at the end.
        periodic: Whether value and two derivatives at the end equal those at the beginning.

    Returns:
        (N, M) values of the M splines.
    """
    intervals = max(int(np.ceil(2.0 * bandwidth * horizon)), SPLINE_DEGREE + 1)
    knots = horizon / intervals * np.arange(-SPLINE_DEGREE, intervals + SPLINE_DEGREE + 1)

    # Splines that extend beyond the end of the horizon continue at its beginning.
    if periodic:
        values = scipy.interpolate.BSpline.design_matrix(t, knots, SPLINE_DEGREE).toarray()
        values[:, :SPLINE_DEGREE] += values[:, intervals:]
        return np.asarray(values[:, :intervals])

    # Knots are repeated at both ends. Only the first two splines then have a value or a slope at
    # the beginning, and only the last two at the end.
    knots = np.clip(knots, 0.0, horizon)
    values = scipy.interpolate.BSpline.design_matrix(t, knots, SPLINE_DEGREE).toarray()
    first = 2 if starts_at_rest else 0
    last = values.shape[1] - (2 if ends_at_rest else 0)
    return np.asarray(values[:, first:last])


def fourier_basis(
    t: Array,
    horizon: float,
    frequency: float,
    harmonics: int,
    starts_at_rest: bool,
    ends_at_rest: bool,
) -> Array:
    """Sines and cosines of the multiples of a base frequency, each with amplitude 1.

    If a curve has to begin or end at rest, a polynomial with its value and first two derivatives
    there is subtracted, of the lowest possible degree. With rest at both ends this is a finite
    Fourier series with a quintic polynomial, as in point-to-point excitation of robots.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        frequency: Base frequency [Hz].
        harmonics: Number of multiples of the base frequency.
        starts_at_rest: Whether value and two derivatives are zero at the beginning.
        ends_at_rest: Whether value and two derivatives are zero at the end.

    Returns:
        (N, 2 harmonics) sines, then cosines.
    """
    omega: Array = 2.0 * np.pi * frequency * np.arange(1.0, harmonics + 1.0)
    waves = _wave_derivatives(t, omega, 0)

    times = starts_at_rest * [0.0] + ends_at_rest * [horizon]
    if not times:
        return waves

    # Value and two derivatives at each end fix the coefficients of the polynomials.
    powers = np.arange(3 * len(times))
    conditions = [(np.array([time]), order) for time in times for order in range(3)]
    polynomials = [_power_derivatives(at, horizon, powers, order) for at, order in conditions]
    values = [_wave_derivatives(at, omega, order) for at, order in conditions]
    coefficients = np.linalg.solve(np.concatenate(polynomials), np.concatenate(values))

    return waves - _power_derivatives(t, horizon, powers, 0) @ coefficients


def _wave_derivatives(t: Array, omega: Array, order: int) -> Array:
    """(N, 2 H) derivatives of sin(omega t) and cos(omega t) with respect to time.

    Args:
        t: (N,) times [s].
        omega: (H,) angular frequencies [rad/s].
        order: Order of the derivative.
    """
    angle = np.outer(t, omega) + 0.5 * np.pi * order
    waves = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    return waves * np.tile(omega**order, 2)


def _power_derivatives(t: Array, horizon: float, powers: np.ndarray, order: int) -> Array:
    """(N, K) derivatives of (t / horizon)^k with respect to time.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        powers: (K,) exponents k.
        order: Order of the derivative.
    """
    factors = [math.perm(k, order) for k in powers.tolist()]
    remaining = np.maximum(powers - order, 0)
    return np.asarray(np.array(factors) * (t[:, None] / horizon) ** remaining / horizon**order)


def independent_curves(curves: Array) -> Array:
    """Linearly independent curves that span the space of given curves.

    Curves may be nearly dependent, such as splines with more knots than samples, or waves that
    resemble polynomials.

    Args:
        curves: (N, M) curves.

    Returns:
        The given curves if they are independent. Otherwise (N, K < M) orthogonal curves with root
        mean square 1 / sqrt(2).
    """
    U, sizes, _ = np.linalg.svd(curves, full_matrices=False)
    kept = sizes > DEPENDENCE_TOLERANCE * sizes[0]
    if kept.sum() == curves.shape[1]:
        return curves

    return np.asarray(U[:, kept] * np.sqrt(0.5 * len(curves)))


def multisine(
    t: Array, nu: int, frequency: float, harmonics: int, rng: np.random.Generator
) -> Array:
    """Sums of harmonics with random phases and weights, each with a peak of 1.

    Args:
        t: (N,) times [s].
        nu: Number of actuators.
        frequency: Base frequency [Hz].
        harmonics: Number of multiples of the base frequency.
        rng: Source of the phases and weights.

    Returns:
        (N, nu) curves.
    """
    order = np.arange(1, harmonics + 1)
    phases = rng.uniform(0.0, 2 * np.pi, (nu, harmonics))
    weights = rng.uniform(0.2, 1.0, (nu, harmonics))

    waves = np.sin(2 * np.pi * frequency * t[:, None, None] * order + phases) * weights
    total = waves.sum(axis=2)
    return np.asarray(total / np.abs(total).max(axis=0))


def generate(signal: Signal, t: Array, names: tuple[str, ...], rest: Array) -> Array:
    """Generate the control of all actuators.

    Every actuator has a different frequency, so that the movements differ. Sines and chirps begin
    at their offset, without a jump.

    Args:
        signal: Kind of signal, its amplitude, offset and frequencies.
        t: (N,) sample times [s].
        names: nu names of the actuators.
        rest: (nu,) offset that is used if the signal states none [control unit].

    Returns:
        (N, nu) control [control unit].

    Raises:
        ExperimentError: The amplitude or the offset names an unknown actuator.
    """
    amplitude = by_name("initial.control.amplitude", signal.amplitude, names, "actuator")

    offset = np.array(rest)
    if signal.offset is not None:
        offset = by_name("initial.control.offset", signal.offset, names, "actuator")

    shape = _shape(signal, t, len(names))
    if signal.fade:
        # Value and slope are zero at the end.
        left = np.minimum((t[-1] - t) / signal.fade, 1.0)
        shape *= (left**2 * (3.0 - 2.0 * left))[:, None]
    return offset + amplitude * shape


def _shape(signal: Signal, t: Array, nu: int) -> Array:
    """(N, nu) waveform of each actuator with amplitude 1 and no offset; ones for a constant."""
    spread = 1.0 + FREQUENCY_SPREAD * np.arange(nu)

    if signal.kind == "sine":
        return np.sin(2 * np.pi * signal.frequency * t[:, None] * spread)

    if signal.kind == "chirp":
        first = signal.frequency
        last = signal.frequency_end or CHIRP_SPAN * first
        cycles = first * t + 0.5 * (last - first) * t**2 / t[-1]
        return np.asarray(np.sin(2.0 * np.pi * cycles[:, None] * spread))

    if signal.kind == "multisine":
        rng = np.random.default_rng(signal.seed)
        return multisine(t, nu, signal.frequency, signal.harmonics, rng)

    return np.ones((len(t), nu))


def keyframe(model: Any, key: str, name: str | None) -> Any:
    """Find a keyframe of a model by its name.

    Args:
        model: MjModel.
        key: Key of the experiment file that states the name, for the message.
        name: Name of the keyframe, or None.

    Returns:
        The keyframe; None without a name.

    Raises:
        ExperimentError: There is no keyframe of this name.
    """
    if name is None:
        return None

    names = names_of(model, "key")
    if name not in names:
        raise ExperimentError(f"{key}: {unknown('keyframe', name, names)}")
    return model.key(name)


def initial_state(stated: Initial, model: Any, key: Any, layout: StateLayout | None) -> Array:
    """The state in which an experiment starts.

    It is that of a keyframe, the stated numbers, or the reference state of the model. Numbers may
    be stated for the MJCF alone: coordinates that physical terms add are then at rest.

    Args:
        stated: The table `[initial]` of the experiment.
        model: MjModel.
        key: The keyframe that the table names, or None.
        layout: Where the state of the MJCF is in that of the model; None without terms.

    Returns:
        (ns,) state (qpos, qvel, act) with unit quaternions.

    Raises:
        ExperimentError: Stated numbers have the wrong length, or a quaternion is zero.
    """
    if key is not None:
        qpos, qvel, act = np.array(key.qpos), np.array(key.qvel), np.array(key.act)
    else:
        # Without terms the MJCF has the whole state.
        own = layout or StateLayout(
            qpos=np.arange(model.nq), qvel=np.arange(model.nv), act=np.arange(model.na), model=model
        )
        qpos = np.array(model.qpos0)
        if stated.qpos is not None:
            qpos = _completed("qpos", stated.qpos, model.nq, len(own.qpos), own.positions)
        zeros = np.zeros(model.nv)
        qvel = _completed("qvel", stated.qvel or zeros, model.nv, len(own.qvel), own.velocities)
        # Activations that terms add are those at the initial positions.
        zeros = np.zeros(len(own.act))
        act = _completed(
            "act",
            stated.act or zeros,
            model.na,
            len(own.act),
            lambda numbers: own.activations(numbers, qpos, None),
        )

    names = joint_names(model)
    for joint in quaternion_joints(model):
        first = quaternion_address(model, joint)
        if not np.linalg.norm(qpos[first : first + 4]) > NO_ROTATION:
            raise ExperimentError(
                f"initial.qpos: the quaternion of joint {names[joint]!r} (numbers {first} to "
                f"{first + 3}) is zero; the identity rotation is 1, 0, 0, 0"
            )
    mujoco.mj_normalizeQuat(model, qpos)
    return np.concatenate([qpos, qvel, act])


def _completed(
    name: str,
    numbers: Sequence[float] | Array,
    count: int,
    own_count: int,
    complete: Callable[[Array], Array],
) -> Array:
    """Numbers of the model; those of the MJCF alone are completed."""
    if len(numbers) == own_count:
        return complete(np.array(numbers, dtype=np.float64))
    if len(numbers) != count:
        raise ExperimentError(f"initial.{name}: {len(numbers)} numbers; this model needs {count}")
    return np.array(numbers, dtype=np.float64)
