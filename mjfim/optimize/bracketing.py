"""Search for the smallest whole number that is feasible, with as few evaluations as possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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

# Every so many evaluations, the middle of the bracket takes the place of the secant.
MIDDLE_PERIOD = 3


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
) -> tuple[int | None, int | None]:
    """Find the smallest number of samples whose ratio is at most 1.

    An example is the ratio of a reached to a required standard deviation. The ratio is assumed to
    fall at least with the inverse square root of the number of samples. The search brackets the
    number where the ratio is 1, and narrows the bracket by secants.

    Args:
        ratio: Ratio of a number of samples; infinite where a parameter is not identifiable, None
            where the search is to end.
        first: Number of samples to begin with, on the grid.
        largest: Largest number of samples, on the grid.
        grid: Numbers that are allowed.
        tolerance: Largest acceptable width of the bracket, as a function of its upper end.

    Returns:
        The smallest evaluated number that is feasible, and the largest evaluated number that is
        infeasible; None where there is no such number. Where the search was stopped, the bracket
        may be wider than the tolerance.
    """
    known: dict[int, float] = {}
    feasible: int | None = None
    infeasible: int | None = None
    following: int | None = first
    while following is not None and (value := ratio(following)) is not None:
        known[following] = value
        if value <= 1.0:
            feasible = following
        else:
            infeasible = following

        if feasible is not None and infeasible is not None:
            width = tolerance(feasible)
            is_open = feasible - infeasible > width
            following = _inside(known, infeasible, feasible, width, grid) if is_open else None
        elif feasible is not None:
            smaller = min(feasible * _factor(value, len(known)), feasible - 1)
            following = grid.round_down(smaller) if feasible > grid.minimum else None
        else:
            larger = grid.round_up(max(following * _factor(value, len(known)), following + 1))
            following = min(larger, largest) if following < largest else None
    return feasible, infeasible


def _factor(ratio: float, evaluations: int) -> float:
    """Factor from one number of samples to the next one, while one end of the bracket is open."""
    if not np.isfinite(ratio):
        return BLIND_FACTOR
    least = min(MIN_FIRST_FACTOR**2.0 ** (evaluations - 1), MAX_FACTOR)
    if ratio <= 1.0:
        return float(np.clip(ratio**2, 1.0 / MAX_FACTOR, 1.0 / least))
    return float(np.clip(ratio**2, least, MAX_FACTOR))


def _inside(
    known: dict[int, float], low: int, high: int, width: int, grid: SampleGrid
) -> int | None:
    """Root of the secant of logarithms in a bracket, or its middle; None where it is narrow."""
    x = float(np.sqrt(low * high))
    has_secant = np.isfinite(known[low]) and known[high] < known[low]
    if has_secant and len(known) % MIDDLE_PERIOD:
        share = np.log(known[low]) / np.log(known[low] / known[high])
        x = float(low * (high / low) ** share)

    # A candidate that is closer to an end than the tolerance closes the bracket, if the ratio is 1
    # between the candidate and that end.
    if high - low > 2 * width:
        x = float(np.clip(x, low + END_DISTANCE * width, high - END_DISTANCE * width))
    n = grid.round_up(x) if x * x > low * high else grid.round_down(x)
    if n <= low:
        n = grid.round_up(low + 1)
    if n >= high:
        n = grid.round_down(high - 1)
    return n if low < n < high else None
