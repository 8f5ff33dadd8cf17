"""Successive halving without a barrier: which starts of a round go on to the next one.

A start need not wait until the whole round has ended. As soon as the first 4 starts of a round are
settled, the best one of them goes on, as soon as the first 8 are settled the best two of them, and
so on. This depends on the order of the starts alone, not on which of them ends first, so that the
same starts go on whatever the number of workers and their speed.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass

# A round keeps one in this number of starts.
HALVING_RATE = 4


@dataclass(frozen=True, kw_only=True)
class Settled:
    """How a start has ended a round.

    Attributes:
        cost: Cost by which the starts are ranked.
        is_usable: False where there is nothing to go on with; such a start takes no place.
        may_go_on: False where it keeps its place, but does not go on.
    """

    cost: float
    is_usable: bool = True
    may_go_on: bool = True


class HalvingRound:
    """The starts of a round in their order, and the decisions about them.

    Starts may be added until the round is closed. The best quarter of all starts always goes on,
    as in a round that waits for its last start; and so do a few others, which were among the best
    quarter of the first ones. With fewer than twice `HALVING_RATE` starts there is one decision.
    """

    def __init__(self) -> None:
        self._order: list[int] = []
        self._settled: dict[int, Settled] = {}
        self._is_closed = False

        # Number of the first starts that are all settled, and places and costs of the usable ones
        # among those that are compared, the best one first.
        self._settled_count = 0
        self._ranks: list[tuple[float, int]] = []
        self._decided = 0
        self._promoted: set[int] = set()

    def enter(self, number: int) -> None:
        """Add a start behind all others.

        Args:
            number: Its number.
        """
        self._order.append(number)

    def settle(self, number: int, settled: Settled) -> None:
        """Note how a start has ended the round.

        Args:
            number: Number of the start.
            settled: How it has ended.
        """
        self._settled[number] = settled

    def close(self) -> None:
        """Say that no further start enters."""
        self._is_closed = True

    @property
    def is_over(self) -> bool:
        """True where all decisions are made."""
        return self._is_closed and self._decided == len(self._order)

    @property
    def discarded(self) -> set[int]:
        """Numbers of the starts that do not go on, while others do."""
        return set(self._order[: self._decided]) - self._promoted if self._promoted else set()

    def decide(self) -> list[int]:
        """Make the decisions that are due.

        Returns:
            Numbers of the starts that go on from now on, the best one of each decision first.
        """
        while self._settled_count < len(self._order):
            if self._order[self._settled_count] not in self._settled:
                break
            self._settled_count += 1

        following: list[int] = []
        while 0 < (size := self._next_size) <= self._settled_count:
            chosen = [number for number in self._best(size) if number not in self._promoted]
            following += chosen
            self._promoted.update(chosen)
        return following

    @property
    def _next_size(self) -> int:
        """Number of the first starts that are compared next; 0 where it is not known yet.

        The last decision is about all starts, so that no decision is about less than
        `HALVING_RATE` new ones.
        """
        size = self._decided + HALVING_RATE
        if len(self._order) >= size + HALVING_RATE:
            return size
        return len(self._order) if self._is_closed and self._decided < len(self._order) else 0

    def _best(self, size: int) -> list[int]:
        """Compare the first starts; return those that go on, by their cost."""
        for place in range(self._decided, size):
            settled = self._settled[self._order[place]]
            if settled.is_usable:
                insort(self._ranks, (settled.cost, place))

        self._decided = size
        chosen = [self._order[place] for _, place in self._ranks[: max(1, size // HALVING_RATE)]]
        return [number for number in chosen if self._settled[number].may_go_on]
