"""Figure of a check: predicted accuracy of every parameter, and correlations of the estimates."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mjfim.arrays import Array
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_percent,
    new_figure,
    own_style,
    shorten,
    write_message,
)
from mjfim.output.summaries.accuracy import BEST_CASE
from mjfim.records.check import CONFOUNDED_CORRELATION, Check, ParameterCheck

# Largest number of parameters for which correlations are written into the cells.
MAX_WRITTEN_CELLS = 14

# Largest number of parameters whose names and numbers are written in the usual size.
MAX_USUAL_FONT = 30

# Font sizes for more parameters: of names beside the bars, and of names beside the cells [points].
MANY_BARS_FONT, MANY_CELLS_FONT = 6.0, 5.5

# Characters to which the names of parameters beside the cells are shortened.
CELL_NAME_WIDTH = 18

# Sum of the characters of all names above which the names below the cells are turned upright.
MAX_LEVEL_CHARACTERS = 24

# Size of a correlation above which its cell is so dark that its number is white.
DARK_CELL = 0.6


@own_style
def check_figure(check: Check) -> Figure:
    """Draw predicted and wanted relative standard deviations, and the correlation matrix.

    Args:
        check: The check.
    """
    rows = [row for row in check.rows if not row.nuisance]
    height = float(np.clip(2.2 + 0.32 * len(rows), 4.0, 16.0))
    figure = new_figure(height)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.15])
    _draw_standard_deviations(left, rows)
    _draw_correlations(right, check)

    handles = [
        Patch(color=INITIAL_COLOUR, label="predicted σ"),
        Line2D(
            [], [], color=TEXT_COLOUR, marker="|", linestyle="", markersize=10, label="wanted σ"
        ),
        Patch(
            facecolor="white",
            edgecolor=DESIGNED_COLOUR,
            hatch="////",
            label="not identifiable alone",
        ),
    ]
    verdict = "all parameters identifiable" if check.ok else "see the verdict in check.json"
    title = f"Accuracy that {check.source} ({check.horizon:g} s) can give: {verdict}"
    add_title(figure, title, handles, BEST_CASE)
    return figure


# ---- standard deviations


def _draw_standard_deviations(axes: Axes, rows: list[ParameterCheck]) -> None:
    """Draw a bar per parameter and a mark at its wanted value.

    The bar is hatched where the parameter is not identifiable alone.
    """
    relative_std = np.array([row.relative for row in rows])
    wanted = np.array([row.wanted / row.size for row in rows])
    known = np.isfinite(relative_std) & (relative_std > 0.0)

    # The axis holds all bars and marks, and the numbers at its right end.
    shown = np.concatenate([relative_std[known], wanted])
    low = float(shown.min()) / 3.0
    high = max(float(shown.max()) * 4.0, 0.2)

    format_axes(axes, "predicted standard deviation, relative to the parameter's size [–]")
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(len(rows) - 0.4, -0.6)

    places = np.arange(len(rows))
    axes.barh(places[known], relative_std[known], height=0.6, color=INITIAL_COLOUR)
    axes.barh(
        places[~known],
        high,
        height=0.6,
        facecolor="white",
        edgecolor=DESIGNED_COLOUR,
        hatch="////",
        linewidth=0.8,
    )
    axes.plot(
        wanted,
        places,
        linestyle="",
        marker="|",
        color=TEXT_COLOUR,
        markersize=10,
        markeredgewidth=1.6,
    )

    few = len(rows) <= MAX_USUAL_FONT
    if few:
        _write_percentages(axes, relative_std[known], places[known], high)
    axes.grid(False, axis="y")
    names = [shorten(row.name) for row in rows]
    axes.set_yticks(places, names, fontsize=SMALL_FONT if few else MANY_BARS_FONT)


def _write_percentages(axes: Axes, relative_std: Array, places: Array, right: float) -> None:
    """Write relative standard deviations (n,) at the rows `places` (n,), aligned at `right`."""
    for value, place in zip(relative_std, places, strict=True):
        axes.text(
            right,
            place,
            format_percent(float(value)),
            ha="right",
            va="center",
            fontsize=SMALL_FONT,
            color=INITIAL_COLOUR,
        )


# ---- correlations


def _draw_correlations(axes: Axes, check: Check) -> None:
    """Draw the correlation matrix of the estimates as coloured cells."""
    # Of many parameters, only those that are identifiable alone have a row.
    indices = np.arange(len(check.wanted))
    if len(indices) > MAX_WRITTEN_CELLS:
        indices = np.flatnonzero(np.isfinite(np.diag(check.correlation)))
    correlation = check.correlation[np.ix_(indices, indices)]
    names = [shorten(check.wanted[i], CELL_NAME_WIDTH) for i in indices]

    if not np.isfinite(correlation).any():
        axes.set_axis_off()
        write_message(axes, "no parameter is identifiable alone:\nthere are no correlations")
        return

    image = axes.imshow(np.ma.masked_invalid(correlation), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    axes.set_facecolor(GRID_COLOUR)
    _name_cells(axes, names)
    if len(names) <= MAX_WRITTEN_CELLS:
        _write_correlations(axes, correlation)
    else:
        _mark_confounded(axes, correlation)
    _add_colour_bar(axes, image)

    mark = "bold" if len(names) <= MAX_WRITTEN_CELLS else "dots"
    title = f"correlations; {mark}: above {CONFOUNDED_CORRELATION:g}, hardly distinguishable"
    if np.isnan(correlation).any():
        title += "; grey: not identifiable alone"
    axes.set_title(title, fontsize=SMALL_FONT, color=MUTED_COLOUR)


def _name_cells(axes: Axes, names: list[str]) -> None:
    """Write the names of the parameters beside and below the cells."""
    count = len(names)
    font = SMALL_FONT if count <= MAX_USUAL_FONT else MANY_CELLS_FONT
    upright = sum(len(name) for name in names) > MAX_LEVEL_CHARACTERS

    axes.set_xticks(range(count), names, fontsize=font, rotation=90 if upright else 0)
    axes.set_yticks(range(count), names, fontsize=font)
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)


def _write_correlations(axes: Axes, correlation: Array) -> None:
    """Write the finite correlations (n, n) into their cells, except the diagonal."""
    for (i, j), value in np.ndenumerate(correlation):
        if i == j or not np.isfinite(value):
            continue
        confounded = abs(value) > CONFOUNDED_CORRELATION
        axes.text(
            j,
            i,
            f"{value:+.2f}",
            ha="center",
            va="center",
            fontsize=SMALL_FONT,
            color="white" if abs(value) > DARK_CELL else TEXT_COLOUR,
            weight="bold" if confounded else "normal",
        )


def _mark_confounded(axes: Axes, correlation: Array) -> None:
    """Draw a dot into each cell of `correlation` (n, n) with hardly distinguishable parameters."""
    # Comparisons with NaN are false.
    confounded = np.abs(correlation) > CONFOUNDED_CORRELATION
    np.fill_diagonal(confounded, False)

    rows, columns = np.nonzero(confounded)
    axes.plot(columns, rows, linestyle="", marker="o", color=TEXT_COLOUR, markersize=2.0)


def _add_colour_bar(axes: Axes, image: AxesImage) -> None:
    """Add a bar that says which colour stands for which correlation."""
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02)
    bar.set_label("correlation of the estimates", fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    bar.ax.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR)
