"""Methods side by side: what each knows of every parameter, and of the worst combination."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from mjfim.arrays import Array
from mjfim.output.plots.style import (
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    OPTIMIZED_COLOUR,
    OTHER_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    format_percent,
    new_figure,
    shorten,
    write_message,
)
from mjfim.records.comparison import DESIGN, Comparison, MethodResult

READABLE = 12  # parameters up to which numbers are written into the cells
SPAN = 3.0  # ratio at which the colours end
WIDE = 8.0  # ratio of bars from which on their axis is logarithmic
WIDTH = 34  # characters of a method's name


def compare_figure(comparison: Comparison) -> Figure:
    """Standard deviation of every parameter by method, over the design's (cells), beside that of the worst combination (bars)."""
    rows, count = comparison.rows, len(comparison.wanted)
    figure = new_figure(
        float(np.clip(8.4 + 0.5 * count, 10.0, 20.0)),
        float(np.clip(1.9 + 0.36 * len(rows), 3.2, 12.0)),
    )
    left, right = figure.subplots(1, 2, width_ratios=[float(np.clip(0.55 * count, 2.2, 9.0)), 3.6])
    _cells(left, comparison)
    _bars(right, comparison)
    handles = [
        Patch(color=OPTIMIZED_COLOUR, label="design"),
        Patch(color=INITIAL_COLOUR, label="baseline"),
        Patch(color=OTHER_COLOUR, label="baseline that beats the design"),
        Patch(facecolor="white", edgecolor=MUTED_COLOUR, hatch="////", label="may not be played"),
    ]
    used = {_colour(comparison, row) for row in rows if row.sound}
    kept = [
        h
        for h, c in zip(handles, (OPTIMIZED_COLOUR, INITIAL_COLOUR, OTHER_COLOUR), strict=False)
        if c in used
    ]
    kept += (
        handles[3:]
        if any(not row.sound and np.isfinite(row.worst_relative_std) for row in rows)
        else []
    )
    budget = f"{comparison.seconds:g} s"
    if np.isfinite(comparison.steps):
        budget += f" or {format_number(comparison.steps / 1e6)} million MuJoCo steps"
    note = f"{' '.join(comparison.verdict)} Each method had {budget}. Predicted standard deviations are a best case."
    add_title(figure, "The design against what else could be played", kept, note)
    return figure


def _colour(comparison: Comparison, row: MethodResult) -> str:
    if row.method == DESIGN:
        return OPTIMIZED_COLOUR
    return OTHER_COLOUR if row in comparison.beating else INITIAL_COLOUR


def _reference(comparison: Comparison) -> tuple[Array, str]:
    """(t,) standard deviations that others are divided by: the design's, else the parameters' scales; and what that is."""
    wanted, ours = list(comparison.wanted), comparison.design
    if ours is not None and np.isfinite(ours.std[wanted]).any():
        return ours.std[wanted], "σ of each parameter over the design's"
    return comparison.scale[wanted], "σ of each parameter over its scale"


