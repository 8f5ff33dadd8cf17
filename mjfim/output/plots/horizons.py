"""Figure of fits over segments of several lengths: errors by horizon, and what each fit finds."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjfim.output.plots import style
from mjfim.records.estimate import Estimate, HorizonStudy

# Largest number of parameters whose estimates are drawn.
MAX_PARAMETERS = 6

# Height of the panels of errors, of a parameter, and of all else [inch].
ERRORS_HEIGHT, ROW_HEIGHT, FIXED_HEIGHT = 2.6, 0.9, 1.3

# Dashes and markers of the curves of the lengths that were not chosen.
LINE_STYLES = (":", "--", "-.", (0, (8, 2)), (0, (1, 4)))
MARKERS = ("s", "^", "D", "v", "P")

# Characters of a label above which its unit has a line of its own.
MAX_LABEL = 9

# Room beside the shortest and the longest length, as a factor.
SIDE_FACTOR = 1.6


@style.own_style
def horizons_figure(estimate: Estimate) -> Figure:
    """Draw the error of left-out data against the horizon, and the estimates against the length.

    Args:
        estimate: An estimate for which lengths of segments were compared.
    """
    study = estimate.horizons
    assert study is not None
    shown = shown_parameters(study)

    figure = style.new_figure(FIXED_HEIGHT + ERRORS_HEIGHT + ROW_HEIGHT * len(shown))
    heights = [ERRORS_HEIGHT, *[ROW_HEIGHT] * len(shown)]
    grid = figure.subplots(len(heights), 1, height_ratios=heights, sharex=True, squeeze=False)
    _draw_errors(grid[0, 0], study)
    for axes, j in zip(grid[1:, 0], shown, strict=True):
        _draw_estimates(axes, study, j)
    grid[-1, 0].set_xlabel("time over which is predicted, and length of the fitted segments [s]")

    note = (
        "Each part of the data is predicted by fits to the other parts; with the right model and "
        "noise, the error is about 1 σ over any time. Bars are 95 % intervals by the scatter "
        "between the parts."
    )
    style.add_title(figure, _title(study), _handles(study), note)
    return figure


def shown_parameters(study: HorizonStudy) -> list[int]:
    """Indices of the parameters whose estimates are drawn: those that depend on the length first.

    Args:
        study: The comparison.
    """
    moves = np.ptp(study.theta, axis=0) / np.maximum(np.nanmax(study.half_widths, axis=0), 1e-300)
    dependent = np.asarray(study.is_apart, dtype=bool).any(axis=0)
    order = np.lexsort((-moves, ~dependent))
    return sorted(order[:MAX_PARAMETERS].tolist())


def _title(study: HorizonStudy) -> str:
    """Return the outcome in a sentence."""
    name = study.name_of(study.chosen)
    chosen = f"{name[0].upper()}{name[1:]}"
    outcome = f"{chosen} were chosen" if study.is_used else f"{chosen} were chosen, but not used"
    if not study.dependent:
        return outcome
    names = ", ".join(study.dependent[:MAX_PARAMETERS])
    verb = "depends" if len(study.dependent) == 1 else "depend"
    return f"{outcome}; {names} {verb} on the length"


def _draw_errors(axes: Axes, study: HorizonStudy) -> None:
    """Draw the error of each fit against the horizon."""
    style.format_axes(axes, "", "error of left-out data [σ]")
    for i, errors in enumerate(study.errors):
        axes.plot(study.lengths, errors, **_line(study, i))

    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(study.lengths[0] / SIDE_FACTOR, study.lengths[-1] * SIDE_FACTOR)
    axes.set_xticks(study.lengths, [f"{length:.2g}" for length in study.lengths], minor=False)
    axes.set_xticks([], minor=True)
    style.set_plain_log_ticks(axes.yaxis)


def _line(study: HorizonStudy, index: int) -> dict[str, Any]:
    """Properties of the curve of a fit: bold for the chosen length, dashed for the others."""
    if index == study.chosen:
        return {
            "color": style.IDENTIFIED_COLOUR,
            "linewidth": 2.2,
            "marker": "o",
            "markersize": 5.0,
            "zorder": 3.0,
        }
    return {
        "color": style.MUTED_COLOUR,
        "linewidth": 1.1,
        "linestyle": LINE_STYLES[index % len(LINE_STYLES)],
        "marker": MARKERS[index % len(MARKERS)],
        "markersize": 4.5,
    }


def _handles(study: HorizonStudy) -> list[Line2D]:
    """Legend entries of all fits."""
    handles = []
    for i in range(len(study.lengths)):
        chosen = ", chosen" if i == study.chosen else ""
        handles.append(Line2D([], [], label=f"{study.name_of(i)}{chosen}", **_line(study, i)))
    return handles


def _draw_estimates(axes: Axes, study: HorizonStudy, j: int) -> None:
    """Draw the estimate of one parameter against the length of the segments."""
    unit = f" [{study.units[j]}]" if study.units[j] else ""
    label = f"{style.shorten(study.parameters[j], 14)}{unit}"
    style.format_axes(axes, "", style.break_before_unit(label, MAX_LABEL))
    for i, length in enumerate(study.lengths):
        is_chosen = i == study.chosen
        axes.errorbar(
            length,
            study.theta[i, j],
            yerr=np.nan_to_num(study.half_widths[i, j]),
            fmt="o",
            capsize=3.0,
            color=style.IDENTIFIED_COLOUR if is_chosen else style.MUTED_COLOUR,
            markersize=5.0 if is_chosen else 4.0,
        )
    axes.axhline(study.theta[study.chosen, j], color=style.IDENTIFIED_COLOUR, linewidth=0.6)
