"""Search for the smallest whole number at which something falls to 1, asked as rarely as possible. Numbers only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STRETCH = 2.0  # factor of a number of samples, where nothing is known about how far it is from what is wanted


STEP, MOST = 1.05, 4.0  # least factor at first, then its square, and so on; largest factor


@dataclass(frozen=True)
class Grid:
    """Numbers of samples that an experiment may have: multiples of a unit, from a number on. least: of them"""

    unit: int
    begins: int
    least: int = 2

    def down(self, samples: float) -> int:
        """The largest that is not above, or the least."""
        n = int(np.floor(samples + 1e-9))
        return max(n - n % self.unit if n >= self.begins else n, self.least)

    def up(self, samples: float) -> int:
        """The smallest that is not below."""
        n = int(np.ceil(samples - 1e-9))
        return max(n + -n % self.unit if n >= self.begins else n, self.least)


def bracket(
    ratio: Callable[[int], float], first: int, most: int, grid: Grid, slack: Callable[[int], int]
) -> tuple[int | None, int | None]:
    """The smallest number of samples with ratio <= 1, or None, and the largest smaller one that was found to miss it, or None.

    ratio: of a number of samples, falls like its square root or faster; may raise KeyboardInterrupt to end the search
    first, most: where to begin and to end, on the grid;  slack: how far the two may be apart, by the larger one
    """
    known: dict[int, float] = {}

    def below(n: int) -> bool:
        known[n] = ratio(n)
        return known[n] <= 1.0

    high: int | None = None
    low: int | None = None
    try:
        if below(first):
            high = first
            while low is None and high > grid.least:
                n = grid.down(min(high * _factor(1.0 / known[high], len(known)), high - 1))
                high, low = (n, None) if below(n) else (high, n)
        else:
            low = first
            while high is None and low < most:
                n = min(grid.up(max(low * _factor(1.0 / known[low], len(known)), low + 1)), most)
                high, low = (n, low) if below(n) else (None, n)
        turn = 0
        while high is not None and low is not None and high - low > slack(high):
            between = _between(low, high, known, grid, slack(high), turn)
            if between is None:
                break
            high, low = (between, low) if below(between) else (high, between)
            turn += 1
    except KeyboardInterrupt:
        if high is None:
            raise
    return high, low


def _factor(room: float, turn: int) -> float:
    """By how much to change a number of samples that has so much room: what the square root asks for, but ever larger steps.

    room: 1 over the ratio, 0 where that is infinite
    """
    if room == 0.0:
        return STRETCH
    least = STEP**2.0 ** (turn - 1)
    if room >= 1.0:
        return float(np.clip(room**-2, 1.0 / MOST, 1.0 / min(least, MOST)))
    return float(np.clip(room**-2, min(least, MOST), MOST))


def _between(
    low: int, high: int, known: dict[int, float], grid: Grid, slack: int, turn: int
) -> int | None:
    """Where to look next inside a bracket: by the secant of logarithms, every third time in the middle; None: nowhere."""
    x = float(np.sqrt(low * high))
    if np.isfinite(known[low]) and known[high] < known[low] and turn % 3 < 2:
        share = np.log(known[low]) / np.log(known[low] / known[high])
        x = float(low * (high / low) ** share)
    if high - low > 2 * slack:
        x = float(
            np.clip(x, low + 0.9 * slack, high - 0.9 * slack)
        )  # a hit closes the bracket from one side
    n = grid.up(x) if x * x > low * high else grid.down(x)
    n = n if n > low else grid.up(low + 1)
    n = n if n < high else grid.down(high - 1)
    return n if low < n < high else None
