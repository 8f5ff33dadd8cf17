"""Figure of a check: predicted accuracy of every parameter, and correlations of the estimates."""

from __future__ import annotations

import re

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.correlation_colours import SCALE_IN_WORDS, colour_strength
from mjfim.output.plots.style import (
    GRID_COLOUR,
    LARGE_FONT,
    MUTED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    WIDTH,
    add_title,
    as_sentence,
    format_axes,
    format_number,
    format_percent,
    new_figure,
    own_style,
    shorten,
    text_width,
    without_zeros,
)
from mjfim.output.summaries.accuracy import BEST_CASE
from mjfim.output.vocabulary import DESIGNED, INITIAL, MEASURED
from mjfim.records.check import CONFOUNDED_CORRELATION, Check

# Largest number of parameters for which correlations are written into the cells.
MAX_WRITTEN_CELLS = 8

# Largest number of parameters whose names and numbers are written in the usual size, and the font
# size of more [points].
MAX_USUAL_FONT, MANY_ROWS_FONT = 30, 6.0

# Characters to which the names of parameters are shortened, beside the bars and below the cells.
NAME_WIDTH, CELL_NAME_WIDTH = 26, 18

# Width that the cells have at least; names below them that need more are turned upright [inch].
MATRIX_WIDTH = 3.6

# Strength of the colour of a cell above which its number is white.
DARK_CELL = 0.6

# Height of a row, and of all that is above and below the rows [inch].
ROW_HEIGHT, MANY_ROWS_HEIGHT, FRAME_HEIGHT = 0.3, 0.16, 2.4

# Number of lines of a title above which it is shortened.
MAX_TITLE_LINES = 2

# Height of a bar as a share of the height of a row.
BAR_HEIGHT = 0.6

# Opacity of the bars of combinations.
COMBINATION_OPACITY = 0.45

# Colour of the cells of the diagonal, where a parameter meets itself.
DIAGONAL_COLOUR = "#f1f2f3"


@own_style
def check_figure(check: Check) -> Figure:
    """Draw predicted and wanted relative standard deviations, and the correlation matrix.

    Both have a row per parameter. Identifiable combinations have bars below the parameters.

    Args:
        check: The check.
    """
    count = len(check.wanted)
    rows = count + len(check.combined)
    row_height = ROW_HEIGHT if rows <= MAX_USUAL_FONT else MANY_ROWS_HEIGHT
    figure = new_figure(FRAME_HEIGHT + row_height * rows)
    has_correlations = bool(np.isfinite(check.correlation).any()) and count > 1

    if has_correlations:
        left, right = figure.subplots(1, 2, sharey=True, width_ratios=[1.15, 1.0])
        _draw_correlations(right, check)
    else:
        left = figure.subplots()
    _draw_standard_deviations(left, check)

    note = BEST_CASE
    if not has_correlations and count > 1:
        note = f"No parameter is identifiable alone, so there are no correlations. {note}"
    verdict = check.verdict[0] if check.verdict else "all parameters are identifiable"
    add_title(figure, _title(verdict), _handles(check), note)
    return figure


def _title(verdict: str) -> str:
    """Return a verdict as the title; a long one without what stands in brackets."""
    plain = verdict.replace("`", "").removesuffix(".")
    if text_width(plain, LARGE_FONT) > MAX_TITLE_LINES * WIDTH:
        plain = re.sub(r" \([^()]*\)", "", plain)
    return as_sentence(plain)


def colour_of_source(check: Check) -> str:
    """Return the colour of the motion that was checked.

    Args:
        check: The check.
    """
    if "recording" in check.source:
        return MEASURED.colour
    return DESIGNED.colour if "design" in check.source else INITIAL.colour


def duration(check: Check) -> str:
    """Return the duration of the motion that was checked, with its unit.

    Args:
        check: The check.
    """
    return f"{without_zeros(format_number(check.horizon))} s"


def _handles(check: Check) -> list[Patch | Line2D]:
    """Return the entries of the legend."""
    colour = colour_of_source(check)
    handles: list[Patch | Line2D] = [
        Patch(color=colour, label=f"predicted σ, {check.source} ({duration(check)})"),
        Line2D(
            [], [], color=TEXT_COLOUR, marker="|", linestyle="", markersize=10, label="wanted σ"
        ),
    ]
    if check.combined:
        label = "identifiable combination"
        handles.append(Patch(color=colour, alpha=COMBINATION_OPACITY, label=label))
    if any(not np.isfinite(row.std) for row in check.rows if not row.nuisance):
        handles.append(
            Patch(
                facecolor="white",
                edgecolor=MUTED_COLOUR,
                hatch="////",
                label="not identifiable alone",
            )
        )
    return handles


# ---- standard deviations


