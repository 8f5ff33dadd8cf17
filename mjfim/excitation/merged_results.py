"""Results of several runs from the same start, joined to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.records.design import HistoryRow, Status, extended


def continued(result: RunResult) -> InitialControl:
    """The control of a result as an initial control.

    Args:
        result: A result with a control.
    """
    return InitialControl(name=result.name, control=np.asarray(result.control))


def renumber(events: Runs, offset: int) -> Runs:
    """Add an offset to the numbers of the iterates.

    Args:
        events: Yields the iterates, and returns the results.
        offset: Number of the first iterate.
    """
    while True:
        try:
            event = next(events)
        except StopIteration as end:
            results: list[RunResult] = end.value
            return results

        row = replace(event.row, iteration=event.row.iteration + offset)
        yield replace(event, row=row)


def merge_rounds(first: Sequence[RunResult], second: Sequence[RunResult]) -> list[RunResult]:
    """Results of two rounds; every start keeps its control of lower cost.

    Args:
        first: Result of every start in the first round.
        second: Results of those that took part in the second round.
    """
    by_name = {result.name: result for result in second}
    merged = [
        _merge(result, by_name[result.name]) if result.name in by_name else result
        for result in first
    ]

    return without_discarded_winner(merged)


def without_discarded_winner(results: Sequence[RunResult]) -> list[RunResult]:
    """Results of all rounds, of which the best one does not count as discarded or infeasible.

    A discarded start may be the best after all, and so may one whose later run found nothing
    feasible.

    Args:
        results: Result of every start.
    """
    results = list(results)
    best = min(range(len(results)), key=lambda i: results[i].cost, default=None)
    if best is None or not np.isfinite(results[best].cost):
        return results

    if results[best].status in (Status.LEFT, Status.INFEASIBLE):
        results[best] = replace(results[best], status=Status.MAX_ITERATIONS)
    return results


def append_run(first: RunResult, second: RunResult) -> RunResult:
    """The second result, with the history and the engine steps of both."""
    return replace(
        second,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
    )


def _merge(first: RunResult, second: RunResult) -> RunResult:
    """Result of a start after both rounds."""
    merged = replace(
        first,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
        status=second.status,
        slope=second.slope,
        is_held_up=second.is_held_up,
    )
    merged = replace(merged, earlier=(*first.earlier, *second.earlier))
    if second.control is not None and second.cost <= first.cost:
        merged = replace(merged, control=second.control, cost=second.cost)
    elif second.status.success:
        merged = replace(merged, status=Status.BEST_SEEN)

    # The control of the first round still counts where the second one found nothing feasible.
    if np.isfinite(merged.cost) and second.status is Status.INFEASIBLE:
        merged = replace(merged, status=Status.MAX_ITERATIONS)

    return merged


def _join(first: tuple[HistoryRow, ...], second: tuple[HistoryRow, ...]) -> tuple[HistoryRow, ...]:
    """Join the histories of two runs; iterates and engine steps of the second one are added."""
    if not first:
        return second

    end = first[-1]
    rows = [
        replace(row, iteration=row.iteration + end.iteration + 1, steps=row.steps + end.steps)
        for row in second
    ]
    return extended(first, rows)
