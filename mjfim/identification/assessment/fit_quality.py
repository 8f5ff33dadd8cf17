"""Quality of a fit: predictions, size and whiteness of the residuals, and their largest values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.assessment.residual_tests import LargestResidual, whiteness_of
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.estimate import Whiteness, WorstResidual

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

    recordings = [Path(recording.name).name for recording in problem.recordings]
    times = [recording.t for recording in problem.recordings]
    squares = 0.0
    count = 0
    rms = {}
    unexplained = []
    whiteness = []
    largest = LargestResidual()

    names = problem.system.outputs.names
    for j, (name, series) in enumerate(
        zip(names, _whitened_residuals(problem, predicted), strict=True)
    ):
        # Outliers do not have the distribution of the noise. A comparison with NaN is False.
        inliers = [z[np.abs(z) <= problem.loss.outlier_threshold] for z in series]
        squares += sum(float(z @ z) for z in inliers)
        count += sum(map(len, inliers))
        whiteness.append(whiteness_of(name, series))
        largest = largest.with_output(name, recordings, times, series)

        errors = problem.errors_of(j, predicted)
        if not len(errors):
            continue

        # Residuals that are nearly as large as the motion, and larger than the noise.
        rms[name] = float(np.sqrt(np.mean(errors**2)))
        values = [
            recording.y[mask[:, j], j]
            for recording, mask in zip(problem.recordings, problem.masks, strict=True)
        ]
        large = rms[name] > UNEXPLAINED_SHARE * float(np.std(np.concatenate(values)))
        if large and float(np.nanmean(np.concatenate(series) ** 2)) > 1.0 / UNEXPLAINED_SHARE**2:
            unexplained.append(name)

    return FitQuality(
        predicted=tuple(predicted),
        chi2=squares / problem.loss.inlier_mean_square,
        dof=max(count - solution.condensed.rank, 1),
        rms=rms,
        whiteness=tuple(whiteness),
        worst_residual=largest.interval,
        unexplained=tuple(unexplained),
    )


def _whitened_residuals(problem: FitProblem, predicted: Sequence[Array]) -> Iterator[list[Array]]:
    """Whitened measured minus predicted values, output by output, so that memory holds one of them.

    Yields:
        (M,) residuals of an output for every recording, NaN where no measured value counts.
    """
    noise = problem.noise
    if noise.correlated:
        yield from _correlated_residuals(problem, predicted)
        return

    data = list(zip(predicted, problem.recordings, problem.masks, strict=True))
    for j, sigma in enumerate(noise.sigma):
        series = []
        for y, recording, mask in data:
            z = recording.y[:, j] - y[:, j]
            z /= sigma
            z[~mask[:, j]] = np.nan
            series.append(z)
        yield series


def _correlated_residuals(problem: FitProblem, predicted: Sequence[Array]) -> Iterator[list[Array]]:
    """Whitened residuals, output by output, where the noise of the outputs is correlated."""
    whitened = []
    for y, recording, mask in zip(predicted, problem.recordings, problem.masks, strict=True):
        z = np.full(y.shape, np.nan)
        difference = np.where(mask, recording.y - y, 0.0)
        z[mask] = problem.noise.whiten_present(difference, mask)
        whitened.append(z)
    yield from ([z[:, j] for z in whitened] for j in range(len(problem.noise.sigma)))
