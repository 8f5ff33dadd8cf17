"""Results of several runs from the same start, joined to one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import HistoryRow, Status, extended
from mjfim.records.events import DesignEvent


def continued(result: RunResult) -> InitialControl:
    """The control of a result as an initial control.

    Args:
        result: A result with a control.
    """
    return InitialControl(name=result.name, control=np.asarray(result.control))


def numbered_from(event: DesignEvent, offset: int) -> DesignEvent:
    """Return the iterate with a number that counts from the first one of its start.

    Args:
        event: An iterate of a later run.
        offset: Number of iterates of the runs before.
    """
    row = replace(event.row, iteration=event.row.iteration + offset)
    return replace(event, row=row)


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
    """The second result, with the history and the engine steps of both.

    Args:
        first: Result of the first run.
        second: Result of the second run from the same start.
    """
    return replace(
        second,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
    )


def better_of(first: RunResult, second: RunResult) -> RunResult:
    """Result of a start after two runs, with the control of lower cost.

    Args:
        first: Result of the first run.
        second: Result of the second run from the same start.
    """
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
