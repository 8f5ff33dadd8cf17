"""Subsets of the segments: those on which a search begins, and those that are quick to simulate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import evenly_spread_indices
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.next_step import spread_over_data
from mjfim.optimize.levenberg_marquardt import UnknownValues

# Number of samples of a subset of segments that is quick to simulate, if there are more data.
SUBSET_SAMPLES = 40_000

# Share of the data on which the search begins, where that leaves enough samples, and the least
# number of segments, which are half of the data at most.
FIRST_SHARE = 0.25
MIN_FIRST_SAMPLES = 2_000
MIN_FIRST_SEGMENTS = 3

# Number of samples, and least number of segments, that lead near enough to a minimum for a search
# over all data to begin there.
RESTART_SAMPLES = 3_000
MIN_RESTART_SEGMENTS = 12


def quick_subset(problem: FitProblem) -> np.ndarray:
    """Indices of segments that are quick to simulate, evenly spread over the data.

    Args:
        problem: Problem of all segments.

    Returns:
        The indices; with little data those of all segments.
    """
    count = len(problem.segments)
    if problem.sample_count <= SUBSET_SAMPLES or count == 1:
        return evenly_spread_indices(count, count)

    wanted = max(int(SUBSET_SAMPLES * count / problem.sample_count), 1)
    return evenly_spread_indices(count, wanted)


def first_subset(problem: FitProblem) -> np.ndarray:
    """Indices of the segments on which the search begins, evenly spread over the data.

    Args:
        problem: Problem of all segments.

    Returns:
        The indices; with little data those of all segments.
    """
    quick = quick_subset(problem)
    count = len(problem.segments)
    wanted = max(int(FIRST_SHARE * count), MIN_FIRST_SEGMENTS)
    enough = FIRST_SHARE * problem.sample_count >= MIN_FIRST_SAMPLES
    if not enough or 2 * wanted > count:
        return quick

    # Recordings that repeat in turn, such as one of each joint, are not met in step.
    return spread_over_data(count, min(wanted, len(quick)))


def restart_subset(problem: FitProblem) -> np.ndarray:
    """Indices of the segments of a fit that only leads to a start for another one.

    Args:
        problem: Problem of all segments.

    Returns:
        The indices, spread over the data; with little data those of all segments.
    """
    count = len(problem.segments)
    wanted = max(int(RESTART_SAMPLES * count / problem.sample_count), MIN_RESTART_SEGMENTS)
    if wanted >= count:
        return evenly_spread_indices(count, count)
    return spread_over_data(count, wanted)


def of_subset(at: UnknownValues, subset: np.ndarray) -> UnknownValues:
    """Take the unknowns of some segments.

    Args:
        at: Unknowns of all segments.
        subset: Indices of the segments.

    Returns:
        The unknowns of these segments.
    """
    return replace(at, private=at.private[subset])
