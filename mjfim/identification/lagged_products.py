"""Sums of products of a series with itself, from which autocorrelations follow."""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array

# Number of values whose products are computed at once, at least, and times the largest lag.
VALUES_AT_ONCE = 100_000
LAGS_AT_ONCE = 8


def lagged_products(x: Array, lag: int) -> Array:
    """Sum the products of the values of a series with those some places later.

    The series is divided into parts, so that a long one needs little memory.

    Args:
        x: (M,) series without NaN.
        lag: Largest number of places.

    Returns:
        (lag+1,) sums `sum_i x_i x_(i+k)` for k from 0 to `lag`.
    """
    total = np.zeros(lag + 1)
    length = max(LAGS_AT_ONCE * lag, VALUES_AT_ONCE)
    for first in range(0, len(x), length):
        # A part and the values after it, by a circular convolution that is longer than both.
        part = x[first : first + length]
        with_following = x[first : first + length + lag]
        size = scipy.fft.next_fast_len(len(part) + lag, real=True)
        spectrum = scipy.fft.rfft(with_following, size) * scipy.fft.rfft(part, size).conj()
        total += scipy.fft.irfft(spectrum, size)[: lag + 1]
    return total
