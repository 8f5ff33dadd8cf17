"""Residuals of a fit: are they white noise of the stated size, and where are they largest?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.estimate import Whiteness, WorstResidual

# Number of values whose products are computed at once, at least, and times the largest lag.
VALUES_AT_ONCE = 100_000
LAGS_AT_ONCE = 8


def lagged_products(x: Array, lag: int) -> Array:
    """Sum the products of the values of a series with those some places later.

    The series is divided into parts, so that a long one needs little memory.

    Args:
        x: (M,) series without NaN.
        lag: Largest number of places.

    Returns:
        (lag+1,) sums `sum_i x_i x_(i+k)` for k from 0 to `lag`.
    """
    total = np.zeros(lag + 1)
    length = max(LAGS_AT_ONCE * lag, VALUES_AT_ONCE)
    for first in range(0, len(x), length):
        # A part and the values after it, by a circular convolution that is longer than both.
        part = x[first : first + length]
        with_following = x[first : first + length + lag]
        size = scipy.fft.next_fast_len(len(part) + lag, real=True)
        spectrum = scipy.fft.rfft(with_following, size) * scipy.fft.rfft(part, size).conj()
        total += scipy.fft.irfft(spectrum, size)[: lag + 1]
    return total


# Probability below which a test rejects that residuals are the expected noise.
SIGNIFICANCE = 1e-3

# Ratio of the size of the residuals to the stated noise, above which the difference is relevant.
RELEVANT_SIZE_RATIO = 1.03

# Variance of means over that of white noise, above which autocorrelation is relevant.
RELEVANT_INFLATION = 1.25

# Lag-1 correlation that is large enough to describe an autocorrelation.
RELEVANT_CORRELATION = 0.05

# Largest number of outputs that a message lists.
MAX_LISTED_OUTPUTS = 4

# Largest number of windows into which a recording is divided to find its largest residuals.
MAX_WINDOWS = 25

# Approximate number of values in a window. Windows with fewer values are filled up with zeros.
VALUES_PER_WINDOW = 8

# Root mean square of a window over that of the recording, above which the window is reported
# instead of the whole recording.
PEAK_RATIO = 1.5

# Neighbouring windows belong to the peak if their root mean square is at least this share of it.
PEAK_SHARE = 0.5

# Root mean square of the largest interval over that of all residuals, above which they are no noise
# that is alike everywhere.
LOCAL_RATIO = 3.0

# Smallest number of residuals of an output that can be called white.
MIN_VALUES_OF_WHITE = 50

# Number of lags of the Ljung-Box test.
LAGS = 20

# Smallest number of values, or of means of runs, from which a variance is computed.
MIN_VALUES = 8

# Ratio of the lengths of successive runs whose means are tested.
RUN_RATIO = 4

# Autocorrelation below which it counts as zero.
NO_AUTOCORRELATION = 0.05

# Number of lags up to which autocorrelation is computed first, and the factor by which there are
# more where it does not vanish.
FIRST_LAGS = 1000
LAG_GROWTH = 8

# Smallest sum of squares in a denominator.
SMALLEST_SQUARES = 1e-300


def is_larger_than_noise(chi2: float, dof: int) -> bool:
    """Whether residuals are significantly and relevantly larger than the stated noise."""
    significant = scipy.special.chdtrc(dof, chi2) < SIGNIFICANCE
    return bool(significant and np.sqrt(chi2 / dof) > RELEVANT_SIZE_RATIO)


def is_smaller_than_noise(chi2: float, dof: int) -> bool:
    """Whether residuals are significantly and relevantly smaller than the stated noise."""
    significant = scipy.special.chdtr(dof, chi2) < SIGNIFICANCE
    return bool(significant and np.sqrt(chi2 / dof) < 1.0 / RELEVANT_SIZE_RATIO)


def autocorrelated(tests: Sequence[Whiteness]) -> tuple[Whiteness, ...]:
    """Tests that find significant and relevant autocorrelation.

    Args:
        tests: Test of every output.

    Returns:
        These tests, strongest autocorrelation first.
    """
    found = [
        test
        for test in tests
        if test.p < SIGNIFICANCE / len(tests)
        and max(test.inflation, test.time) * test.variance > RELEVANT_INFLATION
    ]
    return tuple(sorted(found, key=lambda test: -test.inflation))


def are_white(tests: Sequence[Whiteness]) -> bool:
    """Whether residuals, by the tests of their outputs, are white and enough to tell."""
    is_enough = all(not 0 < test.count < MIN_VALUES_OF_WHITE for test in tests)
    return is_enough and not autocorrelated(tests)


def _autocorrelations_in_words(found: Sequence[Whiteness]) -> str:
    """How the residuals of some outputs are autocorrelated."""
    # Where neighbouring values hardly correlate, means over long runs describe it.
    listed = []
    for test in found[:MAX_LISTED_OUTPUTS]:
        words = f"long-run variance is {max(test.inflation, 1.0):.1f} times that of white noise"
        if abs(test.correlation) > RELEVANT_CORRELATION:
            words = f"lag-1 correlation {test.correlation:+.2f}"
        listed.append(f"{test.output} ({words})")
    more = len(found) - len(listed)
    return ", ".join(listed) + (f" and {more} more" if more else "")


def misfit_reasons(
    chi2: float,
    dof: int,
    noise_is_stated: bool,
    tests: Sequence[Whiteness],
    missing: Sequence[object],
    worst: WorstResidual | None = None,
) -> tuple[str, ...]:
    """Reasons why residuals are no white noise.

    White residuals that are larger than the stated noise are larger noise, unless they are too few
    to tell, or large in one interval only.

    Args:
        chi2: Sum of squared whitened residuals.
        dof: Degrees of freedom.
        noise_is_stated: Whether the noise was stated rather than estimated from the residuals.
        tests: Test of every output.
        missing: Terms that would explain residuals.
        worst: Interval in which residuals are largest; None without residuals.

    Returns:
        Sentences; none where the residuals are white noise.
    """
    reasons = []
    size = np.sqrt(chi2 / dof)
    found = autocorrelated(tests)
    is_noise = are_white(tests) and not missing
    is_local = worst is not None and worst.size > LOCAL_RATIO * size
    if noise_is_stated and is_larger_than_noise(chi2, dof) and (is_local or not is_noise):
        reasons.append(f"residuals are {size:.2f} times the stated noise")

    if found:
        reasons.append(f"residuals are autocorrelated: {_autocorrelations_in_words(found)}")
    elif missing:
        reasons.append("a term that the model lacks explains part of the residuals")
    return tuple(reasons)


def largest_interval(
    output: str, recording: str, t: Array, z: Array
) -> tuple[float, float, WorstResidual] | None:
    """The interval of a recording in which the residuals of an output are largest.

    Args:
        output: Name of the output.
        recording: Name of the recording.
        t: (M,) times of the rows [s].
        z: (M,) whitened residuals, NaN where not measured.

    Returns:
        Sums of all squares and of those in the interval, and the interval, whose share is not known
        yet; None without residuals.
    """
    measured = np.isfinite(z)
    if not measured.any():
        return None

    # Windows of equal duration.
    number = min(MAX_WINDOWS, max(int(measured.sum()) // VALUES_PER_WINDOW, 1))
    edges = np.linspace(t[0], t[-1], number + 1)
    window = np.searchsorted(edges[1:-1], t[measured], side="right")
    counts = np.bincount(window, minlength=number)
    squares = np.bincount(window, z[measured] ** 2, minlength=number)

    # The neighbouring windows in which residuals are largest; all of them where none is clearly
    # larger. Windows with few values count as if they had more: a single value is no interval.
    inside = slice(0, number)
    rms = np.sqrt(squares / np.maximum(counts, VALUES_PER_WINDOW))
    peak = int(np.argmax(rms))
    if rms[peak] > PEAK_RATIO * np.sqrt(squares.sum() / counts.sum()):
        small = np.flatnonzero(rms < PEAK_SHARE * rms[peak])
        before, after = small[small < peak], small[small > peak]
        inside = slice(int(before.max(initial=-1)) + 1, int(after.min(initial=number)))
    within = float(squares[inside].sum())
    worst = WorstResidual(
        output=output,
        recording=recording,
        begin=edges[inside.start],
        end=edges[inside.stop],
        size=float(np.sqrt(within / max(counts[inside].sum(), 1))),
        share=0.0,
    )
    return float(squares.sum()), within, worst


def worst_residual(
    found: Sequence[tuple[float, float, WorstResidual] | None],
) -> WorstResidual | None:
    """The largest of some intervals with its share of all squares; None without residuals."""
    known = [each for each in found if each is not None]
    if not known:
        return None
    total = sum(squares for squares, _, _ in known)
    _, within, worst = max(known, key=lambda each: each[2].size)
    return replace(worst, share=within / max(total, SMALLEST_SQUARES))


def whiteness_of(output: str, parts: Sequence[Array]) -> Whiteness:
    """Test whether residuals are white noise.

    The Ljung-Box test examines short lags. Variances of means over longer and longer runs show
    slow drifts.

    Args:
        output: Name of the output.
        parts: (M,) whitened residuals of every recording, NaN where not measured.

    Returns:
        The result; p is 1 where there are too few residuals.
    """
    series = [part[np.isfinite(part)] for part in parts]
    series = [part for part in series if len(part) > 1]
    count = sum(len(part) for part in series)
    squares = sum(float(part @ part) for part in series)
    variance = squares / max(count, 1)
    correlation, p, inflation, time = 0.0, 1.0, 1.0, 1.0
    if count >= 2 * MIN_VALUES and squares > 0.0:
        # Ljung & Box (1978).
        lags = min(LAGS, count // 5)
        longest_lag = max(max(len(part) for part in series) // 4, 1)
        rho = _autocorrelation(series, lags, max(lags, longest_lag))
        terms = rho[1 : lags + 1] ** 2 / (count - np.arange(1, lags + 1))
        statistic = count * (count + 2) * float(np.sum(terms))
        correlation = float(rho[1])

        # The integrated autocorrelation time ends where the autocorrelation first vanishes (initial
        # positive sequence).
        vanishing = np.flatnonzero(rho < NO_AUTOCORRELATION)
        end = int(vanishing[0]) if len(vanishing) else len(rho)
        time = float(1.0 + 2.0 * rho[1:end].sum())

        # Means over runs show slow drifts that short lags miss. The smallest probability is
        # multiplied by the number of tests (Bonferroni).
        runs = list(_run_tests(series, variance))
        probabilities = [float(scipy.special.chdtrc(lags, statistic)), *(p for _, p in runs)]
        p = min(min(probabilities) * len(probabilities), 1.0)
        inflation = max((ratio for ratio, _ in runs), default=1.0)
    return Whiteness(
        output=output,
        count=count,
        variance=variance,
        correlation=correlation,
        p=p,
        inflation=max(inflation, 1.0),
        time=time,
    )


def _autocorrelation(series: Sequence[Array], least_lag: int, longest_lag: int) -> Array:
    """(lags+1,) autocorrelation of all series together, up to a lag where it has vanished.

    The mean is not subtracted, because a constant offset is not noise either.

    Args:
        series: Residuals of every recording.
        least_lag: Lag up to which it is needed in any case.
        longest_lag: Lag up to which it is computed where it does not vanish before.
    """
    lag = min(max(least_lag, FIRST_LAGS), longest_lag)
    while True:
        products = np.sum([lagged_products(part, lag) for part in series], axis=0)
        rho = products / products[0]
        if lag >= longest_lag or (rho[least_lag:] < NO_AUTOCORRELATION).any():
            return np.asarray(rho)
        lag = min(LAG_GROWTH * lag, longest_lag)


def _run_tests(series: Sequence[Array], variance: float) -> Iterator[tuple[float, float]]:
    """Tests of means over runs of 4, 16, 64, ... values.

    Args:
        series: Residuals of every recording.
        variance: Variance of a residual.

    Yields:
        Variance of the means over that of white noise, and its probability.
    """
    length = RUN_RATIO
    while True:
        means = [
            part[: len(part) // length * length].reshape(-1, length).mean(axis=1) for part in series
        ]
        joined = np.concatenate(means)
        if len(joined) < MIN_VALUES:
            return

        statistic = length * float(joined @ joined) / variance
        yield statistic / len(joined), float(scipy.special.chdtrc(len(joined), statistic))
        length *= RUN_RATIO


# Ratio of the root mean square residual to the standard deviation of the measured values, above
# which the fit does not explain a motion.
UNEXPLAINED_SHARE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class FitQuality:
    """Residuals of a fit.

    Attributes:
        predicted: (M, ny) outputs of the fitted model for every recording [y-unit].
        chi2: Sum of squared whitened residuals; with a robust loss, of those that are not outliers.
        dof: Degrees of freedom of `chi2`.
        rms: Root mean square residual of every measured output [y-unit].
        whiteness: Test of the residuals of every output.
        worst_residual: Interval in which residuals are largest; None without residuals.
        unexplained: Names of the outputs whose motion the fit hardly explains.
    """

    predicted: tuple[Array, ...]
    chi2: float
    dof: int
    rms: dict[str, float]
    whiteness: tuple[Whiteness, ...]
    worst_residual: WorstResidual | None
    unexplained: tuple[str, ...]

    @property
    def inflation(self) -> float:
        """Ratio of the variance of sums of the residuals to that of the noise, at least 1.

        It is that of residuals that are as large and as correlated everywhere as on average.
        """
        longest = max((test.time for test in self.whiteness), default=1.0)
        return max(self.chi2 / self.dof, 1.0) * max(longest, 1.0)

    @property
    def is_white(self) -> bool:
        """Whether no output has significant autocorrelation, however small its residuals are."""
        return all(test.p >= SIGNIFICANCE / len(self.whiteness) for test in self.whiteness)


def fit_quality(problem: FitProblem, solution: Solution) -> FitQuality:
    """Assess the residuals of a solution.

    Args:
        problem: The least-squares problem.
        solution: Its solution.

    Returns:
        The quality of the fit.

    Raises:
        SimulationDivergedError: The simulation diverges at the solution.
    """
    predicted = problem.predict(solution.unknowns)
    if predicted is None:
        raise SimulationDivergedError("the simulation diverges near the estimate")

    squares = 0.0
    count = 0
    rms = {}
    unexplained = []
    whiteness = []
    largest = []

    names = problem.system.outputs.names
    for j, (name, series) in enumerate(
        zip(names, _whitened_residuals(problem, predicted), strict=True)
    ):
        # Outliers do not have the distribution of the noise. A comparison with NaN is False.
        inliers = [z[np.abs(z) <= problem.loss.outlier_threshold] for z in series]
        squares += sum(float(z @ z) for z in inliers)
        count += sum(map(len, inliers))
        whiteness.append(whiteness_of(name, series))
        largest += [
            largest_interval(name, Path(recording.name).name, recording.t, z)
            for recording, z in zip(problem.recordings, series, strict=True)
        ]

        errors = problem.errors_of(j, predicted)
        if not len(errors):
            continue

        # Residuals that are nearly as large as the motion, and larger than the noise, but no noise.
        rms[name] = float(np.sqrt(np.mean(errors**2)))
        values = [
            recording.y[mask[:, j], j]
            for recording, mask in zip(problem.recordings, problem.masks, strict=True)
        ]
        large = rms[name] > UNEXPLAINED_SHARE * float(np.std(np.concatenate(values)))
        large &= whiteness[-1].variance > 1.0 / UNEXPLAINED_SHARE**2
        if large and not are_white(whiteness[-1:]):
            unexplained.append(name)

    return FitQuality(
        predicted=tuple(predicted),
        chi2=squares / problem.loss.inlier_mean_square,
        dof=max(count - solution.condensed.rank, 1),
        rms=rms,
        whiteness=tuple(whiteness),
        worst_residual=worst_residual(largest),
        unexplained=tuple(unexplained),
    )


def _whitened_residuals(problem: FitProblem, predicted: Sequence[Array]) -> Iterator[list[Array]]:
    """Whitened measured minus predicted values, output by output, so that memory holds one of them.

    Yields:
        (M,) residuals of an output for every recording, NaN where no measured value counts.
    """
    noise = problem.noise
    data = list(zip(predicted, problem.recordings, problem.masks, strict=True))
    whitened = []
    for y, recording, mask in data if noise.correlated else ():
        z = np.full(y.shape, np.nan)
        z[mask] = noise.whiten_present(np.where(mask, recording.y - y, 0.0), mask)
        whitened.append(z)

    for j, sigma in enumerate(noise.sigma):
        series = [z[:, j] for z in whitened]
        for y, recording, mask in () if noise.correlated else data:
            z = recording.y[:, j] - y[:, j]
            z /= sigma
            z[~mask[:, j]] = np.nan
            series.append(z)
        yield series
