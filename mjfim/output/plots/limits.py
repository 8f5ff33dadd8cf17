"""How much of each limit a design uses, at every engine step."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjfim.output.plots.style import (
    GRID_COLOUR,
    MUTED_COLOUR,
    OPTIMIZED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    new_figure,
    shorten,
)
from mjfim.records.design import Design, LimitUsage

KINDS = (
    "position",
    "velocity",
    "acceleration",
    "force",
    "joint_force",
    "control",
    "control_rate",
    "clearance",
)
CLOSEST = 3  # curves that are named


def limits(design: Design) -> Figure:
    """One panel per kind: all its curves in units of their ranges, those that come closest to a bound named."""
    kinds = [kind for kind in KINDS if any(u.kind == kind for u in design.usage)]
    columns = 2 if len(kinds) > 1 else 1
    rows = -(-len(kinds) // columns)
    figure = new_figure(5.6 * columns, 2.1 * rows + 0.9)
    grid = figure.add_gridspec(rows, columns)
    for i, kind in enumerate(kinds):
        axes = figure.add_subplot(grid[divmod(i, columns)])
        draw_usage(axes, [u for u in design.usage if u.kind == kind], kind == "clearance")
        bottom = i + columns >= len(kinds)
        format_axes(
            axes,
            "time [s]" if bottom else "",
            "least / distance" if kind == "clearance" else "half ranges",
        )
        margin = design.limits.get(kind, np.nan)
        axes.set_title(
            _said(kind, margin),
            loc="left",
            fontsize=SMALL_FONT + 1,
            color=OPTIMIZED_COLOUR if margin < 0.0 else TEXT_COLOUR,
            pad=17,
        )
    ends = [
        _said(kind, margin) for kind, margin in design.limits.items() if kind.startswith("end_")
    ]
    note = "Every engine step of the untouched model; the grey zones are out of bounds."
    if ends:
        note += f" At the end: {', '.join(ends)}."
    add_title(figure, "How much of each limit the design uses", [], note)
    return figure


def _said(kind: str, margin: float) -> str:
    """A margin in words."""
    return f"{kind.replace('_', ' ')}: {'kept by' if margin >= 0.0 else 'MISSED by'} {format_number(abs(margin))}"


def draw_usage(axes: Axes, curves: list[LimitUsage], one_sided: bool) -> None:
    """Curves between their bounds at -1 and 1; the closest ones strong and named."""
    order = sorted(curves, key=lambda u: -float(np.abs(u.share).max()))
    for rank, curve in enumerate(order):
        strong = rank < CLOSEST
        colour = (OPTIMIZED_COLOUR, "#ee7733", "#aa3377")[rank] if strong else MUTED_COLOUR
        label = (
            f"{shorten(curve.name, 24)} {100 * float(np.abs(curve.share).max()):.5g} %"
            if strong
            else None
        )
        width, alpha = (1.3, 1.0) if strong else (0.7, 0.5)
        axes.plot(
            curve.t,
            curve.share,
            color=colour,
            label=label,
            linewidth=width,
            alpha=alpha,
            zorder=2 + strong,
        )
    reach = max(1.08, 1.05 * float(np.abs(order[0].share).max()))
    low = 0.0 if one_sided else -reach
    axes.set_ylim(low, reach)
    axes.axhspan(1.0, reach, color=GRID_COLOUR, zorder=0)
    axes.axhline(1.0, color=TEXT_COLOUR, linewidth=0.8, zorder=1)
    if not one_sided:
        axes.axhspan(-reach, -1.0, color=GRID_COLOUR, zorder=0)
        axes.axhline(-1.0, color=TEXT_COLOUR, linewidth=0.8, zorder=1)
    axes.legend(
        loc="upper left",
        bbox_to_anchor=(-0.01, 1.17),
        ncols=CLOSEST,
        fontsize=SMALL_FONT - 1,
        frameon=False,
    )
