"""Basis functions of controls: splines of a bandwidth, Fourier series, and multisines."""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array

# Degree of the splines.
SPLINE_DEGREE = 3

# Curves are linearly dependent if a singular value is below this fraction of the largest one.
DEPENDENCE_TOLERANCE = 1e-5


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

    times = []
    if starts_at_rest:
        times.append(0.0)
    if ends_at_rest:
        times.append(horizon)
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
    return np.asarray(waves * np.tile(omega**order, 2))


def _power_derivatives(t: Array, horizon: float, powers: np.ndarray, order: int) -> Array:
    """(N, K) derivatives of (t / horizon)^k with respect to time.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        powers: (K,) exponents k.
        order: Order of the derivative.
    """
    factors = [
        np.prod(np.arange(k - order + 1, k + 1)) if k >= order else 0.0 for k in powers.tolist()
    ]
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
