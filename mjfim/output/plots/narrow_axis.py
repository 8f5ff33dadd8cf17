"""Ticks of an axis whose values differ little from each other, such as a well-known parameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axis import Axis
from matplotlib.ticker import FixedFormatter, FixedLocator, MaxNLocator, ScalarFormatter

from mjfim.output.plots.style import format_number, power_of_ten, power_text, scale_axis

# Range of an axis, as a share of its largest value, below which ticks count from a value: numbers
# that differ in the fourth digit only are hard to compare.
NARROW_SHARE = 1e-3

# Digits of the range of an axis to which the value is rounded from which ticks count.
OFFSET_DIGITS = 2

# Lengths from tick to tick, without their power of ten.
STEPS = (1, 2, 5, 10)


@dataclass(frozen=True, kw_only=True)
class AxisText:
    """Text that the label of an axis needs, because its ticks do not show plain values.

    Attributes:
        offset: The value from which the ticks count, such as `0.59991`; empty for 0.
        power: Power of ten in which the ticks count, with a space behind it, to be put before the
            unit; empty for 1.
    """

    offset: str = ""
    power: str = ""

    @property
    def minus_offset(self) -> str:
        """Text behind the name of a quantity, such as `− 0.59991`; empty for an offset of 0."""
        if self.offset.startswith("−"):
            return f"+ {self.offset[1:]}"
        return f"− {self.offset}" if self.offset else ""


def place_ticks(axis: Axis, low: float, high: float, middle: float, intervals: int = 2) -> AxisText:
    """Place few ticks with short numbers on an axis.

    Args:
        axis: The axis.
        low: Smallest value on it.
        high: Largest value on it, larger than `low`.
        middle: Value from which the ticks count where all values are near to it. It is rounded.
        intervals: Largest number of intervals between ticks.

    Returns:
        The text for the label.
    """
    locator = MaxNLocator(intervals, steps=STEPS)
    largest = max(abs(low), abs(high))
    if high - low >= NARROW_SHARE * largest:
        axis.set_major_locator(locator)
        power = scale_axis(axis, largest)
        if not power:
            axis.set_major_formatter(_plain_formatter())
        return AxisText(power=power)

    # The offset is rounded to digits that matter on this axis.
    decimals = OFFSET_DIGITS - 1 - int(np.floor(np.log10(high - low)))
    offset = round(float(np.clip(middle, low, high)), decimals)
    differences = np.asarray(locator.tick_values(low - offset, high - offset))
    exponent = power_of_ten(max(abs(low - offset), abs(high - offset)))
    labels = [f"{difference / 10.0**exponent:.4g}".replace("-", "−") for difference in differences]
    axis.set_major_locator(FixedLocator((offset + differences).tolist()))
    axis.set_major_formatter(FixedFormatter(labels))

    digits = decimals + 1 + int(np.floor(np.log10(abs(offset))))
    return AxisText(offset=format_number(offset, digits), power=power_text(exponent))


def _plain_formatter() -> ScalarFormatter:
    """Return a formatter with equal decimals, and without an offset beside the axis."""
    formatter = ScalarFormatter(useOffset=False)
    formatter.set_scientific(False)
    return formatter
