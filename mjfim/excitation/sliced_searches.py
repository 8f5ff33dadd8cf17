"""Searches under hard limits side by side on the workers of an executor, in slices."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from mjfim.budget import Budget
from mjfim.excitation.constrained import ConstrainedSearch, SliceOrder, run_in_worker
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.search_slices import SearchSlice
from mjfim.parallel import Dispatch, Outcome, Workers
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent


def run_in_slices(
    executor: Executor, searches: Sequence[ConstrainedSearch], budget: Budget
) -> Runs:
    """Run searches on the same task side by side.

    The results are those of one search after the other, to the last digit, where iterations limit
    the searches. A search that has begun goes on before another one begins.

    Args:
        executor: The workers, or an executor that they can wrap.
        searches: The searches.
        budget: When it is exhausted, searches that have not begun are left out. Its token ends
            all.

    Yields:
        Every iterate, as soon as its slice has ended.

    Returns:
        One result per search that was begun, in the order of the searches.
    """
    running = _SlicedSearches(searches, Dispatch(Workers.of(executor), run_in_worker, budget.stop))
    for outcome in running.dispatch.arrivals():
        for event in running.take(outcome, budget):
            if budget.stop.requested:
                break
            yield event

    return running.results(budget)


class _SlicedSearches:
    """Searches of which each has at most one slice under way.

    Args:
        searches: The searches.
        dispatch: Carries out the slices.
    """

    def __init__(
        self, searches: Sequence[ConstrainedSearch], dispatch: Dispatch[SliceOrder, SearchSlice]
    ) -> None:
        self.dispatch = dispatch
        self._latest: dict[int, SearchSlice] = {}

        # A worker resolves the task of all these searches once.
        key = uuid.uuid4().hex
        self._orders = [SliceOrder(search=search, task_key=key) for search in searches]
        for index, order in enumerate(self._orders):
            dispatch.add(index, order)

    def take(self, outcome: Outcome[SearchSlice], budget: Budget) -> Iterator[DesignEvent]:
        """Take what a slice returns, and let its search go on.

        Args:
            outcome: What became of the slice.
            budget: Time of all searches.

        Yields:
            The iterates of the slice.
        """
        index = outcome.index
        before = self._latest.get(index)
        found = self._lost(index) if outcome.is_lost else outcome.result
        self._latest[index] = found

        if found.state is not None:
            order = replace(self._orders[index], before=found)
            self.dispatch.add(index, order, next_one=True)
        if budget.exhausted is not None:
            self.dispatch.withdraw()

        known = 0 if before is None else len(before.result.history)
        for row in found.result.history[known:]:
            yield DesignEvent(start=found.result.name, row=row)

    def results(self, budget: Budget) -> list[RunResult]:
        """Result of every search that was begun.

        Args:
            budget: Time of all searches; a search that has not ended was left by its end.
        """
        results = []
        for index in sorted(self._latest):
            found = self._latest[index]
            result = found.result
            if found.state is not None and not budget.stop.requested:
                is_inside = np.isfinite(result.cost)
                status = Status.MAX_ITERATIONS if is_inside else Status.INFEASIBLE
                result = replace(result, status=status)
            results.append(result)
        return results

    def _lost(self, index: int) -> SearchSlice:
        """End a search whose worker is lost each time: its result so far counts."""
        name = self._orders[index].search.start.name
        latest = self._latest.get(index, SearchSlice(result=RunResult(name=name)))
        return SearchSlice(result=replace(latest.result, status=Status.LOST))
