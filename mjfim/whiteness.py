"""Are residuals noise? Ljung-Box over short lags, and the variance of means over ever longer runs.

Of white noise, w times the variance of means of w successive values is the variance of the values; what drifts, rings or sticks
shows as more. Borders of recordings are not crossed; what lies on both sides of a gap counts as successive.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2

from mjfim.trajectory import Array

LAGS = 20
FEWEST = 8  # means that a variance is taken of
RUN = 4  # factor between the lengths of runs
CUT = 0.05  # autocorrelation that counts as none


@dataclass(frozen=True)
class Whiteness:
    """Of one output's whitened residuals. count: of them;  variance: their mean square;  correlation: of one with the next

    p: probability that white noise looks so, corrected for the number of looks;  inflation: largest variance of the mean of a
    run over that of white noise;  time: rows over which residuals hang together (integrated autocorrelation)
    """

    output: str
    count: int
    variance: float
    correlation: float
    p: float
    inflation: float
    time: float


def whiteness(output: str, parts: Sequence[Array]) -> Whiteness:
    """parts: whitened residuals of one output, one array for each recording, NaN where not measured."""
    series = [part[np.isfinite(part)] for part in parts]
    series = [part for part in series if len(part) > 1]
    count = sum(len(part) for part in series)
    square = sum(float(part @ part) for part in series)
    if count < 2 * FEWEST or not square > 0.0:
        return Whiteness(output, count, square / max(count, 1), 0.0, 1.0, 1.0, 1.0)
    lags = min(LAGS, count // 5)
    rho = _autocorrelation(series, max(lags, _reach(series)))
    statistic = count * (count + 2) * float(np.sum(rho[1 : lags + 1] ** 2 / (count - np.arange(1, lags + 1))))
    ratios = list(_ratios(series, square / count))
    chances = [float(chi2.sf(statistic, lags)), *(p for _, p in ratios)]
    inflation = max((ratio for ratio, _ in ratios), default=1.0)
    p = min(min(chances) * len(chances), 1.0)
    return Whiteness(output, count, square / count, float(rho[1]), p, max(inflation, 1.0), _integrated(rho))


def _autocorrelation(series: Sequence[Array], reach: int) -> Array:
    """(reach+1,) of all series together, each about zero: a constant offset of residuals is no noise either."""
    total = np.zeros(reach + 1)
    for part in series:
        full = correlate(part, part, method="fft")[len(part) - 1 :][: reach + 1]
        total[: len(full)] += full
    return np.asarray(total / total[0])


def _reach(series: Sequence[Array]) -> int:
    """Longest lag at which the autocorrelation is worth a look."""
    return max(max(len(part) for part in series) // 4, 1)


def _integrated(rho: Array) -> float:
    """`1 + 2 sum rho`, up to where it first vanishes (the initial positive sequence)."""
    below = np.flatnonzero(rho < CUT)
    end = int(below[0]) if len(below) else len(rho)
    return float(1.0 + 2.0 * rho[1:end].sum())


def _ratios(series: Sequence[Array], variance: float) -> Iterator[tuple[float, float]]:
    """Variance of the mean of a run over that of white noise, and its probability, for ever longer runs."""
    run = RUN
    while True:
        means = [part[: len(part) // run * run].reshape(-1, run).mean(axis=1) for part in series]
        joined = np.concatenate(means)
        if len(joined) < FEWEST:
            return
        total = run * float(joined @ joined) / variance
        yield total / len(joined), float(chi2.sf(total, len(joined)))
        run *= RUN
