"""Runs the rounds of a design under hard limits, in this process or on workers.

Both make the same decisions about the starts, so that they find the same controls, whatever the
number of workers and whichever of them are lost. No worker waits for the end of a round.
"""

from __future__ import annotations

import uuid
from collections.abc import Generator, Sequence
from dataclasses import replace
from typing import Any

from mjfim.budget import Budget
from mjfim.excitation.constrained import ConstrainedSlice
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.judging import JudgeOrder, counted_judgement, work_of_round
from mjfim.excitation.merged_results import continued, numbered_from
from mjfim.excitation.rounds import Entry, Judge, Judgement, RoundPlan
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.running_rounds import EndedSearch, RunningRounds
from mjfim.excitation.search_slices import SearchSlice
from mjfim.excitation.sliced_searches import SlicedSearches
from mjfim.excitation.winner_repair import SECONDS_AFTER_STOP
from mjfim.parallel import Dispatch, ExecutorLike, NumberedOrder, Outcome, Workers
from mjfim.parallel.shared_value import SharedValue
from mjfim.records.events import DesignEvent


def run_rounds(plan: RoundPlan, starts: Sequence[InitialControl]) -> Runs:
    """Run all rounds of a design.

    Args:
        plan: The rounds.
        starts: The initial controls.

    Yields:
        Every iterate.

    Returns:
        One result per start that was begun.
    """
    executor = plan.searches.executor
    if executor is None:
        return (yield from _RoundsHere(plan, starts).run())
    return (yield from _RoundsOnWorkers(plan, starts, executor).run())


class _RoundsHere:
    """Rounds whose searches run one after the other in this process.

    Args:
        plan: The rounds.
        starts: The initial controls.
    """

    def __init__(self, plan: RoundPlan, starts: Sequence[InitialControl]) -> None:
        self.plan = plan
        self.rounds = RunningRounds(plan, starts)
        self._late = _LateResults(plan, self.rounds)

    def run(self) -> Runs:
        """Run all searches, and return the results."""
        budget = self.plan.searches.budget
        while (entry := self.rounds.next_entry()) is not None:
            begun = budget.seconds_used
            level = self.rounds.level(entry)
            search = self.plan.searches.search(level, entry.start, self.rounds.terms(entry))
            result = yield from _numbered(search.run(level.task), entry.done)
            seconds = budget.seconds_used - begun
            self._late.take(EndedSearch(entry=entry, result=result, seconds=seconds))
        return self.rounds.results()


