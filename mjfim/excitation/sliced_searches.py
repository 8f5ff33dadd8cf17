"""Searches side by side on the workers of an executor, in slices."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Generic, TypeVar

from mjfim.budget import Budget
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.search_slices import SearchSlice, SliceOrder
from mjfim.parallel import Dispatch, ExecutorLike, Outcome, Workers
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent

# Order for a slice of some kind of search.
Order = TypeVar("Order", bound=SliceOrder[Any])


def run_in_slices(
    executor: ExecutorLike,
    orders: Sequence[Order],
    function: Callable[[Order], SearchSlice[Any]],
    budget: Budget,
) -> Runs:
    """Run searches side by side.

    The results are those of one search after the other, to the last digit, where iterations limit
    the searches. A search that has begun goes on before another one begins.

    Args:
        executor: The workers, or an executor that they can wrap.
        orders: The first slice of each search.
        function: Runs a slice; it stands at the top of a module.
        budget: When it is exhausted, searches that have not begun are left out. Its token ends
            all.

    Yields:
        Every iterate, as soon as its slice has ended.

    Returns:
        One result per search that was begun, in the order of the searches.
    """
    running = _SlicedSearches(orders, Dispatch(Workers.of(executor), function, budget))
    for outcome in running.dispatch.arrivals():
        for event in running.take(outcome, budget):
            if budget.stop.requested:
                break
            yield event

    return running.results(budget)


class _SlicedSearches(Generic[Order]):
    """Searches of which each has at most one slice under way.

    Args:
        orders: The first slice of each search.
        dispatch: Carries out the slices.
    """

    def __init__(
        self, orders: Sequence[Order], dispatch: Dispatch[Order, SearchSlice[Any]]
    ) -> None:
        self.dispatch = dispatch
        self._latest: dict[int, SearchSlice[Any]] = {}
        self._orders = orders
        for index, order in enumerate(orders):
            dispatch.add(index, order)

    def take(self, outcome: Outcome[SearchSlice[Any]], budget: Budget) -> Iterator[DesignEvent]:
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
                result = replace(result, status=found.late_status)
            results.append(result)
        return results

    def _lost(self, index: int) -> SearchSlice[Any]:
        """End a search whose worker is lost each time: its result so far counts."""
        name = self._orders[index].name
        latest = self._latest.get(index)
        result = RunResult(name=name) if latest is None else latest.result
        return SearchSlice(result=replace(result, status=Status.LOST))
