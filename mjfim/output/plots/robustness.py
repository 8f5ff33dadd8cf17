"""Figure of a robustness study: margins of the limits, errors of the estimates, coverage."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjfim.arrays import NORMAL_95
from mjfim.output.plots import style
from mjfim.output.vocabulary import NOMINAL
from mjfim.records.robustness import (
    CONFIDENCE,
    REQUIRED_COVERAGE,
    Robustness,
)

# Largest error on the axis [standard deviations]; larger errors are drawn at this value.
LARGEST_DRAWN_ERROR = 5.0

# Smallest margin on the axis, over half of the range; smaller margins are drawn at this value.
LEAST_DRAWN_MARGIN = -1.0

# Characters to which the names of limits and of parameters are shortened.
LIMIT_NAME_WIDTH, PARAMETER_NAME_WIDTH = 26, 24

# Opacity of red dots, which look orange where the paper shines through.
RED_OPACITY = 0.95

# Largest number of parameters whose coverage is written, and the font size of more names [points].
MAX_WRITTEN_NUMBERS, MANY_NAMES_FONT = 12, 6.0

# Sum of the characters of all names of parameters above which the names are turned.
MAX_LEVEL_CHARACTERS = 48


@style.own_style
def robustness_figure(result: Robustness) -> Figure:
    """Draw the margins of every limit, the errors, the coverage, and errors of the nominal values.

    Args:
        result: The study.
    """
    figure = style.new_figure(max(6.6, 2.0 + 0.22 * len(result.limits)))
    has_limits = bool(result.limits)
    widths = (1.0, 1.3) if has_limits else (1.0,)
    grid = figure.add_gridspec(3, len(widths), width_ratios=widths, height_ratios=(1.4, 0.8, 1.0))
    axes = [figure.add_subplot(grid[0, -1])]
    axes += [figure.add_subplot(grid[row, -1], sharex=axes[0]) for row in (1, 2)]
    for upper in axes[:2]:
        upper.tick_params(labelbottom=False)

    if has_limits:
        _draw_limits(figure.add_subplot(grid[:, 0]), result)
    _draw_errors(axes[0], result)
    _draw_coverage(axes[1], result)
    _draw_before_and_after(axes[2], result)

    conditions = result.conditions
    control = "with the gains K(t)" if conditions.feedback else "open loop"
    title = (
        f"{result.runs} robots, every parameter {100 * conditions.wrong:g} % off, commands "
        f"{1e3 * conditions.latency:g} ms late, {control}"
    )
    place = "Left: dots are robots. Right, from above:" if has_limits else "From above:"
    note = (
        f"{place} errors over the formal σ (shaded: 95 % range; red: outside); robots whose 95 % "
        "interval holds the true value (dashed: required, shaded: expected); errors in percent of "
        "the error of the nominal value."
    )
    if not has_limits:
        note += " The experiment states no limits."
    style.add_title(figure, title, _handles(has_limits=has_limits), note)
    return figure


def _draw_limits(axes: Axes, result: Robustness) -> None:
    """Draw a row per limit: margin of the design, and of every robot."""
    limits = result.limits
    rows = np.arange(len(limits))[::-1]
    percent = 100.0 * np.maximum(result.margins, LEAST_DRAWN_MARGIN)
    low = min(-5.0, float(percent.min(initial=0.0)) - 5.0)
    high = max(100.0, 100.0 * float(result.planned.max(initial=0.0)) + 5.0)

    # The robots of a row are spread at random over its height, so that all dots are visible.
    rng = np.random.default_rng(0)
    style.format_axes(axes, "margin over half of the range [%]")
    axes.axvspan(low, 0.0, color=style.DESIGNED_COLOUR, alpha=0.10, linewidth=0.0)
    for i, row in enumerate(rows):
        is_kept = bool(result.kept[:, i].all())
        axes.plot(
            percent[:, i],
            row + rng.uniform(-0.22, 0.22, result.runs),
            "o",
            color=style.MEASURED_COLOUR if is_kept else style.DESIGNED_COLOUR,
            markersize=3.5,
            alpha=0.5 if is_kept else RED_OPACITY,
            markeredgewidth=0,
        )

        planned = 100.0 * result.planned[i]
        ends = (row - 0.32, row + 0.32)
        axes.plot((planned, planned), ends, color=style.TEXT_COLOUR, linewidth=1.6)

    names = [f"{limit.kind.replace('_', ' ')} {limit.name}" for limit in limits]
    axes.set_yticks(rows, [style.shorten(name, LIMIT_NAME_WIDTH) for name in names])
    axes.set_xlim(low, high)
    axes.set_ylim(-0.7, len(limits) - 0.3)
    title = f"{result.all_kept} of {result.runs} robots keep all limits"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)


def _handles(*, has_limits: bool) -> list[Line2D]:
    """Return the entries of the legend."""
    keeping = Line2D(
        [],
        [],
        color=style.MEASURED_COLOUR,
        marker=".",
        linestyle="",
        label="robots, all keep the limit",
    )
    exceeding = Line2D(
        [],
        [],
        color=style.DESIGNED_COLOUR,
        marker=".",
        linestyle="",
        label="robots, some exceed the limit",
    )
    planned = Line2D([], [], color=style.TEXT_COLOUR, linewidth=1.6, label="planned")
    guess = Line2D([], [], color=style.NOMINAL_COLOUR, marker="o", linestyle="", label=NOMINAL.word)
    estimates = Line2D(
        [], [], color=style.IDENTIFIED_COLOUR, marker="o", linestyle="", label="estimates"
    )
    predicted = Line2D(
        [],
        [],
        color=style.TEXT_COLOUR,
        marker="_",
        markersize=14,
        markeredgewidth=1.8,
        linestyle="",
        label="σ predicted by the design",
    )
    of_limits = [planned, keeping, exceeding] if has_limits else []
    return [*of_limits, guess, estimates, predicted]


def _draw_errors(axes: Axes, result: Robustness) -> None:
    """Draw the errors of all estimates in standard deviations."""
    style.format_axes(axes, "", "(estimate − truth) / σ")
    axes.axhspan(
        -NORMAL_95,
        NORMAL_95,
        color=style.GRID_COLOUR,
        alpha=0.8,
        linewidth=0.0,
    )
    axes.axhline(0.0, color=style.MUTED_COLOUR, linewidth=0.8)

    # The robots of a parameter are spread at random, so that all dots are visible.
    rng = np.random.default_rng(0)
    for j in range(len(result.names)):
        z = np.clip(result.z[:, j], -LARGEST_DRAWN_ERROR, LARGEST_DRAWN_ERROR)
        x = j + rng.uniform(-0.28, 0.28, len(z))
        inside = np.abs(z) <= NORMAL_95
        for chosen, colour, opacity in (
            (inside, style.IDENTIFIED_COLOUR, 0.6),
            (~inside, style.DESIGNED_COLOUR, RED_OPACITY),
        ):
            axes.plot(
                x[chosen],
                z[chosen],
                "o",
                color=colour,
                markersize=3.5,
                alpha=opacity,
                markeredgewidth=0.0,
            )

    axes.set_ylim(-LARGEST_DRAWN_ERROR - 0.2, LARGEST_DRAWN_ERROR + 0.2)
    axes.set_title(
        "errors of the estimates",
        fontsize=style.NORMAL_FONT,
        loc="left",
        color=style.TEXT_COLOUR,
    )


def _draw_coverage(axes: Axes, result: Robustness) -> None:
    """Draw how often the interval of each unknown holds the true value."""
    from scipy.stats import binom  # slow, and only this picture needs it

    n = result.runs
    x = np.arange(len(result.names))
    share = 100.0 * result.inside / n
    style.format_axes(axes, "", "coverage [%]")
    low, high = (100.0 * k / n for k in binom.interval(CONFIDENCE, n, CONFIDENCE))
    axes.axhspan(low, high, color=style.GRID_COLOUR, alpha=0.8, linewidth=0.0)
    axes.axhline(
        100.0 * REQUIRED_COVERAGE, color=style.DESIGNED_COLOUR, linewidth=1.0, linestyle="--"
    )
    axes.plot(x, share, "o", color=style.IDENTIFIED_COLOUR, markersize=5.0)
    few = len(share) <= MAX_WRITTEN_NUMBERS
    for i, value in enumerate(share if few else []):
        axes.annotate(
            f"{value:.0f}",
            (i, value),
            (6, 3),
            textcoords="offset points",
            fontsize=style.SMALL_FONT,
            color=style.TEXT_COLOUR,
        )
    axes.set_ylim(min(85.0, float(share.min(initial=100.0)) - 3.0), 103.0)
    title = "robots whose 95 % interval holds the true value"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)


def _draw_before_and_after(axes: Axes, result: Robustness) -> None:
    """Draw nominal, predicted and observed errors of each unknown."""
    style.format_axes(axes, "", "error [%]")
    x = np.arange(len(result.names))
    guess = np.where(result.wrong > 0.0, result.wrong, np.nan)
    predicted, observed = result.predicted / guess, result.observed / guess

    axes.plot(
        x,
        np.full(len(x), 100.0),
        "o",
        color=style.NOMINAL_COLOUR,
        markersize=4.0,
        markeredgewidth=0.0,
    )
    axes.plot(
        x,
        100.0 * predicted,
        "_",
        color=style.TEXT_COLOUR,
        markersize=20.0,
        markeredgewidth=1.8,
    )
    axes.plot(
        x,
        100.0 * observed,
        ".",
        color=style.IDENTIFIED_COLOUR,
        markersize=9.0,
        markeredgewidth=0.0,
    )

    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    low = float(np.nanmin([predicted, observed], initial=1.0))
    axes.set_ylim(60.0 * low, 400.0)
    names = [style.shorten(name, PARAMETER_NAME_WIDTH) for name in result.names]
    if sum(len(name) for name in names) <= MAX_LEVEL_CHARACTERS:
        axes.set_xticks(x, names)
    else:
        axes.set_xticks(x, names, rotation=90)
        many = len(names) > MAX_WRITTEN_NUMBERS
        axes.tick_params(axis="x", labelsize=MANY_NAMES_FONT if many else style.SMALL_FONT)
    axes.set_title(
        "rms error and σ, over the error of the nominal value",
        fontsize=style.NORMAL_FONT,
        loc="left",
    )
