"""Regression splines: a smooth curve through measured values and measured slopes.

A spline of degree 5 with equidistant knots is fitted by least squares. The distance of the knots is
chosen by the Bayesian information criterion (Schwarz 1978), which weighs the fit against the number
of coefficients, so that the spline follows what is larger than the noise.

A spline takes times of any distance, missing values, and positions and velocities with different
noise. It is, away from its ends, a low-pass filter without delay that passes all frequencies up to
the one whose half period is the distance of the knots. In simulations of a cart-pendulum, a Furuta
pendulum, a double pendulum and a rail, at 100 Hz to 1 kHz and with noise of 1e-4 to 3e-2 of the
motion, it gave better parameters than zero-phase Butterworth filters with central differences, for
which no cut-off frequency suits all of these, and than penalised splines, which damp what they
pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
    """Measured values of g curves, or of their slopes, at the same times.

    Attributes:
        t: (n,) ascending times [s].
        values: (n, g) values [unit] or slopes [unit/s].
        sigma: (g,) standard deviations of their noise [as the values].
        derivative: 0 for values, 1 for slopes.
    """

    t: Array
    values: Array
    sigma: Array
    derivative: int

    def of_curve(self, curve: int) -> Readings:
        """The readings of one curve."""
        chosen = slice(curve, curve + 1)
        return Readings(
            t=self.t,
            values=self.values[:, chosen],
            sigma=self.sigma[chosen],
            derivative=self.derivative,
        )

    def kept(self, mask: np.ndarray) -> Readings:
        """Readings at some times: mask: (n,)."""
        return Readings(
            t=self.t[mask],
            values=self.values[mask],
            sigma=self.sigma,
            derivative=self.derivative,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class RegressionSpline:
    """A fitted spline.

    Attributes:
        begin: Time of its first knot [s].
        spacing: Distance of the knots [s].
        coefficients: (m,) coefficients of the B-splines [unit].
        variance: Mean square of the residuals over the stated variance of the noise.
        weights: Number of readings of values, and of slopes, per second, each over the variance of
            its noise.
    """

    begin: float
    spacing: float
    coefficients: Array
    variance: float
    weights: tuple[float, float]

    def at(self, t: Array, derivative: int = 0) -> Array:
        """Values of a derivative.

        Args:
            t: (n,) times [s]; beyond the ends of the spline, it is continued.
            derivative: Order of the derivative.

        Returns:
            (n,) values.
        """
        knots = _knots(self.begin, self.spacing, len(self.coefficients))
        spline = scipy.interpolate.BSpline(knots, self.coefficients, DEGREE)
        return np.asarray(spline(t, nu=derivative))

    @property
    def slope_sigma(self) -> float:
        """Standard deviation of the slope by the noise of the readings [unit/s].

        The noise of the readings is white, and passes up to the half frequency of the knots.
        """
        limit = np.pi / self.spacing
        omega = (np.arange(FREQUENCIES) + 0.5) / FREQUENCIES * limit
        of_values, of_slopes = self.weights
        density = omega**2 / (of_values + of_slopes * omega**2)
        variance = self.variance * float(density.mean()) * limit / np.pi
        return float(np.sqrt(variance))


def fit_splines(
    readings: Sequence[Readings], anchors: Array, *, spacing: float | None = None
) -> list[RegressionSpline]:
    """Fit splines to readings of g curves, for which the same matrices are factorised.

    Args:
        readings: Readings of values, of slopes, or of both. The noise of the slopes is the same
            multiple of that of the values for all curves.
        anchors: (g,) values at the first time, where only slopes are measured [unit].
        spacing: Distance of the knots [s]; None: it is chosen for each curve.

    Returns:
        g splines.
    """
    fit = _Fit.of(readings, anchors)
    found = fit.best() if spacing is None else fit.with_spacing(spacing)

    # Single wrong values, as of a disturbed encoder, would draw a spline to them, and hide where
    # the noise begins.
    for curve in range(len(found)):
        left = [reading.of_curve(curve) for reading in readings]
        for _ in range(MAX_OUTLIER_ROUNDS):
            kept = [reading.kept(_no_outliers(found[curve], reading)) for reading in left]
            if all(len(k.t) == len(r.t) for k, r in zip(kept, left, strict=True)):
                break
            left = kept
            again = _Fit.of(left, anchors[curve : curve + 1])
            found[curve] = (again.best() if spacing is None else again.with_spacing(spacing))[0]
    return found


def _no_outliers(spline: RegressionSpline, reading: Readings) -> np.ndarray:
    """(n,) True where a reading of a single curve is not far from its spline."""
    distance = np.abs(reading.values[:, 0] - spline.at(reading.t, reading.derivative))
    usual = SIGMA_PER_MEDIAN * float(np.median(distance))
    return np.asarray((distance <= OUTLIER * usual) | (usual == 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Fit:
    """Readings of g curves to which splines are fitted.

    Attributes:
        readings: The readings.
        anchors: (g,) values at the first time, where only slopes are measured.
        begin: First time [s].
        duration: Time from the first to the last reading [s].
        times: Number of different times.
    """

    readings: Sequence[Readings]
    anchors: Array
    begin: float
    duration: float
    times: int

    @staticmethod
    def of(readings: Sequence[Readings], anchors: Array) -> _Fit:
        """Readings to which splines are fitted."""
        t = np.unique(np.concatenate([reading.t for reading in readings]))
        return _Fit(
            readings=readings,
            anchors=anchors,
            begin=float(t[0]),
            duration=float(t[-1] - t[0]),
            times=len(t),
        )

    @property
    def most_intervals(self) -> int:
        """Largest number of knot intervals."""
        return max(int(MOST_COEFFICIENTS * self.times) - DEGREE, 1)

    def best(self) -> list[RegressionSpline]:
        """The splines with the smallest information criteria.

        The distance of the knots is halved from a long one on, and refined about the best ones.
        """
        curves = len(self.anchors)
        found: list[RegressionSpline | None] = [None] * curves
        criteria = np.full(curves, np.inf)
        counts = np.zeros(curves, dtype=int)

        def compare(intervals: int) -> bool:
            """Keep better splines of a number of knot intervals; True where there are any."""
            splines, now = self._fitted(intervals)
            better = np.flatnonzero(now < criteria)
            for curve in better.tolist():
                found[curve], criteria[curve] = splines[curve], now[curve]
                counts[curve] = intervals
            return bool(len(better))

        intervals, since = min(FEWEST_INTERVALS, self.most_intervals), 0
        while since < HALVINGS_WITHOUT_IMPROVEMENT:
            since = 0 if compare(intervals) else since + 1
            if intervals == self.most_intervals:
                break
            intervals = min(2 * intervals, self.most_intervals)

        for factor in (np.sqrt(0.5), np.sqrt(2.0)):
            for refined in np.unique(np.rint(factor * counts)).astype(int).tolist():
                if 1 <= refined <= self.most_intervals:
                    compare(refined)
        return [spline for spline in found if spline is not None]

    def with_spacing(self, spacing: float) -> list[RegressionSpline]:
        """The splines with a distance of the knots, or nearly so [s]."""
        count = int(np.clip(round(self.duration / spacing), 1, self.most_intervals))
        return self._fitted(count)[0]

    def _fitted(self, intervals: int) -> tuple[list[RegressionSpline], Array]:
        """The splines with a number of knot intervals, and their (g,) information criteria."""
        spacing = self.duration / intervals
        size = intervals + DEGREE
        bases = [self._basis(reading, spacing, size) for reading in self.readings]

        # Normal equations, whose matrix has a band.
        normal = scipy.sparse.csr_array((size, size))
        right = np.zeros((size, len(self.anchors)))
        for basis, reading in zip(bases, self.readings, strict=True):
            weight = (self.readings[0].sigma[0] / reading.sigma[0]) ** 2
            weighted = weight * basis.T
            normal = normal + weighted @ basis
            right += weighted @ reading.values

        # Slopes show a curve up to a constant, which one more row holds for now.
        without_values = all(reading.derivative for reading in self.readings)
        if without_values:
            first = scipy.sparse.csr_array(([1.0], ([0], [0])), (size, size))
            normal = normal + float(normal.diagonal().mean()) * first
        coefficients = _solved(normal, right)
        if without_values:
            at_begin = scipy.interpolate.BSpline(
                _knots(self.begin, spacing, size), coefficients, DEGREE
            )(self.begin)
            coefficients += self.anchors - at_begin

        # The variance of the noise is unknown to the criterion.
        count = sum(len(reading.t) for reading in self.readings)
        mean = np.maximum(self._squares(bases, coefficients) / count, np.finfo(float).tiny)
        criteria = count * np.log(mean) + size * np.log(count)
        splines = [
            RegressionSpline(
                begin=self.begin,
                spacing=spacing,
                coefficients=coefficients[:, curve],
                variance=float(mean[curve]) * count / max(count - size, 1),
                weights=(self._weight(0, curve), self._weight(1, curve)),
            )
            for curve in range(len(self.anchors))
        ]
        return splines, criteria

    def _squares(self, bases: Sequence[scipy.sparse.csr_array], coefficients: Array) -> Array:
        """(g,) sums of squared residuals over the variances of the noise.

        They are at least the rounding errors of the readings.
        """
        total = np.zeros(len(self.anchors))
        for basis, reading in zip(bases, self.readings, strict=True):
            errors = (reading.values - basis @ coefficients) / reading.sigma
            size = np.sum((reading.values / reading.sigma) ** 2, axis=0)
            total += np.maximum(np.sum(errors**2, axis=0), ROUNDING * size)
        return total

    def _basis(self, reading: Readings, spacing: float, size: int) -> scipy.sparse.csr_array:
        """(n, size) values at the times of readings of the B-splines, or of their derivatives."""
        knots = _knots(self.begin, spacing, size)
        t = np.clip(reading.t, knots[DEGREE], knots[-DEGREE - 1])
        if not reading.derivative:
            design = scipy.interpolate.BSpline.design_matrix(t, knots, DEGREE)
            return scipy.sparse.csr_array(design)

        # The derivative of a spline has the differences of its coefficients as coefficients.
        lower = scipy.interpolate.BSpline.design_matrix(t, knots[1:-1], DEGREE - 1)
        return scipy.sparse.csr_array(lower @ _differences(size, 1) / spacing)

    def _weight(self, derivative: int, curve: int) -> float:
        """Number of readings of a derivative per second, over the variance of their noise."""
        return sum(
            len(reading.t) / float(reading.sigma[curve]) ** 2 / self.duration
            for reading in self.readings
            if reading.derivative == derivative
        )


def _knots(begin: float, spacing: float, size: int) -> Array:
    """Knots of a number of B-splines."""
    return np.asarray(begin + spacing * np.arange(-DEGREE, size + 1), dtype=np.float64)


def _differences(size: int, order: int) -> scipy.sparse.csr_array:
    """(size - order, size) matrix of differences between successive coefficients."""
    found = scipy.sparse.eye_array(size, format="csr")
    for _ in range(order):
        found = found[1:] - found[:-1]
    return scipy.sparse.csr_array(found)


def _solved(normal: scipy.sparse.csr_array, right: Array) -> Array:
    """(m, g) solutions of normal equations, with a smooth continuation where there are no data."""
    size = len(right)
    order = min(DEGREE // 2 + 1, size - 1)
    change = _differences(size, order)
    continuation = CONTINUATION * float(normal.diagonal().mean())
    total = normal + continuation * (change.T @ change)

    band = np.zeros((DEGREE + 1, size))
    for offset in range(min(DEGREE + 1, size)):
        band[DEGREE - offset, offset:] = total.diagonal(offset)
    return np.asarray(scipy.linalg.solveh_banded(band, right))
