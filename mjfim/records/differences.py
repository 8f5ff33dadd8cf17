"""Differences of two values in words, for sentences that people read."""

from __future__ import annotations

from mjfim.records.intervals import NORMAL_95

# Difference over the value it is compared with, up to which it is written in percent.
LARGEST_SHARE = 10.0

# Smallest p-value that is written as a number.
SMALLEST_P = 1e-15


def difference_text(
    value: float, reference: float, reference_std: float, unit: str, *, is_single: bool
) -> str:
    """Write how far a value is above or below another one, in percent where this means something.

    Args:
        value: The value.
        reference: The other one, in the same unit.
        reference_std: Its standard deviation.
        unit: The unit; may be empty.
        is_single: Whether the value is a single number, such as a mass. The entry of a vector, and
            a coordinate that may be zero, have no percentage.
    """
    above = "above" if value > reference else "below"
    change, size = abs(value - reference), abs(reference)

    # A percentage of a value that may be zero means nothing.
    is_positive = value * reference > 0.0 and size > NORMAL_95 * reference_std
    if is_single and is_positive and change <= LARGEST_SHARE * size:
        return f"{100.0 * change / size:.2g} % {above}"
    amount = f"{change:.2g} {unit}".rstrip()
    return f"{amount} {above}"


def value_text(value: float, std: float) -> str:
    """Write a value with half the width of its 95 % interval.

    Args:
        value: The value.
        std: Its standard deviation.
    """
    return f"{value:.3g} ± {NORMAL_95 * std:.2g}"


def p_text(p: float) -> str:
    """Write a p-value.

    Args:
        p: The p-value.
    """
    return f"p = {p:.1g}" if p >= SMALLEST_P else f"p < {SMALLEST_P:g}"
