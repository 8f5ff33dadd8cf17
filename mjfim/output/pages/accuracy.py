"""Standard deviations in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.output.page import number

# Remark on predicted standard deviations.
BEST_CASE = (
    "σ is the Cramér-Rao bound: the best case, reached if the model and the stated noise are right."
)

# Cell of a standard deviation that is infinite, because others absorb the parameter's effect.
NOT_ALONE = "not alone"

# Largest number of digits of a share in percent.
MAX_DIGITS = 6


def relative(std: float, size: float) -> str:
    """Write a standard deviation in percent of a size; "-" where there is none."""
    if not size or not np.isfinite(std):
        return "-"
    percent = 100.0 * std / size
    # Shares from 99.5 % on are whole numbers, not powers of ten.
    places = len(f"{percent:.0f}") if percent < 10.0**MAX_DIGITS else MAX_DIGITS
    return number(percent, max(places, 2), " %")


def size_sentence(values: Sequence[float] | Array, sizes: Sequence[float] | Array) -> str:
    """Say of what a relative standard deviation is a share; empty where it is of the value."""
    if np.array_equal(np.abs(values), sizes):
        return ""
    return (
        "A relative σ is a share of the value; for an entry of a vector or tensor, and for a value "
        "of zero, it is a share of the magnitude of the whole."
    )


def improvement(before: float, after: float) -> str:
    """Write how a standard deviation changed: divided by a number, or times a number."""
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    return f"÷ {before / after:.1f}" if before >= after else f"× {after / before:.1f}"
