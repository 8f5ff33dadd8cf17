"""Curves of the use of limits, as pictures, reports and the viewer draw them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.records.design import LimitUsage

# Number of turning points above which a curve would be a solid area; its envelope is drawn instead.
MAX_TURNS = 120

# Number of intervals of time of which an envelope shows the smallest and the largest value.
ENVELOPE_INTERVALS = 150


def largest_share(usage: LimitUsage) -> float:
    """Return the largest share of a limit that is used at any time; above 1 it is violated.

    Args:
        usage: The use of the limit.
    """
    return float(np.abs(usage.share).max())


def would_be_solid(usage: LimitUsage) -> bool:
    """Return whether a curve turns so often that its line would fill an area.

    Args:
        usage: The use of the limit.
    """
    change = np.diff(usage.share)
    rising = np.sign(change[change != 0.0])
    return int(np.count_nonzero(np.diff(rising))) > MAX_TURNS


def closest_to_bounds(usage: Sequence[LimitUsage]) -> list[str]:
    """Return the names of joints, actuators and pairs of geoms, the closest to a bound first.

    Args:
        usage: The use of all limits.
    """
    largest: dict[str, float] = {}
    for each in usage:
        largest[each.name] = max(largest.get(each.name, 0.0), largest_share(each))
    return sorted(largest, key=lambda name: -largest[name])


def envelope(usage: LimitUsage) -> tuple[Array, Array, Array]:
    """Return times [s], and smallest and largest shares [%], of successive intervals.

    Args:
        usage: The use of the limit.
    """
    starts = np.unique(np.linspace(0, len(usage.t), ENVELOPE_INTERVALS, endpoint=False).astype(int))
    percent = 100.0 * usage.share
    low, high = np.minimum.reduceat(percent, starts), np.maximum.reduceat(percent, starts)
    ends = np.append(starts[1:], len(usage.t)) - 1
    return 0.5 * (usage.t[starts] + usage.t[ends]), low, high


def whole_percent(share: float) -> str:
    """Write a share in whole percents; one within the bound is never rounded to 100 %.

    Args:
        share: The share, 1 at the bound.
    """
    percent = round(100.0 * share)
    if share < 1.0 and percent == 100:
        return "> 99 %"
    return f"{percent} %"
