"""Rounds of a design under hard limits from several starts, and what each of them may use."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_searches import LimitedSearches, SearchTerms
from mjfim.excitation.run_result import RunResult


@dataclass(frozen=True, kw_only=True, eq=False)
class Round:
    """A round of searches.

    Attributes:
        level: The level on which the cost is minimised.
        last_mu: Barrier weight with which the searches end.
        next_mu: Barrier weight with which the next round begins.
        share: Share of the time that is left, for all searches of the round.
    """

    level: DescentLevel
    last_mu: float = BarrierSchedule().last
    next_mu: float = BarrierSchedule().first
    share: float = 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """A start that takes part in a round.

    Attributes:
        number: Number of the entry, over all rounds.
        index: Number of the start.
        round: Number of the round.
        start: Control with which the search begins.
        mu: Barrier weight with which it begins.
        done: Number of iterates of the start before.
        cost: Cost by which it was chosen.
        seconds_per_step: Time of an iteration of the round before over the engine steps of one
            simulation [s]; 0 in the first round.
    """

    number: int
    index: int
    round: int
    start: InitialControl
    mu: float = BarrierSchedule().first
    done: int = 0
    cost: float = np.inf
    seconds_per_step: float = 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """Cost of a result of a round on the stated plant, and the control that follows from it.

    Attributes:
        result: The result, whose cost is that on the stated plant.
        following: Control with which the next round would begin; None where there is none.
        cost: Cost by which the starts are ranked.
        is_new: Whether the round has found that control; else the round began with it.
    """

    result: RunResult
    following: InitialControl | None = None
    cost: float = np.inf
    is_new: bool = True


class Judge(ABC):
    """Finds out what the results of a round are worth on the stated plant.

    It can be pickled, so that a worker can do this.
    """

    @abstractmethod
    def judged(self, cost: LimitedCost, result: RunResult, begun: InitialControl) -> Judgement:
        """Judge a result.

        Args:
            cost: Cost of controls that keep all limits on the stated plant.
            result: The result of a start.
            begun: Control with which the round began.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundPlan(ABC):
    """The rounds of a design, and how their results are judged and joined.

    Attributes:
        searches: Makes the searches.
        starts: The initial controls.
    """

    searches: LimitedSearches
    starts: Sequence[InitialControl]

    @property
    @abstractmethod
    def rounds(self) -> Sequence[Round]:
        """The rounds, of which the last one is on the stated level."""

    @cached_property
    def limited_cost(self) -> LimitedCost:
        """Cost of controls that keep all limits on the stated plant."""
        return LimitedCost(level=self.searches.stated)

    @property
    def reserved_seconds(self) -> float:
        """Time that is reserved for what follows the rounds [s]; 0 without a limit of time."""
        return 0.0

    @abstractmethod
    def terms(self, entry: Entry, seconds: float) -> SearchTerms:
        """Return the limits of the search of a start.

        Args:
            entry: The start.
            seconds: Its time [s].
        """

    @abstractmethod
    def judge(self, entry: Entry) -> Judge | None:
        """Return the judge of a start; None where its cost is that on the stated plant."""

    @abstractmethod
    def late(self, entry: Entry, result: RunResult, *, is_tried: bool) -> RunResult:
        """Result of a start that was not judged, after a request to stop.

        Args:
            entry: The start.
            result: Its result in the round.
            is_tried: Whether there is time for some simulations.
        """

    @abstractmethod
    def merged(self, before: RunResult | None, result: RunResult) -> RunResult:
        """Result of a start after a further round.

        Args:
            before: Its result before; None for the first round.
            result: Its result in this round, with the cost on the stated plant.
        """

    def may_begin(self, entry: Entry, *, has_feasible: bool) -> bool:
        """Check whether there is time for a useful search of a later round.

        Args:
            entry: The start.
            has_feasible: Whether there is a control that keeps all limits.
        """
        return True

    def next_round(self, number: int, done: int) -> int:
        """Number of the round that follows another one.

        Args:
            number: Number of the other round.
            done: Number of iterates of the start.
        """
        return number + 1
