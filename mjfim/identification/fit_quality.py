"""What a fit leaves: predictions, whitened residuals, their size, whether they are white, where they are worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.residual_tests import whiteness, worst_place
from mjfim.identification.residuals import FitProblem
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.estimate import Whiteness, WorstResidual

# root mean square of residuals over the deviation of what was measured, from which a motion is not explained
HARDLY = 0.5


@dataclass(frozen=True, eq=False)
class FitQuality:
    """predicted: (M, ny) of every recording;  chi2: whitened squares;  dof: degrees of freedom;  rms: by output

    white: of every output;  worst: place;  unexplained: outputs whose motion the fit hardly explains
    """

    predicted: tuple[Array, ...]
    chi2: float
    dof: int
    rms: dict[str, float]
    white: tuple[Whiteness, ...]
    worst: WorstResidual | None
    unexplained: tuple[str, ...]

    def times(self, rows: int) -> list[float]:
        """Rows of the recordings, of all together so many, over which the residuals of each output hang together."""
        return [w.time * rows / max(w.count, 1) for w in self.white]


def fit_quality(fit: FitProblem, solution: Solution) -> FitQuality:
    """Of a solution. Raises SimulationDivergedError."""
    values, names = fit.predicted(solution.unknowns), fit.system.outputs.names
    if values is None:
        raise SimulationDivergedError("the simulation diverges near the estimate")
    whitened = _whitened(fit, values)
    inside = _inside(fit, whitened)
    columns = [np.concatenate([z[:, j] for z in whitened]) for j in range(len(names))]
    rms, unexplained = {}, []
    for j, (name, r) in enumerate(zip(names, fit.errors(values), strict=True)):
        if not len(r):
            continue
        rms[name] = float(np.sqrt(np.mean(r**2)))
        moved = float(
            np.std(
                np.concatenate(
                    [t.y[m[:, j], j] for t, m in zip(fit.aligned, fit.masks, strict=True)]
                )
            )
        )
        if rms[name] > HARDLY * moved and float(np.nanmean(columns[j] ** 2)) > 1.0 / HARDLY**2:
            unexplained.append(name)
    tracks = fit.aligned
    return FitQuality(
        tuple(values),
        float(np.nansum(inside**2)) / fit.loss.inlier_mean_square,
        max(int(np.isfinite(inside).sum()) - solution.condensed.rank, 1),
        rms,
        tuple(whiteness(name, [z[:, j] for z in whitened]) for j, name in enumerate(names)),
        worst_place(names, [Path(t.name).name for t in tracks], [t.t for t in tracks], whitened),
        tuple(unexplained),
    )


def _whitened(fit: FitProblem, values: Sequence[Array]) -> list[Array]:
    """(M, ny) whitened measured - predicted of every recording, NaN where nothing counts."""
    out = []
    for y, track, mask in zip(values, fit.aligned, fit.masks, strict=True):
        z = np.full(y.shape, np.nan)
        z[mask] = fit.noise.whiten_present(np.where(mask, track.y - y, 0.0), mask)
        out.append(z)
    return out


def _inside(fit: FitProblem, whitened: Sequence[Array]) -> Array:
    """All whitened residuals; with a robust loss without outliers."""
    every = np.concatenate([z.ravel() for z in whitened])
    return np.where(np.abs(every) <= fit.loss.outlier_threshold, every, np.nan)
