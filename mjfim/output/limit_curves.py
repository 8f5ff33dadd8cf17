"""Curves of the use of limits, as pictures and reports draw them."""

from __future__ import annotations

import numpy as np

from mjfim.records.design import LimitUsage

# Number of turning points above which a curve would be a solid area; its envelope is drawn instead.
MAX_TURNS = 120


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
