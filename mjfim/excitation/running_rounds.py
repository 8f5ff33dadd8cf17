"""Rounds of a design under hard limits under way, and which starts go on."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.excitation.halving import HALVING_RATE, HalvingRound, Settled
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_searches import SearchTerms
from mjfim.excitation.merged_results import without_discarded_winner
from mjfim.excitation.round_times import RoundTimes
from mjfim.excitation.rounds import Entry, Judgement, RoundPlan
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status


@dataclass(frozen=True, kw_only=True, eq=False)
class EndedSearch:
    """A search of a round that has ended.

    Attributes:
        entry: The start.
        result: The result in this round.
        seconds: Time of the search [s].
    """

    entry: Entry
    result: RunResult
    seconds: float


class RunningRounds:
    """Rounds under way: the starts that take part in each, and their results so far.

    Starts of a lower round go first, because the longest way lies before them, and among those of
    one round the one of lowest cost.

    Args:
        plan: The rounds.
        starts: The initial controls.
    """

    def __init__(self, plan: RoundPlan, starts: Sequence[InitialControl]) -> None:
        self._plan = plan
        self._halvings = [HalvingRound() for _ in plan.rounds]
        self._pending: list[tuple[int, float, int, Entry]] = []
        self._pending_in: Counter[int] = Counter()
        self._begun: Counter[int] = Counter()

        # Number of the begun searches of each round that have ended.
        self._over: Counter[int] = Counter()
        self._results: dict[int, RunResult] = {}
        self._entries: dict[int, EndedSearch] = {}
        self._judgements: dict[int, Judgement] = {}
        searches = plan.searches
        self._times = RoundTimes(searches.budget, plan.reserved_seconds, searches.turns)
        self._start_count = len(starts)
        self._count = 0
        for index, start in enumerate(starts):
            self._enter(Entry(number=index, index=index, round=0, start=start))
        self._go_on()

    @property
    def has_feasible(self) -> bool:
        """Whether there is a control that keeps all limits."""
        return any(np.isfinite(result.cost) for result in self._results.values())

    def level(self, entry: Entry) -> DescentLevel:
        """The level of the round of a start."""
        return self._plan.rounds[entry.round].level

    def expected(self, number: int) -> int:
        """Number of searches that a round has if no start goes on by mistake.

        Args:
            number: Number of the round.
        """
        return max(self._start_count // int(HALVING_RATE**number), 1)

    def next_entry(self) -> Entry | None:
        """The start whose search begins next; None where there is none at present.

        When the time is over, a start begins only if it is the first one of its round.
        """
        while self._pending:
            *_, entry = heapq.heappop(self._pending)
            self._pending_in[entry.round] -= 1
            if self._may_begin(entry):
                return entry
            self.drop(entry)
        return None

    def terms(self, entry: Entry) -> SearchTerms:
        """Return the limits of a search that begins now.

        Args:
            entry: The start.
        """
        number = entry.round

        # Workers take searches before they have time for them, so that those under way count too.
        under_way = self._begun[number] - self._over[number]
        left = self.expected(number) - self._over[number]
        count = max(self._pending_in[number] + 1 + under_way, left)
        self._begun[number] += 1
        seconds = self._times.seconds(number, self._plan.rounds[number].share, count)
        return self._plan.terms(entry, seconds)

    def settle(self, ended: EndedSearch, judgement: Judgement) -> None:
        """Take the result of a start, and let those go on about which it decides.

        Args:
            ended: The search.
            judgement: What its result is worth on the stated plant.
        """
        entry = ended.entry
        self._over[entry.round] += 1
        self._keep(ended, judgement.result)
        self._entries[entry.number] = ended
        self._judgements[entry.number] = judgement

        # A search that is held up where random controls cost less gains nothing in later rounds.
        cost_to_beat = self._plan.searches.cost_to_beat
        is_beaten = ended.result.is_held_up and judgement.cost > cost_to_beat
        settled = Settled(
            cost=judgement.cost,
            is_usable=judgement.following is not None,
            may_go_on=not is_beaten,
        )
        self._halvings[entry.round].settle(entry.number, settled)
        self._go_on()

    def leave(self, ended: EndedSearch, result: RunResult) -> None:
        """Take the result of a start that does not go on, because there is no time to judge it.

        Args:
            ended: The search.
            result: What counts as its result.
        """
        self._over[ended.entry.round] += 1
        self._keep(ended, result)
        self.drop(ended.entry)

    def drop(self, entry: Entry) -> None:
        """Let a start not go on, whose search did not begin or was not judged.

        Args:
            entry: The start.
        """
        self._halvings[entry.round].settle(entry.number, Settled(cost=np.inf, is_usable=False))
        self._go_on()

    def results(self) -> list[RunResult]:
        """Result of every start that was begun, in the order of the starts."""
        marked = dict(self._results)
        for halving in self._halvings[:-1]:
            for number in halving.discarded & set(self._judgements):
                index = self._entries[number].entry.index
                is_usable = np.isfinite(self._judgements[number].cost)
                if is_usable and marked[index].status not in (Status.LOST, Status.INFEASIBLE):
                    marked[index] = replace(marked[index], status=Status.LEFT)
        return without_discarded_winner([marked[index] for index in sorted(marked)])

    def _enter(self, entry: Entry) -> None:
        """Let a start take part in a round."""
        self._halvings[entry.round].enter(entry.number)
        heapq.heappush(self._pending, (entry.round, entry.cost, entry.number, entry))
        self._pending_in[entry.round] += 1
        self._count += 1

    def _may_begin(self, entry: Entry) -> bool:
        """Check whether there is time for a start; the first one of all always begins."""
        budget = self._plan.searches.budget
        is_first = not self._begun[entry.round]
        if entry.round == 0:
            return is_first or budget.exhausted is None
        if budget.stop.requested or (budget.exhausted is not None and not is_first):
            return False
        return self._plan.may_begin(entry, has_feasible=self.has_feasible)

    def _keep(self, ended: EndedSearch, result: RunResult) -> None:
        """Join a result with those of the rounds before."""
        index = ended.entry.index
        whole = replace(result, history=ended.result.history)
        self._results[index] = self._plan.merged(self._results.get(index), whole)

    def _go_on(self) -> None:
        """Let starts enter later rounds, and close the rounds that no further start can enter."""
        is_closed = True
        for number in range(len(self._halvings) - 1):
            if is_closed:
                self._halvings[number].close()
            for chosen in self._halvings[number].decide():
                self._enter(self._following(self._entries[chosen], self._judgements[chosen]))
            is_closed = is_closed and self._halvings[number].is_over

    def _following(self, ended: EndedSearch, judgement: Judgement) -> Entry:
        """The entry of a start in the next round."""
        entry = ended.entry
        rows = ended.result.history
        done = entry.done + (rows[-1].iteration + 1 if rows else 0)

        # A control that is played several times was optimised over one repetition.
        task = self.level(entry).task
        steps = task.samples // entry.start.repeats * task.system.grid.substeps
        assert judgement.following is not None
        return Entry(
            number=self._count,
            index=entry.index,
            round=self._plan.next_round(entry.round, done),
            start=judgement.following,
            mu=self._plan.rounds[entry.round].next_mu if judgement.is_new else entry.mu,
            done=done,
            cost=judgement.cost,
            seconds_per_step=ended.seconds / max(len(rows), 1) / steps,
        )
