"""The choice of the starts that continue after the first round of a design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status

# A round keeps one in this number of starts.
HALVING_RATE = 4


def choose_survivors(candidates: Sequence[RunResult]) -> list[int]:
    """Choose the candidates of lowest cost for the second round.

    Args:
        candidates: What the second round would continue, by start.

    Returns:
        Indices of the chosen ones, the best one first.
    """
    usable = [i for i, candidate in enumerate(candidates) if candidate.control is not None]
    best_first = sorted(usable, key=lambda i: candidates[i].cost)

    count = max(1, len(candidates) // HALVING_RATE)
    return best_first[:count]


def discard_others(
    results: Sequence[RunResult], candidates: Sequence[RunResult], survivors: Sequence[int]
) -> list[RunResult]:
    """Mark feasible results that do not survive the first round.

    Args:
        results: Result of every start.
        candidates: What the second round would continue, by start.
        survivors: Indices of the chosen ones.
    """
    marked = list(results)
    for i, candidate in enumerate(candidates):
        is_usable = candidate.control is not None and np.isfinite(candidate.cost)
        if i not in survivors and is_usable:
            marked[i] = replace(marked[i], status=Status.LEFT)

    return marked
