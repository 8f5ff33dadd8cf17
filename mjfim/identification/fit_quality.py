"""Quality of a fit: predictions, size and whiteness of the residuals, and their largest values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.residual_tests import find_worst_residual, whiteness_of
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.estimate import Whiteness, WorstResidual

# Ratio of the root mean square residual to the standard deviation of the measured values, above
# which the fit does not explain a motion.
UNEXPLAINED_SHARE = 0.5

# Number of rows that are whitened at once.
ROWS_AT_ONCE = 100_000


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

    def correlation_rows(self, rows: int) -> list[float]:
        """Autocorrelation times of the residuals.

        Args:
            rows: Number of rows of all recordings.

        Returns:
            One time for every output, in rows of the recordings.
        """
        return [test.time * rows / max(test.count, 1) for test in self.whiteness]


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

    names = problem.system.outputs.names
    recordings = problem.recordings
    whitened = _whitened_residuals(problem, predicted)
    by_output = [[z[:, j] for z in whitened] for j in range(len(names))]

    squares, count = _inliers(problem, by_output)
    chi2 = squares / problem.loss.inlier_mean_square
    dof = max(count - solution.condensed.rank, 1)

    rms = {}
    unexplained = []
    for j, name in enumerate(names):
        errors = problem.errors_of(j, predicted)
        if not len(errors):
            continue

        rms[name] = float(np.sqrt(np.mean(errors**2)))
        mean_square = float(np.nanmean(np.concatenate(by_output[j]) ** 2))

        # Residuals that are nearly as large as the motion, and larger than the noise.
        large = rms[name] > UNEXPLAINED_SHARE * _measured_deviation(problem, j)
        if large and mean_square > 1.0 / UNEXPLAINED_SHARE**2:
            unexplained.append(name)

    return FitQuality(
        predicted=tuple(predicted),
        chi2=chi2,
        dof=dof,
        rms=rms,
        whiteness=tuple(
            whiteness_of(name, series) for name, series in zip(names, by_output, strict=True)
        ),
        worst_residual=find_worst_residual(
            names,
            [Path(recording.name).name for recording in recordings],
            [recording.t for recording in recordings],
            whitened,
        ),
        unexplained=tuple(unexplained),
    )


def _measured_deviation(problem: FitProblem, output: int) -> float:
    """Standard deviation of the measured values of an output over all recordings [y-unit]."""
    values = [
        recording.y[mask[:, output], output]
        for recording, mask in zip(problem.recordings, problem.masks, strict=True)
    ]
    return float(np.std(np.concatenate(values)))


def _whitened_residuals(problem: FitProblem, predicted: Sequence[Array]) -> list[Array]:
    """(M, ny) whitened measured minus predicted values of every recording.

    They are NaN where there is no measured value that counts.
    """
    data = zip(predicted, problem.recordings, problem.masks, strict=True)

    whitened = []
    for y, recording, mask in data:
        z = np.full(y.shape, np.nan)

        # Long recordings are whitened in parts, so that no further copy of them is made.
        for first in range(0, len(y), ROWS_AT_ONCE):
            rows = slice(first, first + ROWS_AT_ONCE)
            counted = mask[rows]
            difference = np.where(counted, recording.y[rows] - y[rows], 0.0)
            z[rows][counted] = problem.noise.whiten_present(difference, counted)
        whitened.append(z)
    return whitened


def _inliers(problem: FitProblem, by_output: Sequence[Sequence[Array]]) -> tuple[float, int]:
    """Sum of squares and number of the whitened residuals that are no outliers.

    Outliers do not count, because they do not have the distribution of the noise.
    """
    squares = 0.0
    count = 0
    for parts in by_output:
        for z in parts:
            # A comparison with NaN is False.
            inliers = z[np.abs(z) <= problem.loss.outlier_threshold]
            squares += float(inliers @ inliers)
            count += len(inliers)
    return squares, count
