"""Figure of the comparison of two robots: the difference of every parameter with its interval."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mjfim.arrays import NORMAL_95
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    IDENTIFIED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_with_uncertainty,
    new_figure,
    own_style,
    shorten,
    shorten_label,
)
from mjfim.records.labels import with_unit
from mjfim.records.robots import RobotComparison

# Largest number of parameters; of more, those with the most significant differences are drawn.
MAX_PARAMETERS = 40

# Largest number of rows that are high.
MAX_HIGH_ROWS = 12

# Differences beyond this multiple of the difference that would be found are cut off.
LARGEST_DRAWN = 6.0

# Characters to which names are shortened.
NAME_WIDTH, ROBOT_WIDTH = 26, 24


@own_style
def robot_figure(comparison: RobotComparison) -> Figure:
    """Draw the differences of two robots.

    Args:
        comparison: A comparison of at least one parameter.
    """
    order = comparison.order[:MAX_PARAMETERS].tolist()
    row_height = 0.36 if len(order) <= MAX_HIGH_ROWS else 0.25
    figure = new_figure(1.9 + row_height * len(order))
    axes = figure.subplots()
    _format(axes, comparison, order)
    for row, j in enumerate(order):
        _draw_difference(axes, comparison, j, row)

    handles = [
        Line2D([], [], color=DESIGNED_COLOUR, marker="o", label="differs"),
        Line2D([], [], color=IDENTIFIED_COLOUR, marker="o", label="no difference found"),
        Patch(color=GRID_COLOUR, label="would hardly be found"),
    ]
    first, second = (shorten(name, ROBOT_WIDTH) for name in comparison.names)
    note = (
        f"Numbers: {first} → {second}, each with half the width of its 95 % interval. A difference "
        "outside the strip would be found with a probability of 80 % or more."
    )
    if len(order) < len(comparison.parameters):
        note += (
            f" Shown: {len(order)} of {len(comparison.parameters)} parameters, the most "
            "significant ones."
        )
    if not comparison.is_reliable:
        note += " One of the estimates is not reliable, or does not fit its recordings."
    add_title(figure, _title(comparison), handles, note)
    return figure


def _format(axes: Axes, comparison: RobotComparison, order: list[int]) -> None:
    """Set the range of the axes and their labels."""
    scaled = _scaled(comparison)[order]
    reach = np.clip(np.abs(scaled).max(initial=1.3), 1.3, LARGEST_DRAWN) * 1.08
    axes.set(xlim=(-reach, reach), ylim=(len(order) - 0.4, -0.6))
    axes.axvspan(-1.0, 1.0, color=GRID_COLOUR, alpha=0.6, linewidth=0.0)
    axes.axvline(0.0, color=TEXT_COLOUR, linewidth=1.0)
    axes.grid(False, axis="y")
    names = [
        shorten_label(with_unit(comparison.parameters[j], comparison.units[j]), NAME_WIDTH)
        for j in order
    ]
    axes.set_yticks(range(len(order)), names)
    format_axes(axes, "difference / difference that would be found [–]")


def _scaled(comparison: RobotComparison) -> np.ndarray:
    """Return (q, 3) difference and ends of its interval, over the difference that is found."""
    ends = np.column_stack([comparison.difference, comparison.interval])
    size = np.where(comparison.detectable > 0.0, comparison.detectable, np.nan)
    return np.asarray(np.nan_to_num(ends / size[:, None]))


def _draw_difference(axes: Axes, comparison: RobotComparison, j: int, row: int) -> None:
    """Draw one difference with its interval; arrows mark where the axis cuts it off."""
    low, high = axes.get_xlim()
    centre, begin, end = _scaled(comparison)[j]
    colour = DESIGNED_COLOUR if j in comparison.changed else IDENTIFIED_COLOUR
    axes.plot(np.clip((begin, end), low, high), (row, row), color=colour, linewidth=1.4)
    if begin < low:
        axes.plot(low, row, "<", color=colour, markersize=6, clip_on=False)
    if end > high:
        axes.plot(high, row, ">", color=colour, markersize=6, clip_on=False)
    if low <= centre <= high:
        axes.plot(centre, row, "o", color=colour, markersize=5.5, zorder=3)

    first, second = (
        format_with_uncertainty(float(value), NORMAL_95 * float(std))
        for value, std in zip(comparison.values[:, j], comparison.std[:, j], strict=True)
    )
    axes.text(
        1.02,
        row,
        f"{first} → {second}",
        transform=axes.get_yaxis_transform(),
        va="center",
        fontsize=SMALL_FONT,
        color=DESIGNED_COLOUR if j in comparison.changed else TEXT_COLOUR,
    )


def _title(comparison: RobotComparison) -> str:
    """Return the outcome in a sentence."""
    first, second = (shorten(name, ROBOT_WIDTH) for name in comparison.names)
    if comparison.changed:
        names = [shorten(comparison.parameters[j], NAME_WIDTH) for j in comparison.changed[:3]]
        more = len(comparison.changed) - len(names)
        others = f" and {more} more" if more else ""
        return f"{second} differs from {first} in {', '.join(names)}{others}"
    if comparison.differs:
        return f"{second} differs from {first}, but not in a single parameter"
    return f"{second} and {first}: no difference found"
