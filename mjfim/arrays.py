"""Array types and helpers that every package shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def freeze(record: object, *names: str) -> None:
    """Replace each named field of a frozen record by a read-only float64 array."""
    for name in names:
        array = np.array(getattr(record, name), dtype=np.float64)
        array.setflags(write=False)
        object.__setattr__(record, name, array)


def thinned(count: int, most: int) -> NDArray[np.intp]:
    """Indices of at most so many of count rows, evenly spread: what a picture can show."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))
