"""Duration of work, estimated from a small part of it on this machine, before the work begins."""

from __future__ import annotations

import time
from collections.abc import Callable

# Time that a part has to take, so that its duration can be measured [s].
LEAST_SECONDS = 0.2

# Time of the first call from which it counts itself. What it allocates takes much less, and to
# repeat it would delay the message.
LONG_SECONDS = 5.0

# Number of times that a part is done. The quickest counts, because other processes disturb some.
REPEATS = 2

# Items of the first part, and the factor from one part to the next.
FIRST_ITEMS = 16
GROWTH = 4

# Units of time in words, from the longest [s]. A duration of two units or more is stated in it.
UNITS = {"days": 86400.0, "hours": 3600.0, "minutes": 60.0}


def estimated_seconds(
    work: Callable[[int], object],
    count: int,
    *,
    first: int = FIRST_ITEMS,
    negligible: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Estimate how long work takes whose duration is proportional to the number of its items.

    The number of items grows from part to part, until a part takes long enough to be measured.

    Args:
        work: Does the work on the first n items.
        count: Number of all items.
        first: Items of the first part.
        negligible: Duration of all items that need not be known accurately [s].
        clock: Returns the present time [s].

    Returns:
        The duration of the work on all items [s].
    """
    items = min(first, count)

    # What is allocated at the first call takes no time later.
    seconds = _seconds_of(work, items, clock)
    if seconds >= LONG_SECONDS:
        return seconds * count / items

    while True:
        seconds = min(_seconds_of(work, items, clock) for _ in range(REPEATS))
        total = seconds * count / items
        if seconds >= LEAST_SECONDS or items >= count or total < negligible:
            return total
        items = min(GROWTH * items, count)


def _seconds_of(work: Callable[[int], object], items: int, clock: Callable[[], float]) -> float:
    """Time of the work on some items [s]."""
    begun = clock()
    work(items)
    return clock() - begun


def in_words(seconds: float) -> str:
    """Return a duration as a rounded number with its unit."""
    for unit, length in UNITS.items():
        if seconds >= 2.0 * length:
            return f"{seconds / length:.2g} {unit}" if seconds < 1e3 * length else f"> 999 {unit}"
    return f"{seconds:.2g} s" if seconds < 99.5 else f"{seconds:.0f} s"