def _draw_standard_deviations(axes: Axes, check: Check) -> None:
    """Draw a bar per parameter and combination, and a mark at the wanted value of a parameter.

    The bar is hatched where the parameter is not identifiable alone.
    """
    rows = [row for row in check.rows if not row.nuisance]
    combined = check.combined
    of_combinations = [c.std_final / abs(c.value) if c.value else np.nan for c in combined]
    relative_std = np.array([*(row.relative for row in rows), *of_combinations])
    wanted = np.array([row.wanted / row.size for row in rows])
    known = np.isfinite(relative_std) & (relative_std > 0.0)

    # The axis holds all bars and marks, and the numbers at its right end.
    shown = np.concatenate([relative_std[known], wanted[np.isfinite(wanted) & (wanted > 0.0)]])
    low, high = 1e-3, 1.0
    if len(shown):
        low, high = float(shown.min()) / 3.0, float(shown.max())
        high *= (high / low) ** 0.35

    format_axes(axes, "predicted σ, relative to the size of the parameter [%]")
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(len(relative_std) - 0.5, -0.5)
    axes.xaxis.set_major_formatter(lambda value, _: f"{100.0 * value:g}")
    axes.minorticks_off()
    axes.grid(False, axis="y")

    colour = colour_of_source(check)
    for place, value in enumerate(relative_std):
        if not known[place]:
            is_alone = place >= len(rows) or np.isfinite(rows[place].std)
            axes.barh(
                place,
                high,
                height=BAR_HEIGHT,
                facecolor="white",
                edgecolor=GRID_COLOUR if is_alone else MUTED_COLOUR,
                hatch="" if is_alone else "////",
                linewidth=0.5,
            )
            continue
        opacity = 1.0 if place < len(rows) else COMBINATION_OPACITY
        axes.barh(place, value, height=BAR_HEIGHT, color=colour, alpha=opacity)
    # A light mark below the dark one can be seen on a bar.
    for mark_colour, width in (("white", 3.2), (TEXT_COLOUR, 1.6)):
        axes.plot(
            wanted,
            np.arange(len(rows)),
            linestyle="",
            marker="|",
            color=mark_colour,
            markersize=10,
            markeredgewidth=width,
        )

    few = len(relative_std) <= MAX_USUAL_FONT
    if few:
        _write_percentages(axes, relative_std, known, colour)
    names = [shorten(row.name, NAME_WIDTH) for row in rows]
    names += [shorten(combination.expression, NAME_WIDTH) for combination in combined]
    size = SMALL_FONT if few else MANY_ROWS_FONT
    axes.set_yticks(range(len(names)), names, fontsize=size)
    axes.tick_params(axis="y", length=0.0)


def _write_percentages(axes: Axes, relative_std: Array, known: Array, colour: str) -> None:
    """Write the known relative standard deviations (n,) at the right end of their rows."""
    for place in np.flatnonzero(known):
        axes.text(
            0.99,
            float(place),
            format_percent(float(relative_std[place])),
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="center",
            fontsize=SMALL_FONT,
            color=colour,
        )


# ---- correlations


def _draw_correlations(axes: Axes, check: Check) -> None:
    """Draw the correlation matrix of the estimates as coloured cells, beside the bars."""
    count = len(check.wanted)
    correlation = np.array(check.correlation)
    unknown = ~np.isfinite(correlation)
    np.fill_diagonal(correlation, np.nan)

    strength = np.ma.masked_invalid(colour_strength(correlation))
    axes.imshow(strength, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto")
    _shade(axes, unknown, GRID_COLOUR)
    _shade(axes, np.eye(count, dtype=bool) & ~unknown, DIAGONAL_COLOUR)
    if count <= MAX_WRITTEN_CELLS:
        _write_correlations(axes, correlation)
    else:
        _mark_confounded(axes, correlation)

    names = [shorten(name, CELL_NAME_WIDTH) for name in check.wanted]
    font = SMALL_FONT if count <= MAX_USUAL_FONT else MANY_ROWS_FONT
    upright = max(text_width(name) for name in names) > MATRIX_WIDTH / count
    axes.set_xticks(range(count), names, fontsize=font, rotation=90 if upright else 0)
    axes.tick_params(length=0.0, labelleft=False)
    axes.spines[:].set_visible(False)
    axes.grid(False)

    mark = "bold" if count <= MAX_WRITTEN_CELLS else "dot"
    title = f"correlation (red: positive, blue: negative)\n{SCALE_IN_WORDS}\n"
    title += f"{mark}: beyond ±{CONFOUNDED_CORRELATION:g}, hardly distinguishable"
    if unknown.any():
        title += "\ngrey: not identifiable alone"
    axes.set_title(title, loc="left", fontsize=SMALL_FONT, color=MUTED_COLOUR)


def _shade(axes: Axes, cells: NDArray[np.bool_], colour: str) -> None:
    """Fill the cells that are true in (n, n) with a colour."""
    image = np.ma.masked_equal(np.asarray(cells, dtype=np.float64), 0.0)
    if image.count():
        axes.imshow(image, cmap=ListedColormap([colour]), aspect="auto")


def _write_correlations(axes: Axes, correlation: Array) -> None:
    """Write the finite correlations (n, n) into their cells."""
    strength = np.abs(colour_strength(correlation))
    for (i, j), value in np.ndenumerate(correlation):
        if not np.isfinite(value):
            continue
        confounded = abs(value) > CONFOUNDED_CORRELATION
        axes.text(
            j,
            i,
            f"{value:+.2f}".replace("-", "−"),
            ha="center",
            va="center",
            fontsize=SMALL_FONT,
            color="white" if strength[i, j] > DARK_CELL else TEXT_COLOUR,
            weight="bold" if confounded else "normal",
        )


def _mark_confounded(axes: Axes, correlation: Array) -> None:
    """Draw a dot into each cell of `correlation` (n, n) with hardly distinguishable parameters."""
    # Comparisons with NaN are false.
    rows, columns = np.nonzero(np.abs(correlation) > CONFOUNDED_CORRELATION)
    axes.plot(columns, rows, linestyle="", marker="o", color="white", markersize=3.0)
