"""The time of each search of a round, where the time of a design is limited."""

from __future__ import annotations

from collections.abc import Callable

from mjfim.budget import Budget

# Least time of a search, relative to an equal share of the time of its round. Searches end after
# the iterate that is then running, so that the last ones of a round find less than their share.
LEAST_SHARE = 0.5


class RoundTimes:
    """Divides the time that is left among the searches that have not ended.

    What a search leaves of its time is for those that begin after it.

    Args:
        budget: Time of the design.
        reserved: Time that is reserved for what follows the rounds [s].
        turns: Number of searches that each worker does one after the other, given the number of
            all searches.
    """

    def __init__(self, budget: Budget, reserved: float, turns: Callable[[int], int]) -> None:
        self._budget = budget
        self._reserved = reserved
        self._turns = turns
        self._ends: dict[int, float] = {}
        self._least: dict[int, float] = {}

    def seconds(self, number: int, share: float, count: int) -> float:
        """Time of the search of a round that begins now [s]; infinite without a limit of time.

        Args:
            number: Number of the round.
            share: Share of the time that is left for the round, if this is its first search.
            count: Number of searches of the round that have not ended, with this one: those that
                have not begun, and those that workers have taken or wait to begin.
        """
        turns = self._turns(count)
        used = self._budget.seconds_used
        if number not in self._ends:
            whole = share * max(self._budget.seconds_left - self._reserved, 0.0)
            self._ends[number] = used + whole
            self._least[number] = LEAST_SHARE * whole / turns
        return max((self._ends[number] - used) / turns, self._least[number])
