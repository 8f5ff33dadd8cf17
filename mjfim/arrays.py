"""Array types and helpers that every package shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def freeze(record: object, *names: str) -> None:
    """Replace named fields of a frozen record by read-only float64 arrays.

    Args:
        record: Instance of a frozen dataclass.
        *names: Fields to replace.
    """
    for name in names:
        array = np.array(getattr(record, name), dtype=np.float64)
        array.setflags(write=False)
        object.__setattr__(record, name, array)


def evenly_spread_indices(count: int, limit: int) -> NDArray[np.intp]:
    """Indices of at most `limit` of `count` rows, evenly spread from the first to the last one.

    Args:
        count: Number of rows.
        limit: Largest number of indices.

    Returns:
        (min(count, limit),) ascending indices.
    """
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(np.intp))
