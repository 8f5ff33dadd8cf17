"""Averages of a series over short windows, which hold equations against noise.

Both sides of an equation are averaged with the same smooth window, so that it stays true whatever
the window takes away (parallel filtering; with a window that vanishes at its ends, the method of
modulating functions of Shinbrot 1957). The window of Hann passes frequencies up to about the
inverse of its length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array

# Number of averages per length of the window. Their noise is correlated.
PER_WINDOW = 4

# Largest share of the weight of a window on points that do not count.
MOST_UNUSABLE = 0.02


@dataclass(frozen=True, kw_only=True, eq=False)
class Averages:
    """Averages of a series of n points.

    Attributes:
        weights: (k, n) sparse weights of the points, which add up to 1.
        t: (k,) centres of the windows [s].
        length: Length of the windows [s].
    """

    weights: scipy.sparse.csr_array
    t: Array
    length: float

    def __len__(self) -> int:
        return len(self.t)

    def of(self, series: Array) -> Array:
        """Averages of a series.

        Args:
            series: (n, ...) values at the points.

        Returns:
            (k, ...) averages.
        """
        return np.asarray(self.weights @ series)


def hann_averages(
    t: Array, length: float, usable: np.ndarray, slow: np.ndarray, most_slow: float
) -> Averages:
    """Averages over windows of Hann, without those that points do not support.

    Args:
        t: (n,) equidistant times of the points [s].
        length: Length of the window [s].
        usable: (n,) True for points that count.
        slow: (n,) True for points of which a window may contain some.
        most_slow: Largest share of the weight of a window on these.
    """
    step = float(t[1] - t[0])
    half = max(round(0.5 * length / step), 1) - 1
    window = np.hanning(2 * half + 3)[1:-1]
    window = window / window.sum()
    stride = max(round(length / step / PER_WINDOW), 1)

    centres = np.arange(half, len(t) - half, stride)
    weights = _matrix(centres, window, len(t))
    unusable = weights @ (~usable).astype(np.float64)
    resting = weights @ slow.astype(np.float64)
    kept = (unusable <= MOST_UNUSABLE) & (resting <= most_slow)
    return Averages(
        weights=_matrix(centres[kept], window, len(t)), t=t[centres[kept]], length=length
    )


def _matrix(centres: np.ndarray, window: Array, count: int) -> scipy.sparse.csr_array:
    """(k, n) weights of windows about some of n points."""
    half = len(window) // 2
    columns = centres[:, None] + np.arange(-half, half + 1)
    values = np.broadcast_to(window, columns.shape)
    ends = len(window) * np.arange(len(centres) + 1)
    shape = (len(centres), count)
    return scipy.sparse.csr_array((values.ravel(), columns.ravel(), ends), shape)
