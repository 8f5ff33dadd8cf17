"""Figure of the robots that are drawn from an estimate: a histogram per parameter, and pairs."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mjfim.output.plots.narrow_axis import AxisText, place_ticks
from mjfim.output.plots.style import (
    IDENTIFIED_COLOUR,
    MEASURED_COLOUR,
    SMALL_FONT,
    add_title,
    fit_text,
    format_axes,
    new_figure,
    own_style,
    shorten,
    text_width,
)
from mjfim.output.vocabulary import IDENTIFIED
from mjfim.records.estimate import Estimate, ParameterDraws

# Largest number of parameters of a figure; of more, those with the largest correlations are drawn.
MAX_PARAMETERS = 6

# Largest number of robots that are dots in the panel of a pair.
MAX_DOTS = 1000

# Fewest and most bars of a histogram.
MIN_BINS, MAX_BINS = 5, 30

# Space at both ends of an axis, as a share of the range of the draws.
MARGIN = 0.06

# Characters to which the names of parameters are shortened above a panel, and width of them beside
# an axis [inch].
NAME_WIDTH, LABEL_WIDTH = 18, 1.05

# Sign of the differences from the value that stands above the histogram of a parameter.
DIFFERENCE = "Δ"

# Height of a row of panels, of the panel of a single parameter, and of all that is above and below
# them [inch].
ROW_HEIGHT, SINGLE_HEIGHT, FRAME_HEIGHT = 1.15, 2.2, 1.4


@own_style
def drawn_robots(estimate: Estimate) -> Figure:
    """Draw the parameters of all drawn robots.

    Args:
        estimate: An estimate with draws.
    """
    draws = estimate.draws
    assert draws is not None
    shown = _shown_parameters(draws)
    count = len(shown)

    height = SINGLE_HEIGHT if count == 1 else ROW_HEIGHT * count
    figure = new_figure(height + FRAME_HEIGHT)
    grid = figure.add_gridspec(count, count)
    for i in range(count):
        for j in range(i + 1):
            axes = figure.add_subplot(grid[i, j])
            if i == j:
                _draw_histogram(axes, draws, int(shown[i]))
            else:
                _draw_pairs(axes, draws, int(shown[j]), int(shown[i]))
            is_lowest, is_left = i == count - 1, j == 0 and i > 0
            _format(axes, draws, int(shown[j]), int(shown[i]), is_lowest, is_left)

    handles = [
        Patch(color=MEASURED_COLOUR, alpha=0.6, label="drawn robots"),
        Line2D([], [], color=IDENTIFIED_COLOUR, marker="o", label=IDENTIFIED.word),
    ]
    add_title(figure, _title(draws), handles, _note(estimate, draws, count))
    return figure


def _shown_parameters(draws: ParameterDraws) -> NDArray[np.intp]:
    """Return the parameters to draw: of many, those with the largest correlations."""
    count = len(draws.parameters)
    if count <= MAX_PARAMETERS:
        return np.arange(count)

    deviations = (draws.values - draws.centre) / np.where(draws.std > 0.0, draws.std, 1.0)
    products = np.abs(deviations.T @ deviations) / len(draws)
    np.fill_diagonal(products, 0.0)
    order = np.argsort(-products.max(axis=0), kind="stable")
    return np.sort(order[:MAX_PARAMETERS])


def _draw_histogram(axes: Axes, draws: ParameterDraws, j: int) -> None:
    """Draw how often the values of one parameter were drawn."""
    bins = int(np.clip(np.sqrt(len(draws)), MIN_BINS, MAX_BINS))
    low, high = _range(draws, j)
    counts, edges = np.histogram(draws.values[:, j], bins=bins, range=(low, high))
    axes.stairs(counts, edges, fill=True, color=MEASURED_COLOUR, alpha=0.6)
    axes.axvline(float(draws.centre[j]), color=IDENTIFIED_COLOUR, linewidth=1.4)
    axes.set(yticks=[])
    axes.spines["left"].set_visible(False)


def _draw_pairs(axes: Axes, draws: ParameterDraws, j: int, i: int) -> None:
    """Draw parameter j (across) and i (up) of the robots."""
    robots = draws.values[:MAX_DOTS]
    axes.plot(robots[:, j], robots[:, i], ".", color=MEASURED_COLOUR, markersize=2.5, alpha=0.6)
    axes.plot(draws.centre[j], draws.centre[i], "o", color=IDENTIFIED_COLOUR, markersize=4.0)
    low, high = _range(draws, i)
    margin = MARGIN * (high - low)
    axes.set_ylim(low - margin, high + margin)


def _range(draws: ParameterDraws, j: int) -> tuple[float, float]:
    """Return the range of the draws of a parameter and of its estimate; it is never empty."""
    values = np.append(draws.values[:, j], draws.centre[j])
    low, high = float(values.min()), float(values.max())
    if high > low:
        return low, high
    half = max(abs(low), np.finfo(float).tiny) * 1e-3
    return low - half, high + half


def _format(
    axes: Axes, draws: ParameterDraws, j: int, i: int, is_lowest: bool, is_left: bool
) -> None:
    """Set the range and the labels of a panel with parameter j across and i up."""
    low, high = _range(draws, j)
    margin = MARGIN * (high - low)
    axes.set_xlim(low - margin, high + margin)
    across = place_ticks(axes.xaxis, low - margin, high + margin, float(draws.centre[j]))
    up = AxisText()
    if i == j:
        _write_name(axes, draws.parameters[j], across)
    else:
        up = place_ticks(axes.yaxis, *axes.get_ylim(), float(draws.centre[i]))

    format_axes(
        axes,
        _label(draws, j, across) if is_lowest else "",
        _label(draws, i, up) if is_left else "",
    )
    axes.tick_params(labelbottom=is_lowest, labelleft=is_left)


def _write_name(axes: Axes, name: str, text: AxisText) -> None:
    """Write the name of a parameter above its histogram, and from which value its ticks count."""
    title = shorten(name, NAME_WIDTH)
    if text.offset:
        title += f"\n= {text.offset} + {DIFFERENCE}"
    axes.set_title(title, fontsize=SMALL_FONT, pad=3)


def _label(draws: ParameterDraws, j: int, text: AxisText) -> str:
    """Return the label of an axis: name of a parameter, and unit of the ticks, a line each."""
    sign = f"{DIFFERENCE} " if text.offset else ""
    name = sign + fit_text(draws.parameters[j], LABEL_WIDTH - text_width(sign), SMALL_FONT)
    unit = f"{text.power}{draws.units[j]}".strip()
    return f"{name}\n[{unit}]" if unit else name


def _title(draws: ParameterDraws) -> str:
    """Return the title."""
    count = len(draws)
    return f"{count} drawn {'robot' if count == 1 else 'robots'}"


def _note(estimate: Estimate, draws: ParameterDraws, count: int) -> str:
    """Say from which distribution the robots were drawn."""
    note = (
        "Drawn from the normal distribution with the honest covariance of the estimate, which "
        "agrees with the 95 % intervals, inside the bounds."
    )
    if estimate.misfit:
        note += " It does not cover the error of a model that does not explain the recordings."
    if count < len(draws.parameters):
        note += (
            f" Shown: {count} of {len(draws.parameters)} parameters, those with the largest "
            "correlations."
        )
    if count > 1 and len(draws) > MAX_DOTS:
        note += f" The panels of pairs show {MAX_DOTS} robots."
    return note
