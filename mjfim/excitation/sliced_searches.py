"""Searches side by side on the workers of an executor, in slices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    searches = SlicedSearches[Order]()
    dispatch = Dispatch(Workers.of(executor), function, budget)
    for index, order in enumerate(orders):
        searches.begin(index, order)
        dispatch.add(index, order)

    for outcome in dispatch.arrivals():
        events = searches.take(outcome)
        following = searches.following(outcome.index)
        if following is not None:
            dispatch.add(outcome.index, following, next_one=True)
        if budget.exhausted is not None:
            dispatch.withdraw()

        for event in events:
            if budget.stop.requested:
                break
            yield event

    found = [searches.latest[index] for index in sorted(searches.latest)]
    is_stopped = budget.stop.requested
    return [each.result if is_stopped else each.late_result for each in found]


class SlicedSearches(Generic[Order]):
    """Searches of which each has at most one slice under way.

    Attributes:
        latest: What the last slice of each search has found, by the number of the search.
    """

    def __init__(self) -> None:
        self.latest: dict[int, SearchSlice[Any]] = {}
        self._orders: dict[int, Order] = {}

    def begin(self, index: int, order: Order) -> None:
        """Note a search.

        Args:
            index: Its number.
            order: Its first slice.
        """
        self._orders[index] = order

    def take(self, outcome: Outcome[SearchSlice[Any]]) -> list[DesignEvent]:
        """Take what a slice returns.

        A search whose worker is lost each time ends: its result so far counts.

        Args:
            outcome: What became of the slice.

        Returns:
            The iterates of the slice.
        """
        index = outcome.index
        before = self.latest.get(index)
        found = self._lost(index) if outcome.is_lost else outcome.result
        self.latest[index] = found

        known = 0 if before is None else len(before.result.history)
        return [DesignEvent(start=found.result.name, row=r) for r in found.result.history[known:]]

    def following(self, index: int) -> Order | None:
        """Order of the next slice of a search; None where it has ended."""
        found = self.latest[index]
        return None if found.state is None else replace(self._orders[index], before=found)

    def _lost(self, index: int) -> SearchSlice[Any]:
        """End a search whose worker is lost each time."""
        latest = self.latest.get(index)
        if latest is None:
            result = RunResult(name=self._orders[index].name, status=Status.LOST)
            return SearchSlice(result=result)
        result = replace(latest.result, status=Status.LOST)
        return SearchSlice(result=result, seconds=latest.seconds)
