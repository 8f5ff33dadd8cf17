"""Whether a search over much data needs another linearisation, tested on a part of the data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import evenly_spread_indices
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import NextStepLength, UnknownValues

# Share of the segments of the test, and their smallest number.
TESTED_SHARE = 0.1
MIN_TESTED_SEGMENTS = 15


def next_step_on_part(problem: FitProblem) -> NextStepLength | None:
    """Make the test of a search over all segments of a problem.

    Some segments, evenly spread, are linearised anew. How much their gradients differ from those
    that the old linearisation predicts shows how far the next step would lead.

    Args:
        problem: Problem of all segments.

    Returns:
        The test; None where there are too few segments for it.
    """
    count = len(problem.segments)
    tested = evenly_spread_indices(count, int(TESTED_SHARE * count))
    if len(tested) < MIN_TESTED_SEGMENTS:
        return None
    part = problem.of_segments(tested)

    def length(condensed: Condensed, step: Step, at: UnknownValues) -> float:
        """Length of the step that follows [standard deviations]; infinite where it is unknown."""
        # A bound that stops the step leaves a gradient, which is no sign of another step.
        values = problem.common_values(at)
        if (values <= problem.lower).any() or (values >= problem.upper).any():
            return np.inf
        anew = part.condense(replace(at, private=at.private[tested]))
        if anew is None:
            return np.inf

        # The gradient is that of the old linearisation, plus what the tested segments add to it.
        predicted = condensed.gradients_after(step.common)
        change = (anew.gradients_after(np.zeros_like(step.common)) - predicted[tested]).sum(axis=0)
        rows = condensed.common_rows
        of_priors = rows[:, :-1].T @ (rows[:, :-1] @ step.common + rows[:, -1])
        gradient = predicted.sum(axis=0) + of_priors + change * (count / len(tested))
        try:
            move = np.linalg.solve(condensed.information(), gradient)
        except np.linalg.LinAlgError:
            return np.inf
        return float(np.sqrt(max(gradient @ move, 0.0)))

    return length
