"""Runs within tighter limits, where the best result violates a limit of the unmodified model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.excitation.interior_point import BarrierSchedule, updated_tightening
from mjfim.excitation.limited_searches import LimitedSearches, SearchTerms
from mjfim.excitation.merged_results import append_run, continued
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.winner_repair import WinnerRepair

# Largest number of runs within tighter limits.
MAX_TIGHTENED_RUNS = 3

# First barrier weight mu of a run within tighter limits.
TIGHTENED_RUN_MU = 1e-3

# Largest number of iterations of a run within tighter limits.
TIGHTENED_RUN_ITERATIONS = 60


def run_within_tighter_limits(
    searches: LimitedSearches,
    repair: WinnerRepair,
    results: Sequence[RunResult],
    sharpest: BarrierSchedule,
) -> Runs:
    """Optimise the best result again while it violates a limit on the unmodified model.

    Args:
        searches: Runs the searches.
        repair: Tells whether the best result violates a limit.
        results: Result of every start.
        sharpest: Stages of the last round of the design.

    Yields:
        Every iterate.

    Returns:
        The results, of which the best one is replaced. It may still violate a limit.
    """
    results = list(results)
    tightening = dict[str, float]()

    for _ in range(MAX_TIGHTENED_RUNS):
        winner = repair.violating(results)
        if winner is None or searches.budget.exhausted is not None:
            break

        tightening = updated_tightening(tightening, winner.margins)
        result = results[winner.index]
        repeated = yield from searches.run(
            repair.cost.level,
            continued(result),
            SearchTerms(
                schedule=_schedule_after(result, sharpest),
                max_iterations=TIGHTENED_RUN_ITERATIONS,
                seconds=searches.budget.seconds_left,
                tightening=tightening,
            ),
        )
        if repeated is not None and np.isfinite(repeated.cost):
            results[winner.index] = append_run(result, repeated)

    return results


def _schedule_after(result: RunResult, sharpest: BarrierSchedule) -> BarrierSchedule:
    """Stages of a run within tighter limits: as sharp as those that the result has reached.

    A result that has not reached such stages had no time for them.

    Args:
        result: The result that is continued.
        sharpest: Stages of the last round of the design.
    """
    usual = BarrierSchedule()
    is_sharp = bool(result.history) and result.history[-1].mu < usual.last
    return replace(sharpest if is_sharp else usual, first=TIGHTENED_RUN_MU)
