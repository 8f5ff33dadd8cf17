"""Figure of a design's limits: the used share of each limit at every engine step."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjfim.excitation.constraints import SUBSTEP_KINDS
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    MUTED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    new_figure,
    own_style,
    shorten,
)
from mjfim.records.design import Design, LimitUsage

# Kinds of limits in the order of their panels.
LIMIT_KINDS = (*SUBSTEP_KINDS, "control", "control_rate", "clearance")

# Colours of the curves that come closest to a bound, the closest first; these curves are named in
# the legend.
NAMED_COLOURS = (DESIGNED_COLOUR, "#ee7733", "#aa3377")

# Characters to which the names of curves are shortened.
CURVE_NAME_WIDTH = 24


@own_style
def limits(design: Design) -> Figure:
    """Draw a panel per kind of limit; the curves that come closest to a bound are named.

    Args:
        design: A design with limits.
    """
    kinds = [kind for kind in LIMIT_KINDS if any(usage.kind == kind for usage in design.usage)]
    columns = 2 if len(kinds) > 1 else 1
    rows = -(-len(kinds) // columns)

    figure = new_figure(2.1 * rows + 0.9)
    grid = figure.add_gridspec(rows, columns)
    for i, kind in enumerate(kinds):
        axes = figure.add_subplot(grid[divmod(i, columns)])
        lowest = i + columns >= len(kinds)
        _draw_kind(axes, design, kind, "time [s]" if lowest else "")

    note = (
        "All engine steps of the stated model, relative to the bounds at ±1; grey: beyond a bound. "
        "Percentages: largest share of a limit that is used. Margins: in the unit of the limit."
    )
    end_limits = [
        _margin_in_words(kind, margin)
        for kind, margin in design.limits.items()
        if kind.startswith("end_")
    ]
    if end_limits:
        note += f" At the end: {', '.join(end_limits)}."
    add_title(figure, "How much of each limit the design uses", [], note)
    return figure


def _draw_kind(axes: Axes, design: Design, kind: str, xlabel: str) -> None:
    """Draw the panel of one kind of limit, with its smallest margin as title."""
    is_clearance = kind == "clearance"
    curves = [usage for usage in design.usage if usage.kind == kind]
    _draw_curves(axes, curves)
    _draw_bounds(axes, curves, is_clearance)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(-0.01, 1.17),
        ncols=len(NAMED_COLOURS),
        fontsize=SMALL_FONT - 1,
        frameon=False,
    )

    ylabel = "required / actual distance [–]" if is_clearance else "position in range [–]"
    format_axes(axes, xlabel, ylabel)
    margin = design.limits.get(kind, np.nan)
    axes.set_title(
        _margin_in_words(kind, margin),
        loc="left",
        fontsize=SMALL_FONT + 1,
        color=DESIGNED_COLOUR if margin < 0.0 else TEXT_COLOUR,
        pad=17,
    )


def _margin_in_words(kind: str, margin: float) -> str:
    """Say whether a limit holds, and by which margin."""
    words = kind.replace("_", " ")
    if margin < 0.0:
        return f"{words}: VIOLATED by {format_number(-margin)}"
    return f"{words}: smallest margin {format_number(margin)}"


def _largest_share(usage: LimitUsage) -> float:
    """Return the largest share of a limit that is used at any time; above 1 it is violated."""
    return float(np.abs(usage.share).max())


def _draw_curves(axes: Axes, curves: list[LimitUsage]) -> None:
    """Draw the curves of one kind; those closest to a bound are strong and named, others pale."""
    closest_first = sorted(curves, key=lambda usage: -_largest_share(usage))
    for rank, usage in enumerate(closest_first):
        if rank >= len(NAMED_COLOURS):
            axes.plot(usage.t, usage.share, color=MUTED_COLOUR, linewidth=0.7, alpha=0.5, zorder=2)
            continue

        percent = 100 * _largest_share(usage)
        axes.plot(
            usage.t,
            usage.share,
            color=NAMED_COLOURS[rank],
            label=f"{shorten(usage.name, CURVE_NAME_WIDTH)} {percent:.5g} %",
            linewidth=1.3,
            zorder=3,
        )


def _draw_bounds(axes: Axes, curves: list[LimitUsage], one_sided: bool) -> None:
    """Draw the bounds at 1 and, unless there is only one, at -1; what lies beyond them is grey."""
    largest = max(_largest_share(usage) for usage in curves)
    reach = max(1.08, 1.05 * largest)
    axes.set_ylim(0.0 if one_sided else -reach, reach)

    axes.axhspan(1.0, reach, color=GRID_COLOUR, zorder=0)
    axes.axhline(1.0, color=TEXT_COLOUR, linewidth=0.8, zorder=1)
    if not one_sided:
        axes.axhspan(-reach, -1.0, color=GRID_COLOUR, zorder=0)
        axes.axhline(-1.0, color=TEXT_COLOUR, linewidth=0.8, zorder=1)
