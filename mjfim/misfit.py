"""The verdict on a fit: are the residuals noise of the stated size, and if not, which output and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from mjfim.trajectory import Array
from mjfim.whiteness import Whiteness

MISFIT = 1e-3  # probability below which residuals are not noise
LARGER = 1.03  # residuals over the stated noise from which that matters
INFLATED = 1.25  # variance of means over that of white noise from which it matters
SHOWS = 0.05  # correlation of one residual with the next that is worth telling
WINDOWS = 25  # of a recording, looked at one by one
FEWEST = 8  # values of a window, about
STICKS_OUT = 1.5  # root mean square of a window over that of all


@dataclass(frozen=True)
class Place:
    """Where residuals are worst. begin, end: [s];  size: their root mean square in sigmas;  share: of all squares"""

    output: str
    recording: str
    begin: float
    end: float
    size: float
    share: float

    def __str__(self) -> str:
        when = f"{self.begin:.3g} to {self.end:.3g} s of {self.recording}"
        return f"worst in {self.output}, {when}: {self.size:.2g} sigmas, {100 * self.share:.0f} % of all squares"


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
) -> Place | None:
    """The window, or run of neighbouring ones, where whitened residuals: (M, ny) per recording are largest.

    None where there are none. A run that does not stand out is widened to the whole recording.
    """
    total = sum(float(np.nansum(z**2)) for z in whitened)
    best: Place | None = None
    for name, t, z in zip(names, times, whitened, strict=True):
        for j, output in enumerate(outputs):
            seen = np.isfinite(z[:, j])
            if not seen.any():
                continue
            edges = np.linspace(t[0], t[-1] * (1 + 1e-12), min(WINDOWS, max(int(seen.sum()) // FEWEST, 1)) + 1)
            window = np.clip(np.searchsorted(edges, t, side="right") - 1, 0, len(edges) - 2)
            counts = np.bincount(window[seen], minlength=len(edges) - 1)
            squares = np.bincount(window[seen], weights=z[seen, j] ** 2, minlength=len(edges) - 1)
            rms = np.sqrt(squares / np.maximum(counts, FEWEST))  # a single value is no place
            peak, floor = int(np.argmax(rms)), STICKS_OUT * float(np.sqrt(squares.sum() / counts.sum()))
            first, last = _run(rms, peak, 0.5 * rms[peak]) if rms[peak] > floor else (0, len(rms) - 1)
            inside = slice(first, last + 1)
            size = float(np.sqrt(squares[inside].sum() / max(counts[inside].sum(), 1)))
            place = Place(
                output, name, edges[first], edges[last + 1], size, float(squares[inside].sum() / max(total, 1e-300))
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
