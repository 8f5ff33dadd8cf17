"""Figure of a robustness study: margins of the limits, errors of the estimates, coverage."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import binom

from mjfim.output.plots import style
from mjfim.records.robustness import (
    CONFIDENCE,
    INTERVAL_HALF_WIDTH,
    REQUIRED_COVERAGE,
    Robustness,
)

# Largest error that is drawn [standard deviations]; larger ones are drawn there.
LARGEST_DRAWN_ERROR = 5.0


def robustness_figure(result: Robustness) -> Figure:
    """Draw the margins of every limit, the errors, the coverage, and the errors of the guess.

    Args:
        result: The study.
    """
    figure = style.new_figure(13.0, max(7.0, 0.8 + 0.27 * len(result.limits)))
    grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.25))
    left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])

    _draw_limits(left.subplots(), result)
    axes = right.subplots(3, 1, sharex=True, height_ratios=(1.5, 0.8, 1.0))
    _draw_errors(axes[0], result)
    _draw_coverage(axes[1], result)
    _draw_before_and_after(axes[2], result)

    conditions = result.conditions
    control = "with the gains K(t)" if conditions.feedback else "open loop"
    title = (
        f"{result.runs} robots, every parameter {100 * conditions.wrong:g} % off, commands "
        f"{1e3 * conditions.latency:g} ms late, {control}"
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=style.LARGE_FONT, color=style.TEXT_COLOUR)
    return figure


def _draw_limits(axes: Axes, result: Robustness) -> None:
    """Draw a row per limit: margin of the design, and of every robot."""
    style.format_axes(axes, "margin over half of the range [%]")
    rng = np.random.default_rng(0)
    limits = result.limits
    place = np.arange(len(limits))[::-1]
    shown = 100.0 * np.maximum(result.margins, -1.0)
    low = min(-5.0, float(shown.min(initial=0.0)) - 5.0)
    axes.axvspan(low, 0.0, color=style.OPTIMIZED_COLOUR, alpha=0.10, linewidth=0.0)
    for i, y in enumerate(place):
        colour = style.INITIAL_COLOUR if result.kept[:, i].all() else style.OPTIMIZED_COLOUR
        spread = y + rng.uniform(-0.22, 0.22, result.runs)
        axes.plot(
            shown[:, i], spread, ".", color=colour, markersize=4.5, alpha=0.4, markeredgewidth=0.0
        )
        axes.plot(
            [100.0 * result.planned[i]] * 2,
            [y - 0.32, y + 0.32],
            color=style.TEXT_COLOUR,
            linewidth=1.6,
        )
    axes.set_yticks(
        place,
        [style.shorten(f"{limit.kind.replace('_', ' ')} {limit.name}", 26) for limit in limits],
    )
    axes.set_xlim(low, max(100.0, 100.0 * float(result.planned.max(initial=0.0)) + 5.0))
    axes.set_ylim(-0.7, len(limits) - 0.3)
    title = f"Limits at every engine step: {result.all_kept} of {result.runs} robots keep all"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)
    handles = [
        Line2D([], [], color=style.TEXT_COLOUR, linewidth=1.6, label="plan"),
        Line2D([], [], color=style.INITIAL_COLOUR, marker=".", linestyle="", label="robots"),
        Line2D(
            [],
            [],
            color=style.OPTIMIZED_COLOUR,
            marker=".",
            linestyle="",
            label="robots; some exceed the limit",
        ),
    ]
    axes.legend(
        handles=handles,
        fontsize=style.SMALL_FONT,
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.06),
        ncols=3,
    )


def _draw_errors(axes: Axes, result: Robustness) -> None:
    """Draw the errors of all estimates in standard deviations."""
    style.format_axes(axes, "", "(estimate − truth) / σ")
    rng = np.random.default_rng(0)
    axes.axhspan(
        -INTERVAL_HALF_WIDTH,
        INTERVAL_HALF_WIDTH,
        color=style.MEASURED_COLOUR,
        alpha=0.12,
        linewidth=0.0,
    )
    axes.axhline(0.0, color=style.MUTED_COLOUR, linewidth=0.8)
    for j in range(len(result.names)):
        z = np.clip(result.z[:, j], -LARGEST_DRAWN_ERROR, LARGEST_DRAWN_ERROR)
        hit = np.abs(z) <= INTERVAL_HALF_WIDTH
        x = j + rng.uniform(-0.28, 0.28, len(z))
        for some, colour in ((hit, style.MEASURED_COLOUR), (~hit, style.OPTIMIZED_COLOUR)):
            axes.plot(
                x[some], z[some], ".", color=colour, markersize=4.0, alpha=0.7, markeredgewidth=0.0
            )
    axes.set_ylim(-5.2, 5.2)
    axes.set_title(
        "Errors of the estimates; shaded: range of 95 %",
        fontsize=style.NORMAL_FONT,
        loc="left",
        color=style.TEXT_COLOUR,
    )


def _draw_coverage(axes: Axes, result: Robustness) -> None:
    """Draw how often the interval of each unknown holds the true value."""
    n = result.runs
    x = np.arange(len(result.names))
    share = 100.0 * result.inside / n
    style.format_axes(axes, "", "coverage [%]")
    low, high = (100.0 * k / n for k in binom.interval(CONFIDENCE, n, CONFIDENCE))
    axes.axhspan(low, high, color=style.MEASURED_COLOUR, alpha=0.12, linewidth=0.0)
    axes.axhline(
        100.0 * REQUIRED_COVERAGE, color=style.OPTIMIZED_COLOUR, linewidth=1.0, linestyle="--"
    )
    axes.plot(x, share, "o", color=style.TEXT_COLOUR, markersize=5.0)
    for i, value in enumerate(share):
        axes.annotate(
            f"{value:.0f}",
            (i, value),
            (6, 3),
            textcoords="offset points",
            fontsize=style.SMALL_FONT,
            color=style.TEXT_COLOUR,
        )
    axes.set_ylim(min(85.0, float(share.min(initial=100.0)) - 3.0), 103.0)
    title = "Robots whose 95 % interval holds the true value; dashed: required, shaded: expected"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)


def _draw_before_and_after(axes: Axes, result: Robustness) -> None:
    """Draw the errors of the guess, the predicted and the observed errors of each unknown."""
    x = np.arange(len(result.names))
    style.format_axes(axes, "", "error [% of the guess's]")
    before = np.where(result.wrong > 0.0, result.wrong, np.nan)
    for y, marker, colour, label in (
        (np.full(len(x), 100.0), "o", style.MUTED_COLOUR, "guess"),
        (100.0 * result.predicted / before, "_", style.TEXT_COLOUR, "σ predicted by the design"),
        (
            100.0 * result.observed / before,
            ".",
            style.OPTIMIZED_COLOUR,
            "rms error of the estimates",
        ),
    ):
        size = {"o": 4.0, "_": 20.0, ".": 9.0}[marker]
        axes.plot(
            x,
            y,
            marker,
            color=colour,
            markersize=size,
            markeredgewidth=1.8 if marker == "_" else 0.0,
            label=label,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    low = float(np.nanmin([result.predicted / before, result.observed / before], initial=1.0))
    axes.set_ylim(60.0 * low, 400.0)
    axes.set_xticks(x, [style.shorten(name, 24) for name in result.names], rotation=30, ha="right")
    axes.legend(
        fontsize=style.SMALL_FONT,
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 0.98),
        ncols=3,
        borderpad=0.0,
    )
