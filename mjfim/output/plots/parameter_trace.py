"""Figure of the parameters over the iterations of a fit."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mjfim.output.plots.style import (
    IDENTIFIED_COLOUR,
    NOMINAL_COLOUR,
    SMALL_FONT,
    add_title,
    fit_label,
    format_axes,
    new_figure,
    own_style,
    panel_width,
)
from mjfim.output.vocabulary import NOMINAL
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels

# Largest number of parameters; of more, those that changed most over their interval are drawn.
MAX_PARAMETERS = 12

# Number of panels side by side.
PANEL_COLUMNS = 4

# Largest number of intervals between the ticks of a panel.
MAX_TICKS = 4


@own_style
def parameter_trace(estimate: Estimate, labels: Labels) -> Figure:
    """Draw the parameters over the iterations of the search over all data.

    Args:
        estimate: An estimate with a trace.
        labels: Labels of the parameters.

    Raises:
        MjfimError: The labels do not fit the estimate.
    """
    labels.check(parameters=len(estimate.theta))
    shown = _shown_parameters(estimate)
    columns = min(PANEL_COLUMNS, len(shown))
    rows = -(-len(shown) // columns)
    figure = new_figure(1.35 * rows + 1.5)
    grid = figure.add_gridspec(rows, columns)
    for k, j in enumerate(shown):
        axes = figure.add_subplot(grid[divmod(k, columns)])
        _draw_parameter(axes, estimate, int(j))
        label = fit_label(labels.parameter(int(j)), panel_width(columns), SMALL_FONT)
        axes.set_title(label, loc="left", fontsize=SMALL_FONT, pad=3)
        format_axes(axes, "iteration [–]" if k + columns >= len(shown) else "")

    handles: list[Line2D | Patch] = [
        Line2D([], [], color=NOMINAL_COLOUR, label=NOMINAL.word),
        Line2D([], [], color=IDENTIFIED_COLOUR, marker="o", markersize=3, label="estimate so far"),
        Patch(color=IDENTIFIED_COLOUR, alpha=0.15, label="95 % interval of the result"),
    ]
    note = (
        "0: begin of the search over all data, after short searches for a start. The last point is "
        "the identified value."
    )
    if len(shown) < len(estimate.theta):
        note += (
            f" Shown: {len(shown)} of {len(estimate.theta)} parameters, those that changed most "
            "over the width of their interval."
        )
    add_title(figure, "Parameters over the iterations of the fit", handles, note)
    return figure


def _shown_parameters(estimate: Estimate) -> NDArray[np.intp]:
    """Return the parameters to draw: of many, those that changed most over their interval."""
    change = np.ptp(estimate.trace, axis=0)
    width = np.ptp(estimate.interval, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        relative = np.nan_to_num(change / width, nan=0.0, posinf=0.0)
    return np.sort(np.argsort(-relative, kind="stable")[:MAX_PARAMETERS])


def _draw_parameter(axes: Axes, estimate: Estimate, j: int) -> None:
    """Draw one parameter over the iterations, with its guess and its interval."""
    values = np.append(estimate.trace[1:, j], estimate.theta[j])
    low, high = estimate.interval[j]
    if np.isfinite(low) and np.isfinite(high):
        axes.axhspan(low, high, color=IDENTIFIED_COLOUR, alpha=0.15, linewidth=0.0)
    axes.axhline(float(estimate.trace[0, j]), color=NOMINAL_COLOUR, linewidth=1.0)
    axes.plot(values, color=IDENTIFIED_COLOUR, marker="o", markersize=3, linewidth=1.2)
    axes.xaxis.set_major_locator(MaxNLocator(MAX_TICKS, integer=True))
    axes.yaxis.set_major_locator(MaxNLocator(MAX_TICKS))
