"""Spectral density of long series by Welch's method, part by part."""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array

# Number of segments that are transformed at once.
SEGMENTS_AT_ONCE = 64


def density_of(x: Array, rate: float, length: int) -> tuple[Array, Array]:
    """Average the densities of segments that overlap by half; the mean is not subtracted.

    Args:
        x: (M,) series.
        rate: Its rate [Hz].
        length: Number of values of a segment, at most M.

    Returns:
        Frequencies [Hz], and the one-sided density [unit of x squared / Hz].
    """
    step = length - length // 2
    count = max((len(x) - length) // step + 1, 1)

    # A part begins where the next segment would begin, so that no segment is left out.
    total: Array = np.zeros(length // 2 + 1)
    frequencies: Array = np.zeros(0)
    for first in range(0, count, SEGMENTS_AT_ONCE):
        segments = min(SEGMENTS_AT_ONCE, count - first)
        part = x[first * step : (first + segments - 1) * step + length]
        frequencies, density = scipy.signal.welch(part, rate, nperseg=length, detrend=False)
        total += segments * density
    return frequencies, total / count
