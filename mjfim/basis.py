"""Curves that a control may follow: linear combinations of a few functions of time. Arrays only."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline

from mjfim.trajectory import Array

DEGREE = 3
FAINT = 1e-5  # size of a combination of curves, over the largest


def spline_basis(t: Array, horizon: float, bandwidth: float, begins: bool, ends: bool, periodic: bool) -> Array:
    """(N, M) cubic B-splines at times t: (N,) [s] with a knot every 1/(2 bandwidth) s.

    begins, ends: value and slope are zero there;  periodic: the curve and two derivatives meet at the ends
    """
    pieces = max(int(np.ceil(2.0 * bandwidth * horizon)), DEGREE + 1)
    knots = horizon / pieces * np.arange(-DEGREE, pieces + DEGREE + 1)
    if periodic:
        values = BSpline.design_matrix(t, knots, DEGREE).toarray()
        values[:, :DEGREE] += values[:, pieces:]
        return np.asarray(values[:, :pieces])
    knots = np.clip(knots, 0.0, horizon)
    values = BSpline.design_matrix(t, knots, DEGREE).toarray()
    return np.asarray(values[:, 2 * begins : values.shape[1] - 2 * ends])


def fourier_basis(t: Array, horizon: float, frequency: float, harmonics: int, begins: bool, ends: bool) -> Array:
    """(N, 2 harmonics) sines and cosines of multiples of a base frequency [Hz], each of size 1.

    Where the curve has to begin or end at rest, the polynomial of least degree that has the same value and first two
    derivatives there is taken off (a finite Fourier series with a quintic, as for point-to-point excitation).
    """
    omega = 2.0 * np.pi * frequency * np.arange(1, harmonics + 1)

    def waves(times: Array, order: int) -> Array:
        angle = np.outer(times, omega) + 0.5 * np.pi * order
        return np.asarray(np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * np.tile(omega**order, 2))

    places = [*([0.0] if begins else []), *([horizon] if ends else [])]
    conditions = [(place, order) for place in places for order in range(3)]
    if not conditions:
        return waves(t, 0)
    powers = np.arange(len(conditions))

    def polynomials(times: Array, order: int) -> Array:
        factor = np.array([np.prod(np.arange(k - order + 1, k + 1)) if k >= order else 0.0 for k in powers])
        return np.asarray(factor * (times[:, None] / horizon) ** np.maximum(powers - order, 0) / horizon**order)

    system = np.concatenate([polynomials(np.array([place]), order) for place, order in conditions])
    wanted = np.concatenate([waves(np.array([place]), order) for place, order in conditions])
    return waves(t, 0) - polynomials(t, 0) @ np.linalg.solve(system, wanted)


def independent(curves: Array) -> Array:
    """(N, M) curves, or fewer that span the same but for what is faint: splines finer than samples, waves like polynomials."""
    U, sizes, _ = np.linalg.svd(curves, full_matrices=False)
    kept = sizes > FAINT * sizes[0]
    if kept.sum() == curves.shape[1]:
        return curves
    return np.asarray(U[:, kept] * np.sqrt(0.5 * len(curves)))
