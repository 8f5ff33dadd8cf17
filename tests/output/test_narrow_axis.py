"""Ticks of axes whose values hardly differ are short numbers that show where they are."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from mjfim.output.plots.narrow_axis import AxisText, place_ticks

# Powers of ten in labels.
RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def number(text: str) -> float:
    """The number that a text of a figure shows."""
    mantissa, _, power = text.replace("−", "-").partition("×10")
    return float(mantissa) * 10.0 ** float(power.translate(RAISED) or 0)


def shown(low: float, high: float, middle: float) -> tuple[list[float], list[str], AxisText]:
    """Places and labels of the ticks inside an axis, and the text for its label."""
    axes = Figure().subplots()
    axes.set_xlim(low, high)
    text = place_ticks(axes.xaxis, low, high, middle)
    ticks = axes.xaxis.get_major_ticks()
    axes.xaxis._update_ticks()
    found = [
        (tick.get_loc(), tick.label1.get_text()) for tick in ticks if low <= tick.get_loc() <= high
    ]
    return [place for place, _ in found], [label for _, label in found], text


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("share", [1e-10, 1e-7, 1e-5, 0.9e-3, 1.1e-3, 0.1, 3.0])
def test_the_labels_of_the_ticks_are_short_and_show_their_values(
    share: float, sign: float, size: float
) -> None:
    centre = sign * 0.599907123 * size
    low, high = centre - 0.4 * share * abs(centre), centre + 0.6 * share * abs(centre)
    places, labels, text = shown(low, high, centre)
    assert 2 <= len(places) <= 4
    assert max(map(len, labels)) <= 7
    assert bool(text.offset) == (share < 1e-3)

    # What a reader computes from the labels is where the ticks are.
    power = number(f"1×{text.power}") if text.power else 1.0
    offset = number(text.offset) if text.offset else 0.0
    read = offset + power * np.array([number(label) for label in labels])
    np.testing.assert_allclose(read, places, rtol=0.0, atol=1e-3 * (high - low))

    # The estimate is at zero, but for the digits that an eye cannot see.
    if text.offset:
        assert abs(offset - centre) < 0.06 * (high - low)


def test_the_offset_is_subtracted_behind_a_name() -> None:
    assert AxisText(offset="0.5").minus_offset == "− 0.5"
    assert AxisText(offset="−0.5").minus_offset == "+ 0.5"
    assert AxisText().minus_offset == ""
