"""Regression splines: a smooth curve through measured values and measured slopes.

A spline of degree 5 with equidistant knots is fitted to the readings by least squares. The number
of its knots has the smallest information criterion of Schwarz, n log(mean square) + m log n: more
of them follow noise, fewer do not follow the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mjfim.arrays import Array

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

# Rounds in which outliers are left out, at most: a spline through outliers hides smaller ones.
MAX_OUTLIER_ROUNDS = 3

# Standard deviation of normal noise over its median absolute value.
SIGMA_PER_MEDIAN = 1.4826

# Number of frequencies at which the noise of a derivative is integrated.
FREQUENCIES = 400


@dataclass(frozen=True, kw_only=True, eq=False)
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
        spacing: Distance of its knots [s].
        variance: Mean square of the residuals over the stated variances.
        weights: Values and slopes per second, over the variances of their noise.
    """

    curve: scipy.interpolate.BSpline
    spacing: float
    variance: float
    weights: tuple[float, float]

    def at(self, t: Array, derivative: int = 0) -> Array:
        """(n,) values of a derivative at the times t: (n,)."""
        return np.asarray(self.curve(t, nu=derivative))

    @property
    def slope_sigma(self) -> float:
        """Standard deviation of the slope by the noise of the readings [unit/s].

        The spline passes all frequencies up to pi / spacing.
        """
        limit = np.pi / self.spacing
        omega = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * limit
        of_values, of_slopes = self.weights
        density = omega**2 / (of_values + of_slopes * omega**2)
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
    kept = (distance <= OUTLIER * usual) | (usual == 0.0)
    return replace(reading, t=reading.t[kept], values=reading.values[kept])


def _chosen(readings: Sequence[Readings], anchor: float, spacing: float | None) -> RegressionSpline:
    """The spline with a distance of the knots, or that with the smallest criterion."""
    times = np.unique(np.concatenate([reading.t for reading in readings]))
    duration = float(times[-1] - times[0])
    most = max(int(MOST_COEFFICIENTS * len(times)) - DEGREE, 1)
    if spacing is not None:
        count = int(np.clip(round(duration / spacing), 1, most))
        return _fitted(readings, anchor, times, count)[1]

    intervals, since = min(FEWEST_INTERVALS, most), 0
    least, best, chosen = np.inf, None, intervals
    while since < HALVINGS_WITHOUT_IMPROVEMENT:
        criterion, spline = _fitted(readings, anchor, times, intervals)
        since += 1
        if best is None or criterion < least:
            least, best, chosen, since = criterion, spline, intervals, 0
        if intervals == most:
            break
        intervals = min(2 * intervals, most)
    for factor in (np.sqrt(0.5), np.sqrt(2.0)):
        criterion, spline = _fitted(
            readings, anchor, times, int(np.clip(round(factor * chosen), 1, most))
        )
        if best is None or criterion < least:
            least, best = criterion, spline
    assert best is not None
    return best


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
