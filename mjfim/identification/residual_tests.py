"""The verdict on a fit: are the residuals noise of the stated size, and if not, which output and when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2
from scipy.stats import chi2 as chi2_distribution

from mjfim.arrays import Array
from mjfim.records.estimate import Whiteness, WorstResidual

MISFIT = 1e-3  # probability below which residuals are not noise
LARGER = 1.03  # residuals over the stated noise from which that matters
INFLATED = 1.25  # variance of means over that of white noise from which it matters
SHOWS = 0.05  # correlation of one residual with the next that is worth telling
WINDOWS = 25  # of a recording, looked at one by one
VALUES_PER_WINDOW = 8  # values of a window, about
STICKS_OUT = 1.5  # root mean square of a window over that of all


def larger(chi2: float, dof: int) -> bool:
    """Residuals are larger than the stated noise."""
    return bool(chi2_distribution.sf(chi2, dof) < MISFIT and np.sqrt(chi2 / dof) > LARGER)


def smaller(chi2: float, dof: int) -> bool:
    """Residuals are smaller than the stated noise."""
    return bool(chi2_distribution.cdf(chi2, dof) < MISFIT and np.sqrt(chi2 / dof) < 1.0 / LARGER)


def coloured(found: Sequence[Whiteness]) -> tuple[Whiteness, ...]:
    """Outputs whose residuals follow one another, by more than the noise would hide, the worst first."""
    level = MISFIT / max(len(found), 1)
    hit = [w for w in found if w.p < level and max(w.inflation, w.time) * w.variance > INFLATED]
    return tuple(sorted(hit, key=lambda w: -w.inflation))


def reasons(
    chi2: float, dof: int, stated: bool, found: Sequence[Whiteness], missing: Sequence[object]
) -> tuple[str, ...]:
    """Why residuals are not the noise that they should be, in sentences; none where they are.

    stated: the sigmas were;  missing: terms that would explain the residuals
    """
    said = []
    if stated and larger(chi2, dof):
        said.append(f"residuals are {np.sqrt(chi2 / dof):.2f} x the stated noise")
    hit = coloured(found)
    if hit:
        names = ", ".join(f"{w.output} ({_how(w)})" for w in hit[:4])
        more = f" and {len(hit) - 4} more" if len(hit) > 4 else ""
        said.append(f"residuals follow one another in {names}{more}")
    elif missing:
        said.append("a term that the model lacks explains some of the residuals")
    return tuple(said)


def _how(found: Whiteness) -> str:
    """In which way residuals follow one another: from each to the next, or only over longer runs."""
    if abs(found.correlation) > SHOWS:
        return f"{found.correlation:+.2f} from one to the next"
    return f"means of many scatter {np.sqrt(max(found.inflation, 1.0)):.1f} x as much as those of noise"


def worst_place(
    outputs: Sequence[str], names: Sequence[str], times: Sequence[Array], whitened: Sequence[Array]
) -> WorstResidual | None:
    """The window, or run of neighbouring ones, where whitened residuals: (M, ny) per recording are largest.

    None where there are none. A run that does not stand out is widened to the whole recording.
    """
    total = sum(float(np.nansum(z**2)) for z in whitened)
    best: WorstResidual | None = None
    for name, t, z in zip(names, times, whitened, strict=True):
        for j, output in enumerate(outputs):
            seen = np.isfinite(z[:, j])
            if not seen.any():
                continue
            edges = np.linspace(
                t[0],
                t[-1] * (1 + 1e-12),
                min(WINDOWS, max(int(seen.sum()) // VALUES_PER_WINDOW, 1)) + 1,
            )
            window = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(edges) - 2)
            counts = np.bincount(window[seen], minlength=len(edges) - 1)
            squares = np.bincount(window[seen], weights=z[seen, j] ** 2, minlength=len(edges) - 1)
            rms = np.sqrt(
                squares / np.maximum(counts, VALUES_PER_WINDOW)
            )  # a single value is no place
            peak, floor = (
                int(np.argmax(rms)),
                STICKS_OUT * float(np.sqrt(squares.sum() / counts.sum())),
            )
            first, last = (
                _run(rms, peak, 0.5 * rms[peak]) if rms[peak] > floor else (0, len(rms) - 1)
            )
            inside = slice(first, last + 1)
            size = float(np.sqrt(squares[inside].sum() / max(counts[inside].sum(), 1)))
            place = WorstResidual(
                output=output,
                recording=name,
                begin=edges[first],
                end=edges[last + 1],
                size=size,
                share=float(squares[inside].sum() / max(total, 1e-300)),
            )
            if best is None or place.size > best.size:
                best = place
    return best


def _run(values: Array, peak: int, least: float) -> tuple[int, int]:
    """First and last of the neighbours of a peak that are at least so large."""
    first = last = peak
    while first > 0 and values[first - 1] >= least:
        first -= 1
    while last < len(values) - 1 and values[last + 1] >= least:
        last += 1
    return first, last


LAGS = 20
FEWEST = 8  # means that a variance is taken of
RUN = 4  # factor between the lengths of runs
CUT = 0.05  # autocorrelation that counts as none


def whiteness(output: str, parts: Sequence[Array]) -> Whiteness:
    """parts: whitened residuals of one output, one array for each recording, NaN where not measured."""
    series = [part[np.isfinite(part)] for part in parts]
    series = [part for part in series if len(part) > 1]
    count = sum(len(part) for part in series)
    square = sum(float(part @ part) for part in series)
    if count < 2 * FEWEST or not square > 0.0:
        return Whiteness(
            output=output,
            count=count,
            variance=square / max(count, 1),
            correlation=0.0,
            p=1.0,
            inflation=1.0,
            time=1.0,
        )
    lags = min(LAGS, count // 5)
    rho = _autocorrelation(series, max(lags, _reach(series)))
    statistic = (
        count
        * (count + 2)
        * float(np.sum(rho[1 : lags + 1] ** 2 / (count - np.arange(1, lags + 1))))
    )
    ratios = list(_ratios(series, square / count))
    chances = [float(chi2.sf(statistic, lags)), *(p for _, p in ratios)]
    inflation = max((ratio for ratio, _ in ratios), default=1.0)
    p = min(min(chances) * len(chances), 1.0)
    return Whiteness(
        output=output,
        count=count,
        variance=square / count,
        correlation=float(rho[1]),
        p=p,
        inflation=max(inflation, 1.0),
        time=_integrated(rho),
    )


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
