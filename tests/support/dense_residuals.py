"""All rows of a linearised problem at once, with which tests compare the sums of a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import UnknownValues


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """All rows of a linearised problem.

    Whitened residuals of the recordings come first, then priors, then pins.

    Attributes:
        r: (n,) residuals [standard deviations].
        J: (n, c + P n_private) derivatives by the common unknowns, then by the private ones of each
            segment.
    """

    r: Array
    J: Array


def dense_residuals(problem: FitProblem, at: UnknownValues) -> Residuals:
    """All rows without a loss: recordings first, then priors and pins.

    Args:
        problem: The problem.
        at: The unknowns.

    Returns:
        Residuals with their derivatives.

    Raises:
        DivergedSegmentError: A perturbed simulation diverges.
    """
    n = problem.private_count
    residuals = []
    jacobians = []

    for batch in problem.batches(derivatives=True):
        for rows in problem.rows_of_batch(at, batch):
            _, r, J = problem.linearised(rows)
            residuals.append(r)
            jacobians.append(_wide_jacobian(problem, J[:, n:], J[:, :n], rows.segment))

    common_rows = problem.common_rows(at)
    no_private = np.zeros((len(common_rows), n))
    residuals.append(common_rows[:, -1])
    jacobians.append(_wide_jacobian(problem, common_rows[:, :-1], no_private, 0))

    for segment, private_rows in enumerate(problem.private_rows(at)):
        common, private = private_rows[:, n:-1], private_rows[:, :n]
        residuals.append(private_rows[:, -1])
        jacobians.append(_wide_jacobian(problem, common, private, segment))

    return Residuals(r=np.concatenate(residuals), J=np.concatenate(jacobians))


def _wide_jacobian(problem: FitProblem, common: Array, private: Array, segment: int) -> Array:
    """(k, c + P n) derivatives by all unknowns, for rows of one segment.

    Args:
        problem: The problem.
        common: (k, c) derivatives by the common unknowns.
        private: (k, n) derivatives by the private unknowns of the segment.
        segment: Index of the segment.
    """
    n = private.shape[1]
    c = common.shape[1]
    first = c + segment * n

    wide = np.zeros((len(common), problem.unknown_count))
    wide[:, :c] = common
    wide[:, first : first + n] = private
    return wide
