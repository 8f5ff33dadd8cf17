"""Figure of a design's limits: the used share of each limit at every engine step."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjfim.excitation.constraints import SUBSTEP_KINDS
from mjfim.model.coordinates import split_unit
from mjfim.model.units import FORCE_UNITS, LENGTH, per_second
from mjfim.output.limit_curves import (
    closest_to_bounds,
    envelope,
    largest_share,
    whole_percent,
    would_be_solid,
)
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    new_figure,
    own_style,
    panel_width,
    shorten,
    text_width,
)
from mjfim.records.design import Design, LimitUsage
from mjfim.records.labels import Labels

# Kinds of limits in the order of their panels.
LIMIT_KINDS = (*SUBSTEP_KINDS, "control", "control_rate", "clearance")

# Unit of the force of an actuator or joint, by the unit of its control or of its position.
FORCE_OF_CONTROL = {
    coordinate: force
    for unit, force in FORCE_UNITS.items()
    for coordinate in (unit, per_second(unit), force)
}

# Largest number of panels that are as wide as the figure.
MAX_WIDE_PANELS = 3

# Colours of the joints; they differ also for readers who cannot tell red from green.
JOINT_COLOURS = (
    "#4477aa",
    "#ee6677",
    "#228833",
    "#ccbb44",
    "#66ccee",
    "#aa3377",
    "#332288",
    "#999933",
    "#882255",
    "#44aa99",
    "#dd8844",
    "#555555",
)

# Number of curves of a panel that are named with their shares, those closest to a bound.
NAMED_CURVES = 3

# Characters to which the names of curves are shortened, in the panels and in the legend.
CURVE_NAME_WIDTH, LEGEND_NAME_WIDTH = 18, 24


# Height of a panel, of the titles above it, and of a row [inch].
PANEL_HEIGHT, TITLES_HEIGHT, ROW_HEIGHT = 2.0, 0.65, 0.27

# Height of a share of 100 %, over the height of a row.
FULL_ROW = 0.86

# Number of envelopes, and share of a panel that they cover together [% of the limits], above which
# each curve has a row of its own, and largest number of rows.
MAX_ENVELOPES, MAX_COVERED, MAX_ROWS = 2, 60.0, 12

# Characters to which the names of rows are shortened.
ROW_NAME_WIDTH = 22

# Space at both ends of the axis of time, over its length.
X_MARGIN = 0.02


@own_style
def limits(design: Design, labels: Labels) -> Figure:
    """Draw a panel per kind of limit; a joint has the same colour in all of them.

    Args:
        design: A design with limits.
        labels: Labels of the model's columns, which have the units.
    """
    by_kind = {
        kind: curves
        for kind in LIMIT_KINDS
        if (curves := [usage for usage in design.usage if usage.kind == kind])
    }
    columns = 2 if len(by_kind) > MAX_WIDE_PANELS else 1
    colours = joint_colours(design)

    heights = [_panel_height(curves) for curves in by_kind.values()]
    row_heights = [max(heights[i : i + columns]) for i in range(0, len(heights), columns)]
    figure = new_figure(sum(row_heights) + 1.3)
    grid = figure.add_gridspec(len(row_heights), columns, height_ratios=row_heights)
    end = max(float(usage.t[-1]) for usage in design.usage)
    for i, (kind, curves) in enumerate(by_kind.items()):
        axes = figure.add_subplot(grid[divmod(i, columns)])
        if needs_rows(curves):
            _draw_rows(axes, curves, colours)
        else:
            _draw_curves(axes, curves, colours)
            _draw_bounds(axes, curves, one_sided=kind == "clearance")
        _label(axes, curves, _margin_in_words(design, kind, labels), panel_width(columns))
        axes.set_xlim(-X_MARGIN * end, (1.0 + X_MARGIN) * end)
        axes.set_xlabel("time [s]" if i + columns >= len(by_kind) else "")

    note = _note(by_kind)
    end_limits = [
        f"{_words(kind)} {_kept(margin)}"
        for kind, margin in design.limits.items()
        if kind.startswith("end_")
    ]
    if end_limits:
        note += f" At the end: {', '.join(end_limits)}."
    handles = [
        Line2D([], [], color=colour, linewidth=2.0, label=shorten(name, LEGEND_NAME_WIDTH))
        for name, colour in colours.items()
    ]
    add_title(figure, "How much of each limit the design uses", handles, note)
    return figure


def _panel_height(curves: list[LimitUsage]) -> float:
    """Return the height of the panel of one kind of limit, with its title [inch]."""
    if not needs_rows(curves):
        return PANEL_HEIGHT
    return max(PANEL_HEIGHT, TITLES_HEIGHT + ROW_HEIGHT * len(_row_curves(curves)))


def _note(by_kind: dict[str, list[LimitUsage]]) -> str:
    """Explain what is drawn of the limits of each kind."""
    note = (
        "All engine steps of the stated model. ±100 %: at the upper and at the lower bound; grey: "
        "beyond a bound."
    )
    if "clearance" in by_kind:
        note += " Of a clearance: required over actual distance."
    in_rows = [needs_rows(curves) for curves in by_kind.values()]
    fast = [any(map(would_be_solid, curves)) for curves in by_kind.values()]
    if any(is_fast and not rows for is_fast, rows in zip(fast, in_rows, strict=True)):
        note += " Filled: smallest and largest value of a curve that changes too fast to be seen."
    if any(in_rows):
        note += (
            " In rows: the largest share of each interval of time, whichever bound; the line at "
            "the top of a row is the bound."
        )
    return note


# ---- colours


def joint_colours(design: Design) -> dict[str, str]:
    """Return the colour of each joint, actuator and pair of geoms, by its name.

    Of more names than there are colours, those that come closest to a bound have one.

    Args:
        design: A design with limits.
    """
    closest = closest_to_bounds(design.usage)[: len(JOINT_COLOURS)]
    in_order = dict.fromkeys(usage.name for usage in design.usage)
    shown = [name for name in in_order if name in closest]
    return dict(zip(shown, JOINT_COLOURS, strict=False))


# ---- curves


def _draw_curves(axes: Axes, curves: list[LimitUsage], colours: dict[str, str]) -> None:
    """Draw the curves of one kind; those closest to a bound are strong and on top."""
    closest_first = sorted(curves, key=lambda usage: -largest_share(usage))
    for rank, usage in enumerate(closest_first):
        colour = colours.get(usage.name, MUTED_COLOUR)
        strong = rank < NAMED_CURVES
        order = 3.0 - rank / len(curves)
        if not would_be_solid(usage):
            width = 1.4 if strong else 0.7
            axes.plot(usage.t, 100.0 * usage.share, color=colour, linewidth=width, zorder=order)
            continue

        t, low, high = envelope(usage)
        axes.fill_between(
            t, low, high, color=colour, alpha=0.25 if strong else 0.08, linewidth=0.0, zorder=order
        )
        for end in (low, high):
            axes.plot(t, end, color=colour, linewidth=0.9 if strong else 0.4, zorder=order)


def needs_rows(curves: list[LimitUsage]) -> bool:
    """Return whether the envelopes of curves would cover each other, so that each needs a row.

    Args:
        curves: The limits of one kind.
    """
    widths = []
    for usage in filter(would_be_solid, curves):
        _, low, high = envelope(usage)
        widths.append(float(np.mean(high - low)))
    return len(widths) > MAX_ENVELOPES and sum(widths) > MAX_COVERED


def _row_curves(curves: list[LimitUsage]) -> list[LimitUsage]:
    """Return the curves that have rows: of many, those closest to a bound."""
    closest = sorted(range(len(curves)), key=lambda i: -largest_share(curves[i]))[:MAX_ROWS]
    return [curves[i] for i in sorted(closest)]


def _draw_rows(axes: Axes, curves: list[LimitUsage], colours: dict[str, str]) -> None:
    """Draw a row per curve, filled up to the largest share of each interval of time."""
    shown = _row_curves(curves)
    for row, usage in enumerate(shown):
        t, low, high = envelope(usage)
        size = np.maximum(np.abs(low), np.abs(high)) / 100.0
        base = row + 0.5 * FULL_ROW
        colour = colours.get(usage.name, MUTED_COLOUR)
        top = base - FULL_ROW * size
        axes.fill_between(t, base, top, color=colour, alpha=0.45, linewidth=0.0)
        axes.plot(t, top, color=colour, linewidth=0.9)
        axes.axhline(base - FULL_ROW, color=TEXT_COLOUR, linewidth=0.6)

    names = [shorten(usage.name, ROW_NAME_WIDTH) for usage in shown]
    axes.set_yticks(range(len(shown)), names)
    axes.set_ylim(len(shown) - 0.5, -0.6)
    axes.tick_params(axis="y", length=0.0)
    axes.grid(False, axis="y")


def _draw_bounds(axes: Axes, curves: list[LimitUsage], one_sided: bool) -> None:
    """Draw the bounds at 100 % and, unless there is only one, at -100 %; beyond them is grey."""
    largest = 100.0 * max(largest_share(usage) for usage in curves)
    reach = max(112.0, 1.05 * largest)
    axes.set_ylim(0.0 if one_sided else -reach, reach)
    for side in (1.0,) if one_sided else (1.0, -1.0):
        axes.axhspan(100.0 * side, reach * side, color=GRID_COLOUR, zorder=0, linewidth=0.0)
        axes.axhline(100.0 * side, color=TEXT_COLOUR, linewidth=0.8, zorder=1)


# ---- words


def _label(axes: Axes, curves: list[LimitUsage], margin: str, width: float) -> None:
    """Write the margin of a kind, and the curves that come closest to a bound, above a panel."""
    closest = sorted(curves, key=lambda usage: -largest_share(usage))[:NAMED_CURVES]
    shares = [
        f"{shorten(usage.name, CURVE_NAME_WIDTH)} {whole_percent(largest_share(usage))}"
        for usage in closest
    ]
    in_rows = needs_rows(curves)
    format_axes(axes, ylabel="" if in_rows else "share of the limit [%]")

    # Names that do not fit above the panel are left out, the ones farthest from their bounds first.
    size = SMALL_FONT - 1.0
    while len(shares) > 1 and text_width(", ".join(shares), size) > width - text_width("largest: "):
        shares.pop()
    violated = any(largest_share(usage) > 1.0 for usage in closest)
    axes.set_title(
        margin,
        loc="left",
        fontsize=NORMAL_FONT,
        color=DESIGNED_COLOUR if violated else TEXT_COLOUR,
        pad=16,
    )
    axes.text(
        0.0,
        1.02,
        f"largest: {', '.join(shares)}",
        transform=axes.transAxes,
        fontsize=size,
        color=MUTED_COLOUR,
        va="bottom",
    )


def _words(kind: str) -> str:
    """Return the name of a kind of limit in words."""
    return kind.replace("_", " ")


def _kept(margin: float, unit: str = "") -> str:
    """Say whether a limit holds, and by which margin."""
    size = f"{format_number(abs(margin), 2)} {unit}".rstrip()
    return f"VIOLATED by {size}" if margin < 0.0 else f"smallest margin {size}"


def _margin_in_words(design: Design, kind: str, labels: Labels) -> str:
    """Say whether a kind of limit holds, and by which margin in its unit."""
    margin = design.limits.get(kind, float("nan"))
    units = {
        _unit_of(usage, labels)
        for usage in design.usage
        if usage.kind == kind and np.isfinite(usage.share).any()
    }
    return f"{_words(kind)}: {_kept(margin, units.pop() if len(units) == 1 else '')}"


def _unit_of(usage: LimitUsage, labels: Labels) -> str:
    """Return the unit of a limited quantity; empty where the labels do not say it."""
    if usage.kind in ("clearance", "tendon_length"):
        return LENGTH

    of_actuator = usage.kind in ("control", "control_rate", "force")
    columns = labels.controls if of_actuator else labels.positions
    units = dict(split_unit(label) for label in columns)
    unit = units.get(usage.name, "")
    if not unit or unit == "model unit":
        return ""
    return {
        "position": unit,
        "velocity": per_second(unit),
        "acceleration": f"{unit}/s²",
        "control": unit,
        "control_rate": per_second(unit),
        "force": FORCE_OF_CONTROL.get(unit, ""),
        "joint_force": FORCE_OF_CONTROL.get(unit, ""),
    }.get(usage.kind, "")
