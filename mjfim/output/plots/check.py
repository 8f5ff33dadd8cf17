"""What can be identified, at a glance: predicted accuracy of every parameter beside their correlations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mjfim.output.plots.style import (
    BEST_CASE,
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    OPTIMIZED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_percent,
    new_figure,
    shorten,
    write_message,
)
from mjfim.records.check import CONFOUNDED_CORRELATION, Check, ParameterCheck

READABLE = 14  # parameters up to which correlations are written into the cells


def check_figure(check: Check) -> Figure:
    """Relative standard deviations (bars, log) with the wanted ones, and the correlation matrix of the estimates."""
    rows = [row for row in check.rows if not row.nuisance]
    count = len(rows)
    height = float(np.clip(2.2 + 0.32 * count, 4.0, 16.0))
    figure = new_figure(min(6.2 + height, 22.0), height)
    left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.15])
    _bars(left, rows)
    _heat(right, check)
    handles = [
        Patch(color=INITIAL_COLOUR, label="predicted σ"),
        Line2D([], [], color=TEXT_COLOUR, marker="|", linestyle="", markersize=10, label="wanted"),
        Patch(
            facecolor="white",
            edgecolor=OPTIMIZED_COLOUR,
            hatch="////",
            label="not identifiable alone",
        ),
    ]
    verdict = "identifiable" if check.ok else "read the verdict in check.json"
    add_title(
        figure, f"What {check.source} ({check.horizon:g} s) can tell: {verdict}", handles, BEST_CASE
    )
    return figure


def _bars(axes: Axes, rows: list[ParameterCheck]) -> None:
    std = np.array([row.relative for row in rows])
    wanted = np.array([row.wanted / row.size for row in rows])
    known = np.isfinite(std) & (std > 0.0)
    values = np.concatenate([std[known], wanted])
    low, high = float(values.min()) / 3.0, max(float(values.max()) * 4.0, 0.2)
    places, font = np.arange(len(rows)), SMALL_FONT if len(rows) <= 30 else 6.0
    format_axes(axes, "predicted standard deviation, relative to the parameter's size")
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.barh(places[known], std[known], height=0.6, color=INITIAL_COLOUR)
    axes.barh(
        places[~known],
        high,
        height=0.6,
        facecolor="white",
        edgecolor=OPTIMIZED_COLOUR,
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
    if len(rows) <= 30:
        for x, y in zip(std[known], places[known], strict=True):
            axes.text(
                high,
                y,
                format_percent(float(x)),
                ha="right",
                va="center",
                fontsize=SMALL_FONT,
                color=INITIAL_COLOUR,
            )
    axes.grid(False, axis="y")
    axes.set_yticks(places, [shorten(row.name) for row in rows], fontsize=font)


def _heat(axes: Axes, check: Check) -> None:
    alone = np.arange(len(check.wanted))
    if len(alone) > READABLE:
        alone = np.flatnonzero(np.isfinite(np.diag(check.correlation)))
    matrix, names = (
        check.correlation[np.ix_(alone, alone)],
        [shorten(check.wanted[i], 18) for i in alone],
    )
    count = len(names)
    if not np.isfinite(matrix).any():
        axes.set_axis_off()
        write_message(axes, "no parameter can be told alone:\nthere are no correlations")
        return
    image = axes.imshow(np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    axes.set_facecolor(GRID_COLOUR)
    font = SMALL_FONT if count <= 30 else 5.5
    long = sum(len(name) for name in names) > 24
    axes.set_xticks(range(count), names, fontsize=font, rotation=90 if long else 0)
    axes.set_yticks(range(count), names, fontsize=font)
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)
    for i in range(count):
        for j in range(count):
            value = matrix[i, j]
            if not np.isfinite(value) or i == j:
                continue
            if count <= READABLE:
                strong = abs(value) > 0.6
                weight = "bold" if abs(value) > CONFOUNDED_CORRELATION else "normal"
                colour = "white" if strong else TEXT_COLOUR
                axes.text(
                    j,
                    i,
                    f"{value:+.2f}",
                    ha="center",
                    va="center",
                    fontsize=SMALL_FONT,
                    color=colour,
                    weight=weight,
                )
            elif abs(value) > CONFOUNDED_CORRELATION:
                axes.plot(j, i, marker="o", color=TEXT_COLOUR, markersize=2.0)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02)
    bar.set_label("correlation of the estimates", fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    bar.ax.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR)
    grey = "; grey: not alone" if np.isnan(matrix).any() else ""
    marked = f"{'bold' if count <= READABLE else 'dots'}: |correlation| > {CONFOUNDED_CORRELATION:g}, hardly told apart{grey}"
    axes.set_title(marked, fontsize=SMALL_FONT, color=MUTED_COLOUR)