def _cells(axes: Axes, comparison: Comparison) -> None:
    """Ratios by method and parameter; white is 1, red worse, blue better."""
    wanted, rows = list(comparison.wanted), comparison.rows
    reference, title = _reference(comparison)
    ratios = np.array([row.std[wanted] for row in rows]).reshape(len(rows), len(wanted)) / reference
    if not np.isfinite(ratios).any():
        axes.set_axis_off()
        write_message(axes, "no parameter is known alone")
        return
    relative = comparison.design is not None and np.isfinite(comparison.design.std[wanted]).any()
    logs = np.log(np.where(np.isfinite(ratios), ratios, np.nan))
    middle, span = (
        (0.0, np.log(SPAN))
        if relative
        else (float(np.nanmean(logs)), max(float(np.nanstd(logs)) * 2.0, 0.1))
    )
    axes.set_facecolor(GRID_COLOUR)
    image = axes.imshow(
        np.ma.masked_invalid(logs),
        cmap="RdBu_r",
        vmin=middle - span,
        vmax=middle + span,
        aspect="auto",
    )
    names = [shorten(comparison.parameters[j], 18) for j in wanted]
    upright = sum(len(name) for name in names) > 8 * len(names) or len(names) > READABLE
    axes.set_xticks(
        range(len(names)),
        names,
        fontsize=SMALL_FONT if len(names) <= 30 else 5.0,
        rotation=90 if upright else 0,
    )
    axes.set_yticks(
        range(len(rows)),
        [shorten(row.title, WIDTH) for row in rows],
        fontsize=NORMAL_FONT,
        color=TEXT_COLOUR,
    )
    for label, row in zip(axes.get_yticklabels(), rows, strict=True):
        label.set_color(_colour(comparison, row) if row.sound else MUTED_COLOUR)
        label.set_fontweight("bold" if row.method == DESIGN else "normal")
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    if len(names) > READABLE:
        bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, pad=0.015, aspect=30)
        ticks = [t for t in (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8) if abs(np.log(t) - middle) <= span]
        bar.set_ticks(np.log(ticks).tolist(), labels=[f"{t:g}" for t in ticks])
        bar.ax.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR)
        return
    for (i, j), ratio in np.ndenumerate(ratios):
        strong = np.isfinite(ratio) and abs(logs[i, j] - middle) > 0.6 * span
        text = format_number(float(ratio), 3) if np.isfinite(ratio) else "–"
        axes.text(
            j,
            i,
            text,
            ha="center",
            va="center",
            fontsize=SMALL_FONT,
            color="white" if strong else TEXT_COLOUR,
        )


def _bars(axes: Axes, comparison: Comparison) -> None:
    """Worst relative standard deviation by method, and its tightest limit."""
    rows = comparison.rows
    worst = np.array([row.worst_relative_std for row in rows])
    known = worst[np.isfinite(worst)]
    format_axes(axes, "standard deviation, relative to the parameters' scales [–]")
    axes.grid(False, axis="y")
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks([])
    axes.set_title(
        "σ of the worst combination, and the worst margin of all limits",
        fontsize=NORMAL_FONT,
        color=TEXT_COLOUR,
    )
    if not len(known):
        write_message(axes, "nothing found")
        return
    low, high = 0.0, float(known.max())
    if high > WIDE * known.min():
        low = 0.5 * float(known.min())
        axes.set_xscale("log")
    room = high * (high / low) ** 0.75 if low else 1.7 * high
    axes.set_xlim(low, room)
    axes.tick_params(which="both", labelsize=SMALL_FONT, color=MUTED_COLOUR, labelcolor=TEXT_COLOUR)
    for i, row in enumerate(rows):
        if not np.isfinite(row.worst_relative_std):
            axes.text(
                low + 0.02 * (high - low),
                i,
                row.outcome.value,
                va="center",
                fontsize=SMALL_FONT,
                color=MUTED_COLOUR,
            )
            continue
        colour = _colour(comparison, row)
        bar = axes.barh(
            i, row.worst_relative_std - low, left=low, height=0.62, color=colour, linewidth=0.8
        )
        if not row.sound:
            bar[0].set(facecolor="white", edgecolor=MUTED_COLOUR, hatch="////")
        text = axes.text(
            row.worst_relative_std,
            i,
            f"  {format_number(row.worst_relative_std)}",
            va="center",
            fontsize=SMALL_FONT,
            color=TEXT_COLOUR,
        )
        kind, share = row.tightest
        said = (
            f"  {format_percent(share)} {kind.replace('_', ' ')}"
            if kind and np.isfinite(share)
            else ""
        )
        axes.annotate(
            said,
            (1.0, 0.5),
            xycoords=text,
            va="center",
            fontsize=SMALL_FONT - 1.0,
            color=MUTED_COLOUR,
        )
