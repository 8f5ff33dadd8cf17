"""The least-squares problem of a fit that estimates the noise together with the parameters.

The standard deviation of every output is that of its residuals, at any value of the unknowns. What
remains of minus the logarithm of the likelihood is `sum_j n_j / 2 log(mean square of output j)`.
Its gradient is that of the sum of squares with this noise. One search therefore finds parameters
and noise: it weights the residuals anew with every linearisation.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.noise import Noise

# Relative change of a standard deviation below which a linearisation with the old one still holds.
LASTING_CHANGE = 0.01


class EstimatedNoiseProblem:
    """Parameters and noise as one problem; a `levenberg_marquardt.Problem`.

    Args:
        problem: The problem with the stated noise, and without a robust loss.
        smallest: (ny,) smallest standard deviations [y-unit].
    """

    def __init__(self, problem: FitProblem, smallest: Array) -> None:
        self.problem = problem
        self._smallest = smallest

        # Fitted parameters make residuals smaller than the noise.
        counts = np.sum([mask.sum(axis=0) for mask in problem.masks], axis=0)
        total = int(counts.sum())
        self._counts = counts
        self._correction = total / max(total - problem.unknown_count, 1)

        # A linearisation follows the cost at the same unknowns, and needs the same squares.
        self._latest: tuple[UnknownValues, Array | None] | None = None

        # The problem with the noise with which the latest linearisation is weighted.
        self.linearised = problem

    @property
    def lower(self) -> Array:
        """(c,) lower bounds of the common unknowns."""
        return self.problem.lower

    @property
    def upper(self) -> Array:
        """(c,) upper bounds of the common unknowns."""
        return self.problem.upper

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step. See `FitProblem.moved`."""
        return self.problem.moved(at, step, fraction)

    def common_values(self, at: UnknownValues) -> Array:
        """Values of the common unknowns. See `FitProblem.common_values`."""
        return self.problem.common_values(at)

    def cost(self, at: UnknownValues) -> float:
        """Minus the logarithm of the likelihood, the noise being that of the residuals.

        Below the smallest standard deviation it goes on as the sum of squares with that noise.

        Args:
            at: The unknowns.

        Returns:
            The cost, without a constant; infinite where a simulation diverges.
        """
        squares = self._squares(at)
        if squares is None:
            return np.inf

        measured = self._counts > 0
        ratio = self._variances(squares)[measured] / self._smallest[measured] ** 2
        of_outputs = np.where(ratio > 1.0, 1.0 + np.log(np.maximum(ratio, 1.0)), ratio)
        of_data = self._counts[measured] / self._correction @ of_outputs
        return 0.5 * float(of_data) + self.problem.prior_cost(at)

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearise about the unknowns, with the noise of the residuals there.

        Args:
            at: The unknowns.

        Returns:
            The linearisation; None where a simulation diverges.
        """
        if self._squares(at) is None:
            return None
        weighted = self.weighted(at)
        condensed = weighted.condense(at)
        if condensed is not None:
            self.linearised = weighted
        return condensed

    def lasting_noise(self, at: UnknownValues) -> Noise | None:
        """Noise with which the latest linearisation is weighted, where it still holds.

        Args:
            at: Unknowns to which the linearisation led.

        Returns:
            The noise; None where the noise of the residuals at the unknowns is another one.
        """
        noise = self.linearised.noise
        change = np.abs(self.weighted(at).noise.sigma / noise.sigma - 1.0)
        return noise if change.max() < LASTING_CHANGE else None

    def weighted(self, at: UnknownValues) -> FitProblem:
        """The problem with the noise of the residuals.

        Args:
            at: The unknowns.

        Returns:
            The problem; with the stated noise where a simulation diverges.
        """
        squares = self._squares(at)
        if squares is None:
            return self.problem
        noise = self.problem.noise
        variances = np.maximum(self._variances(squares), self._smallest**2)
        variances = np.where(self._counts > 0, variances, noise.sigma**2)
        return self.problem.with_noise(Noise(covariance=np.diag(variances), strides=noise.strides))

    def cost_of_squares(self, noise: Noise, at: UnknownValues) -> float:
        """Cost of the problem with some noise of independent outputs.

        Args:
            noise: The noise, such as that of the latest linearisation.
            at: The unknowns.

        Returns:
            Half of the sum of squares; infinite where a simulation diverges.
        """
        squares = self._squares(at)
        if squares is None:
            return np.inf
        return 0.5 * float(np.sum(squares / noise.sigma**2)) + self.problem.prior_cost(at)

    def _variances(self, squares: Array) -> Array:
        """(ny,) variances of the residuals from their (ny,) sums of squares."""
        return np.asarray(squares * self._correction / np.maximum(self._counts, 1))

    def _squares(self, at: UnknownValues) -> Array | None:
        """(ny,) sums of squared errors of every output; None where a simulation diverges."""
        if self._latest is None or self._latest[0] is not at:
            self._latest = at, self.problem.squares(at)
        return self._latest[1]
