"""Duration of a fit, estimated before it begins."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.duration import estimated_seconds
from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.sensitivity_rows import sensitivity_rows
from mjfim.records.trajectory import Recording


def pass_seconds(system: System, recordings: Sequence[Recording]) -> float | None:
    """Estimate the time of one pass over all data, which gives the derivatives of the residuals.

    Args:
        system: The system whose parameters are fitted.
        recordings: The recordings.

    Returns:
        The time [s]; None where the first rows cannot be evaluated.
    """
    rows = sum(len(recording.t) for recording in recordings)
    longest = max(recordings, key=lambda recording: len(recording.t))

    def differentiate(count: int) -> None:
        """Compute the derivatives of the first rows of the longest recording."""
        part = longest.first_rows(max(count, 2))
        problem = FitProblem.of(system, [part])
        sensitivity_rows(problem, problem.begin(system.parameters.guess))

    # The derivatives are computed with two steps of the differences, a fit needs one of them.
    try:
        part_seconds = estimated_seconds(differentiate, len(longest.t)) / 2.0
    except (MjfimError, ValueError):
        # The fit itself says what is wrong.
        return None
    return part_seconds * rows / len(longest.t)
