"""Search for the smallest whole number that is feasible, with as few evaluations as possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from mjfim.parallel.budget import Budget

# Factor between two successive numbers of samples where the ratio is infinite, so that it does not
# show the distance to feasibility.
BLIND_FACTOR = 2.0

# Smallest factor between the first two numbers of samples. It is squared from step to step.
MIN_FIRST_FACTOR = 1.05

# Largest factor between two successive numbers of samples.
MAX_FACTOR = 4.0

# Number of samples by which round-off may change a number before it is rounded.
ROUNDING_TOLERANCE = 1e-9

# Distance of a candidate from the ends of the bracket, relative to the tolerance. It is less than
# 1, so that one evaluation can close the bracket.
END_DISTANCE = 0.9

# The secant and the middle of the bracket take turns in cycles of this length.
CANDIDATE_CYCLE = 3

# Number of candidates in every cycle that come from the secant; the others come from the middle.
SECANT_TURNS = 2


@dataclass(frozen=True, kw_only=True)
class SampleGrid:
    """Numbers of samples that an experiment may have.

    Small numbers are all allowed. From `first_multiple` on, only multiples of a unit are allowed.

    Attributes:
        unit: Divisor of all numbers from `first_multiple` on.
        first_multiple: Number of samples from which only multiples of the unit are allowed.
        minimum: Smallest number of samples.
    """

    unit: int
    first_multiple: int
    minimum: int = 2

    def round_down(self, samples: float) -> int:
        """Round to the next allowed number below.

        Args:
            samples: Number of samples.

        Returns:
            The largest allowed number that is not above it, or the minimum.
        """
        n = int(np.floor(samples + ROUNDING_TOLERANCE))
        if n >= self.first_multiple:
            n -= n % self.unit

        return max(n, self.minimum)

    def round_up(self, samples: float) -> int:
        """Round to the next allowed number above.

        Args:
            samples: Number of samples.

        Returns:
            The smallest allowed number that is not below it.
        """
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

    An example is the ratio of a reached to a required standard deviation. The ratio is assumed to
    fall at least with the inverse square root of the number of samples. The search brackets the
    number where the ratio is 1, and narrows the bracket by secants.

    Args:
        ratio: Ratio of a number of samples; infinite where a parameter is not identifiable, None
            where its evaluation was stopped.
        first: Number of samples to begin with, on the grid.
        largest: Largest number of samples, on the grid.
        grid: Numbers that are allowed.
        tolerance: Largest acceptable width of the bracket, as a function of its upper end.
        budget: Asked before every evaluation; default: no limit.

    Returns:
        The smallest evaluated number that is feasible, and the largest evaluated number that is
        infeasible; None where there is no such number. Where the search was stopped, the bracket
        may be wider than the tolerance.
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
        """Evaluate a number of samples and move one end of the bracket there."""
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
        """Search for the other end of the bracket.

        The search goes down from a feasible number, or up from an infeasible one to the largest.
        """
        while not self.stopped and self.infeasible is None and self.feasible is not None:
            n = self.feasible
            if n <= self.grid.minimum:
                return
            factor = _factor(1.0 / self.known[n], len(self.known))
            smaller = min(n * factor, n - 1)
            self.evaluate(self.grid.round_down(smaller))

        while not self.stopped and self.feasible is None and self.infeasible is not None:
            n = self.infeasible
            if n >= largest:
                return
            factor = _factor(1.0 / self.known[n], len(self.known))
            larger = max(n * factor, n + 1)
            self.evaluate(min(self.grid.round_up(larger), largest))

    def narrow(self, tolerance: Callable[[int], int]) -> None:
        """Evaluate numbers inside the bracket until it is narrow enough.

        The search ends as well where the grid has no other number inside the bracket.
        """
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
        """Next number inside the bracket; None where the grid has no number there.

        Args:
            low: Lower end of the bracket, which is infeasible.
            high: Upper end of the bracket, which is feasible.
            width: Largest acceptable width of the bracket.
            turn: Number of candidates before this one.
        """
        x = self._candidate(low, high, turn)

        # A candidate that is closer to an end than the tolerance closes the bracket, if the ratio
        # is 1 between the candidate and that end.
        if high - low > 2 * width:
            distance = END_DISTANCE * width
            x = float(np.clip(x, low + distance, high - distance))

        is_upper_half = x * x > low * high
        n = self.grid.round_up(x) if is_upper_half else self.grid.round_down(x)
        if n <= low:
            n = self.grid.round_up(low + 1)
        if n >= high:
            n = self.grid.round_down(high - 1)

        return n if low < n < high else None

    def _candidate(self, low: int, high: int, turn: int) -> float:
        """Root of the secant of logarithms, or the geometric mean of the bracket's ends.

        The secant needs finite ratios that fall with the number of samples.
        """
        ratio_low = self.known[low]
        ratio_high = self.known[high]
        has_secant = np.isfinite(ratio_low) and ratio_high < ratio_low
        if has_secant and turn % CANDIDATE_CYCLE < SECANT_TURNS:
            share = np.log(ratio_low) / np.log(ratio_low / ratio_high)
            return float(low * (high / low) ** share)

        return float(np.sqrt(low * high))


def _factor(margin: float, evaluations: int) -> float:
    """Factor from one number of samples to the next one.

    It follows the square root law, but it is at least as far from 1 as a factor that grows with
    every evaluation.

    Args:
        margin: 1 over the ratio; 0 where the ratio is infinite.
        evaluations: Number of evaluations so far.
    """
    if margin == 0.0:
        return BLIND_FACTOR

    least = min(MIN_FIRST_FACTOR**2.0 ** (evaluations - 1), MAX_FACTOR)
    if margin >= 1.0:
        return float(np.clip(margin**-2, 1.0 / MAX_FACTOR, 1.0 / least))

    return float(np.clip(margin**-2, least, MAX_FACTOR))