class _RoundsOnWorkers:
    """Rounds whose searches run side by side on workers, in slices.

    Args:
        plan: The rounds.
        starts: The initial controls.
        executor: The workers, or an executor that they can wrap.
    """

    def __init__(
        self, plan: RoundPlan, starts: Sequence[InitialControl], executor: ExecutorLike
    ) -> None:
        self.plan = plan
        self.rounds = RunningRounds(plan, starts)
        self._executor = executor
        self._budget = plan.searches.budget
        self._late = _LateResults(plan, self.rounds)
        self._slices = SlicedSearches[ConstrainedSlice]()

        # Order for a search on the stated level, which is the same for all judgements.
        self._stated: SharedValue[ConstrainedSlice] | None = None

        # Searches that have begun and are not judged, and those of them that have ended.
        self._under_way: dict[int, Entry] = {}
        self._ended: dict[int, EndedSearch] = {}

    def run(self) -> Runs:
        """Run all searches, and return the results."""
        while (first := self._next_order()) is not None:
            self._dispatch = Dispatch[Any, Any](
                Workers.of(self._executor), work_of_round, self._budget, self._next_order
            )
            self._dispatch.add(first.index, first.order)
            for outcome in self._dispatch.arrivals():
                for event in self._take(outcome):
                    if self._budget.stop.requested:
                        break
                    yield event

            # When the time is over, results that were not judged by then are judged here. Starts
            # that go on then may be the first ones of their round.
            self._take_late()
        return self.rounds.results()

    def _next_order(self) -> NumberedOrder[Any] | None:
        """The first slice of the next search."""
        entry = self.rounds.next_entry()
        if entry is None:
            return None

        searches = self.plan.searches
        search = searches.search(self.rounds.level(entry), entry.start, self.rounds.terms(entry))
        count = self.rounds.expected(entry.round)
        order = searches.order(self._executor, search, count)
        self._under_way[entry.number] = entry
        self._slices.begin(entry.number, order)
        return NumberedOrder(index=entry.number, order=order)

    def _take(self, outcome: Outcome[Any]) -> list[DesignEvent]:
        """Take what a slice or a judgement returns, and let the search go on."""
        number = outcome.index
        events: list[DesignEvent] = []
        if number in self._ended:
            self._take_judgement(outcome)
        else:
            offset = self._under_way[number].done
            events = self._slices.take(outcome)
            if offset:
                events = [numbered_from(event, offset) for event in events]
            self._continue(number)

        if self._budget.exhausted is not None:
            self._dispatch.withdraw()
        return events

    def _continue(self, number: int) -> None:
        """Add the next slice of a search, or let its result be judged."""
        following = self._slices.following(number)
        if following is not None:
            self._dispatch.add(number, following, next_one=True)
            return

        ended = self._ended_search(number, self._slices.latest[number])
        judge = self.plan.judge(ended.entry)
        if judge is None:
            del self._under_way[number]
            self.rounds.settle(ended, _unjudged(ended.result))
        else:
            self._ended[number] = ended
            self._dispatch.add(number, self._judge_order(ended, judge), next_one=True)

    def _ended_search(self, number: int, found: SearchSlice[Any]) -> EndedSearch:
        """A search with its last slice."""
        return EndedSearch(
            entry=self._under_way[number], result=found.late_result, seconds=found.seconds
        )

    def _judge_order(self, ended: EndedSearch, judge: Judge) -> JudgeOrder:
        """Order to judge the result of a search."""
        searches = self.plan.searches
        entry = ended.entry
        if self._stated is None:
            search = searches.search(searches.stated, entry.start, self.plan.terms(entry, 0.0))
            order = searches.order(self._executor, search, self.rounds.expected(0))
            self._stated = SharedValue(uuid.uuid4().hex, order)
        return JudgeOrder(
            judge=judge,
            result=replace(ended.result, history=()),
            begun=entry.start,
            stated=self._stated,
        )

    def _take_judgement(self, outcome: Outcome[Judgement]) -> None:
        """Settle a search; what is lost on workers is judged here."""
        del self._under_way[outcome.index]
        ended = self._ended.pop(outcome.index)
        if outcome.is_lost:
            self._late.take(ended)
        else:
            self.rounds.settle(ended, outcome.result)

    def _take_late(self) -> None:
        """Take the searches that were not judged, or had not ended, when the time was over."""
        is_stopped = self._budget.stop.requested
        late: list[EndedSearch] = []
        for number, entry in list(self._under_way.items()):
            found = self._slices.latest.get(number)
            if found is None:
                self.rounds.drop(entry)
                continue
            result = found.result if is_stopped else found.late_result
            late.append(EndedSearch(entry=entry, result=result, seconds=found.seconds))

        self._under_way.clear()
        self._ended.clear()
        for ended in sorted(late, key=lambda ended: ended.result.cost):
            self._late.take(ended)


class _LateResults:
    """Results that are judged in this process, while there is time for it.

    Args:
        plan: The rounds.
        rounds: Takes the results.
    """

    def __init__(self, plan: RoundPlan, rounds: RunningRounds) -> None:
        self._plan = plan
        self._rounds = rounds
        self._waiting: Budget | None = None

    def take(self, ended: EndedSearch) -> None:
        """Judge a result, and settle its search.

        After the end of the time this goes on for a few seconds only, as soon as there is any
        control that keeps all limits.

        Args:
            ended: The search.
        """
        judge = self._plan.judge(ended.entry)
        budget = self._plan.searches.budget
        if judge is None:
            self._rounds.settle(ended, _unjudged(ended.result))
            return
        if not budget.stop.requested and not self._is_late:
            cost = self._plan.limited_cost
            judgement = counted_judgement(judge, cost, ended.result, ended.entry.start)
            self._rounds.settle(ended, judgement)
            return

        is_tried = not (self._is_late and self._rounds.has_feasible)
        self._rounds.leave(ended, self._plan.late(ended.entry, ended.result, is_tried=is_tried))

    @property
    def _is_late(self) -> bool:
        """Whether the time has been over for some seconds."""
        if self._plan.searches.budget.exhausted is None:
            return False
        if self._waiting is None:
            self._waiting = Budget(seconds=SECONDS_AFTER_STOP)
        return self._waiting.exhausted is not None


def _unjudged(result: RunResult) -> Judgement:
    """A result whose cost is that on the stated plant already."""
    following = None if result.control is None else continued(result)
    return Judgement(result=result, following=following, cost=result.cost)


def _numbered(
    events: Generator[DesignEvent, None, RunResult], offset: int
) -> Generator[DesignEvent, None, RunResult]:
    """Iterates of a later run with numbers that count from the first one of their start."""
    while True:
        try:
            event = next(events)
        except StopIteration as end:
            result: RunResult = end.value
            return result
        yield numbered_from(event, offset)
