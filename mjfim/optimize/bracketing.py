"""Search for the smallest whole number that is feasible, with as few evaluations as possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mjfim.budget import Budget

# Factor between two numbers of samples where the ratio is infinite and says nothing about the
# distance to feasibility.
BLIND_FACTOR = 2.0

# Smallest factor between the first two numbers of samples; it is squared from step to step.
MIN_FIRST_FACTOR = 1.05

# Largest factor between two numbers of samples.
MAX_FACTOR = 4.0

# Number of samples that rounding must not add or remove.
ROUNDING_TOLERANCE = 1e-9

# A candidate inside the bracket stays away from its ends by this share of the tolerance, so that
# one evaluation may close the bracket.
END_DISTANCE = 0.9

# Of three candidates inside a bracket, this many come from the secant and the rest from the middle.
SECANT_TURNS = 2


@dataclass(frozen=True, kw_only=True)
class SampleGrid:
    """Numbers of samples that an experiment may have: all small ones, and multiples of a unit from some number on.

    Attributes:
        unit: Divisor of all numbers from `first_multiple` on.
        first_multiple: Number of samples from which only multiples of the unit are allowed.
        minimum: Smallest number of samples.
    """

    unit: int
    first_multiple: int
    minimum: int = 2

    def round_down(self, samples: float) -> int:
        """The largest allowed number that is not above `samples`, or the minimum."""
        n = int(np.floor(samples + ROUNDING_TOLERANCE))
        if n >= self.first_multiple:
            n -= n % self.unit

        return max(n, self.minimum)

    def round_up(self, samples: float) -> int:
        """The smallest allowed number that is not below `samples`."""
        n = int(np.ceil(samples - ROUNDING_TOLERANCE))
        if n >= self.first_multiple:
            n += -n % self.unit

        return max(n, self.minimum)


def smallest_feasible(
    ratio: Callable[[int], float | None],
    first: int,
    largest: int,
    grid: SampleGrid,
    tolerance: Callable[[int], int],
    budget: Budget | None = None,
) -> tuple[int | None, int | None]:
    """Find the smallest number of samples whose ratio is at most 1.

    The ratio, e.g. of a reached to a required standard deviation, is assumed to fall at least like
    the inverse square root of the number of samples. The search brackets the place where the ratio
    is 1 and narrows the bracket by secants.

    Args:
        ratio: Ratio of a number of samples; infinite where nothing is known, None where its
            evaluation was stopped.
        first: Number of samples to begin with, on the grid.
        largest: Largest number of samples, on the grid.
        grid: Numbers that are allowed.
        tolerance: Largest acceptable width of the bracket, as a function of its upper end.
        budget: Asked before every evaluation; default: no limit.

    Returns:
        The smallest number that was found feasible, or None, and the largest smaller one that was
        found infeasible, or None. Where the search was stopped, the bracket may be wider than the
        tolerance.
    """
    search = _Bracket(ratio, grid, Budget() if budget is None else budget)
    search.evaluate(first)
    search.expand(largest)
    search.narrow(tolerance)
    return search.feasible, search.infeasible


@dataclass
class _Bracket:
    """The state of a search.

    Attributes:
        ratio: Ratio of a number of samples.
        grid: Numbers that are allowed.
        budget: Asked before every evaluation.
        known: Ratio of every evaluated number.
        feasible: Smallest feasible number so far, or None.
        infeasible: Largest infeasible number so far, or None.
        stopped: True where the budget is exhausted or an evaluation was stopped.
    """

    ratio: Callable[[int], float | None]
    grid: SampleGrid
    budget: Budget
    known: dict[int, float] = field(default_factory=dict)
    feasible: int | None = None
    infeasible: int | None = None
    stopped: bool = False

    def evaluate(self, n: int) -> None:
        """Evaluate a number and move that end of the bracket to which it belongs."""
        value = None if self.budget.exhausted is not None else self.ratio(n)
        if value is None:
            self.stopped = True
            return

        self.known[n] = value
        if value <= 1.0:
            self.feasible = n
        else:
            self.infeasible = n

    def expand(self, largest: int) -> None:
        """Go down from a feasible number, or up from an infeasible one, until the other end of the bracket is found."""
        while not self.stopped and self.infeasible is None and self.feasible is not None:
            n = self.feasible
            if n <= self.grid.minimum:
                return
            factor = _factor(1.0 / self.known[n], len(self.known))
            self.evaluate(self.grid.round_down(min(n * factor, n - 1)))

        while not self.stopped and self.feasible is None and self.infeasible is not None:
            n = self.infeasible
            if n >= largest:
                return
            factor = _factor(1.0 / self.known[n], len(self.known))
            self.evaluate(min(self.grid.round_up(max(n * factor, n + 1)), largest))

    def narrow(self, tolerance: Callable[[int], int]) -> None:
        """Evaluate numbers inside the bracket until it is as narrow as the tolerance or holds no other number."""
        turn = 0
        while not self.stopped and self.feasible is not None and self.infeasible is not None:
            width = tolerance(self.feasible)
            if self.feasible - self.infeasible <= width:
                return
            n = self._inside(self.infeasible, self.feasible, width, turn)
            if n is None:
                return
            self.evaluate(n)
            turn += 1

    def _inside(self, low: int, high: int, width: int, turn: int) -> int | None:
        """Next number inside the bracket, by the secant of logarithms or every third time its middle; None without any."""
        x = float(np.sqrt(low * high))
        secant = np.isfinite(self.known[low]) and self.known[high] < self.known[low]
        if secant and turn % 3 < SECANT_TURNS:
            share = np.log(self.known[low]) / np.log(self.known[low] / self.known[high])
            x = float(low * (high / low) ** share)

        # A candidate within one tolerance of an end closes the bracket if the ratio is on the
        # expected side.
        if high - low > 2 * width:
            x = float(np.clip(x, low + END_DISTANCE * width, high - END_DISTANCE * width))

        n = self.grid.round_up(x) if x * x > low * high else self.grid.round_down(x)
        if n <= low:
            n = self.grid.round_up(low + 1)
        if n >= high:
            n = self.grid.round_down(high - 1)

        return n if low < n < high else None


def _factor(margin: float, evaluations: int) -> float:
    """Factor to the next number of samples: as the square root law demands, but with steps that grow with every evaluation.

    margin: 1 over the ratio; 0 where the ratio is infinite
    """
    if margin == 0.0:
        return BLIND_FACTOR

    least = min(MIN_FIRST_FACTOR**2.0 ** (evaluations - 1), MAX_FACTOR)
    if margin >= 1.0:
        return float(np.clip(margin**-2, 1.0 / MAX_FACTOR, 1.0 / least))

    return float(np.clip(margin**-2, least, MAX_FACTOR))
