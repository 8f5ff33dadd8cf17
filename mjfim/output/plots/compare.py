"""Figure of a comparison: standard deviations of all methods, and of the worst combination."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch

from mjfim.arrays import Array
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    OTHER_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    format_percent,
    new_figure,
    own_style,
    set_plain_log_ticks,
    shorten,
    write_message,
)
from mjfim.output.summaries.comparison import budget_in_words
from mjfim.records.comparison import DESIGN, Comparison, MethodResult

# Title of a comparison without a verdict.
DEFAULT_TITLE = "The design compared with other methods"

# Largest number of parameters for which ratios are written into the cells.
MAX_WRITTEN_CELLS = 12

# Ratio of standard deviations to the design's at which the colours of the cells end.
LARGEST_COLOURED_RATIO = 3.0

# Ratio of the longest to the shortest bar above which their axis is logarithmic.
LOGARITHMIC_RATIO = 8.0

# Characters to which the names of methods and of parameters are shortened.
METHOD_NAME_WIDTH, PARAMETER_NAME_WIDTH = 34, 18

# Mean number of characters above which the names of parameters are turned upright.
MAX_LEVEL_CHARACTERS = 8

# Largest number of parameters whose names are written in the usual size, and the font size of more
# [points].
MAX_USUAL_FONT, MANY_PARAMETERS_FONT = 30, 5.0

# Share of the coloured range above which a cell is so dark that its number is white.
DARK_CELL = 0.6

# Ratios that the colour bar can mark.
COLOUR_BAR_RATIOS = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)


@own_style
def compare_figure(comparison: Comparison) -> Figure:
    """Draw standard deviations relative to the design's (cells), and the worst combination (bars).

    Args:
        comparison: The comparison.
    """
    count = len(comparison.wanted)
    comparison = replace(comparison, rows=tuple(sorted(comparison.rows, key=_rank)))
    height = float(np.clip(1.9 + 0.36 * len(comparison.rows), 3.2, 12.0))
    cells_width = float(np.clip(0.55 * count, 2.2, 9.0))

    figure = new_figure(height)
    left, right = figure.subplots(1, 2, width_ratios=[cells_width, 3.6])
    _draw_cells(left, comparison)
    _draw_worst_combination(right, comparison)

    verdict = comparison.verdict or (DEFAULT_TITLE,)
    note = (
        f"{' '.join(verdict[1:])} Each method had {budget_in_words(comparison)}. "
        "Predicted standard deviations are the best case. Sorted by the cost J, best first. "
    )
    if any(row.tightest[0] for row in comparison.rows):
        note += (
            "In grey: the smallest margin of all limits, as a share of half of the limit's range, "
            "and its kind; negative: the limit is violated."
        )
    else:
        note += (
            "In grey: J, which also weighs the effort of the control: without limits, more effort "
            "buys a smaller σ."
        )
    add_title(figure, verdict[0].removesuffix("."), _handles(comparison), note.strip())
    return figure


def _rank(row: MethodResult) -> tuple[bool, float]:
    """Return a key by which methods are sorted: the best first, those of no use last."""
    return not row.sound, row.cost if np.isfinite(row.cost) else np.inf


def _handles(comparison: Comparison) -> list[Patch]:
    """Return legend entries of the kinds of methods that are present."""
    names = {
        DESIGNED_COLOUR: "design",
        INITIAL_COLOUR: "baseline",
        OTHER_COLOUR: "baseline that beats the design",
    }
    used = {_method_colour(comparison, row) for row in comparison.rows if row.sound}
    handles = [
        Patch(color=colour, label=label) for colour, label in names.items() if colour in used
    ]

    hatched = [
        row for row in comparison.rows if not row.sound and np.isfinite(row.worst_relative_std)
    ]
    if hatched:
        unusable = Patch(
            facecolor="white", edgecolor=MUTED_COLOUR, hatch="////", label="not usable"
        )
        handles.append(unusable)
    return handles


def _method_colour(comparison: Comparison, row: MethodResult) -> str:
    """Return the colour of a method."""
    if row.method == DESIGN:
        return DESIGNED_COLOUR
    return OTHER_COLOUR if row in comparison.beating else INITIAL_COLOUR


# ---- cells: ratios by method and parameter


@dataclass(frozen=True, kw_only=True, eq=False)
class _Ratios:
    """Standard deviations of all methods, divided by a reference.

    Attributes:
        values: (methods, wanted parameters) ratios.
        title: Sentence that says what was divided by what.
        middle: Logarithm of the ratio that is white.
        half_range: Distance from it at which the colours end, as a logarithm.
    """

    values: Array
    title: str
    middle: float
    half_range: float

    @property
    def logarithms(self) -> Array:
        """(methods, wanted parameters) logarithms of the ratios, NaN where they are not finite."""
        return np.log(np.where(np.isfinite(self.values), self.values, np.nan))


def _ratios(comparison: Comparison) -> _Ratios | None:
    """Divide standard deviations by the design's, or by the scales if the design has none.

    The result is None if no parameter is identifiable alone.
    """
    wanted = list(comparison.wanted)
    design = comparison.design
    against_design = design is not None and bool(np.isfinite(design.std[wanted]).any())

    reference = comparison.scale[wanted]
    title = "σ of each parameter / its scale"
    if design is not None and against_design:
        reference = design.std[wanted]
        title = "σ of each parameter / σ of the design"

    std = np.array([row.std[wanted] for row in comparison.rows])
    values = std.reshape(len(comparison.rows), len(wanted)) / reference
    finite = np.isfinite(values)
    if not finite.any():
        return None

    # White is the design's standard deviation; without one, it is the mean of what is shown.
    middle, half_range = 0.0, float(np.log(LARGEST_COLOURED_RATIO))
    if not against_design:
        logarithms = np.log(np.where(finite, values, np.nan))
        middle = float(np.nanmean(logarithms))
        half_range = max(float(np.nanstd(logarithms)) * 2.0, 0.1)
    return _Ratios(values=values, title=title, middle=middle, half_range=half_range)


def _draw_cells(axes: Axes, comparison: Comparison) -> None:
    """Draw ratios by method and parameter: red is worse than the middle, blue is better."""
    ratios = _ratios(comparison)
    if ratios is None:
        axes.set_axis_off()
        write_message(axes, "no parameter is identifiable alone")
        return

    axes.set_facecolor(GRID_COLOUR)
    image = axes.imshow(
        np.ma.masked_invalid(ratios.logarithms),
        cmap="RdBu_r",
        vmin=ratios.middle - ratios.half_range,
        vmax=ratios.middle + ratios.half_range,
        aspect="auto",
    )
    _name_parameters(axes, comparison)
    _name_methods(axes, comparison)
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_title(ratios.title, fontsize=NORMAL_FONT, color=TEXT_COLOUR)

    # Numbers of many parameters would not fit into the cells.
    if len(comparison.wanted) > MAX_WRITTEN_CELLS:
        _add_colour_bar(axes, image, ratios)
    else:
        _write_ratios(axes, ratios)


def _name_parameters(axes: Axes, comparison: Comparison) -> None:
    """Write the names of the parameters below the cells."""
    names = [shorten(comparison.parameters[j], PARAMETER_NAME_WIDTH) for j in comparison.wanted]
    count = len(names)
    characters = sum(len(name) for name in names)
    upright = characters > MAX_LEVEL_CHARACTERS * count or count > MAX_WRITTEN_CELLS

    axes.set_xticks(
        range(count),
        names,
        fontsize=SMALL_FONT if count <= MAX_USUAL_FONT else MANY_PARAMETERS_FONT,
        rotation=90 if upright else 0,
    )


def _name_methods(axes: Axes, comparison: Comparison) -> None:
    """Write the names of the methods beside the cells, each in its colour."""
    rows = comparison.rows
    titles = [shorten(row.title, METHOD_NAME_WIDTH) for row in rows]
    axes.set_yticks(range(len(rows)), titles, fontsize=NORMAL_FONT, color=TEXT_COLOUR)

    for label, row in zip(axes.get_yticklabels(), rows, strict=True):
        colour = _method_colour(comparison, row) if row.sound else MUTED_COLOUR
        label.set_color(colour)
        if row.method == DESIGN:
            label.set_fontweight("bold")


def _add_colour_bar(axes: Axes, image: AxesImage, ratios: _Ratios) -> None:
    """Add a bar that says which colour stands for which ratio."""
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, pad=0.015, aspect=30)
    marked = [
        ratio
        for ratio in COLOUR_BAR_RATIOS
        if abs(np.log(ratio) - ratios.middle) <= ratios.half_range
    ]
    bar.set_ticks(np.log(marked).tolist(), labels=[f"{ratio:g}" for ratio in marked])
    bar.ax.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR)


def _write_ratios(axes: Axes, ratios: _Ratios) -> None:
    """Write every ratio into its cell."""
    distances = np.abs(ratios.logarithms - ratios.middle)
    for (i, j), ratio in np.ndenumerate(ratios.values):
        dark = distances[i, j] > DARK_CELL * ratios.half_range
        axes.text(
            j,
            i,
            format_number(float(ratio), 3) if np.isfinite(ratio) else "–",
            ha="center",
            va="center",
            fontsize=SMALL_FONT,
            color="white" if dark else TEXT_COLOUR,
        )


# ---- bars: the worst combination of parameters


def _draw_worst_combination(axes: Axes, comparison: Comparison) -> None:
    """Draw the relative σ of the worst combination by method, and the tightest limit in words."""
    rows = comparison.rows
    worst = np.array([row.worst_relative_std for row in rows])
    known = worst[np.isfinite(worst)]

    format_axes(axes, "σ / scale [–]")
    axes.grid(False, axis="y")
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_yticks([])
    title = "σ of the worst combination"
    axes.set_title(title, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    if not len(known):
        write_message(axes, "no method found a usable control")
        return

    has_margins = any(row.tightest[0] for row in rows)
    low, high = _bar_range(axes, known, has_margins=has_margins)
    axes.tick_params(which="both", labelsize=SMALL_FONT, color=MUTED_COLOUR, labelcolor=TEXT_COLOUR)
    for place, row in enumerate(rows):
        if np.isfinite(row.worst_relative_std):
            _draw_bar(axes, place, row, low, _method_colour(comparison, row))
        else:
            axes.text(
                low + 0.02 * (high - low),
                place,
                row.outcome.value,
                va="center",
                fontsize=SMALL_FONT,
                color=MUTED_COLOUR,
            )


def _bar_range(axes: Axes, known: Array, *, has_margins: bool) -> tuple[float, float]:
    """Set the axis of the bars for standard deviations `known` (n,), with room for text.

    Returns:
        Left end of the axis and right end of the longest bar.
    """
    high = float(known.max())
    if high > LOGARITHMIC_RATIO * known.min():
        low = 0.5 * float(known.min())
        axes.set_xscale("log")
        axes.set_xlim(low, high * (high / low) ** (0.75 if has_margins else 0.45))
        set_plain_log_ticks(axes.xaxis)
        return low, high

    axes.set_xlim(0.0, 1.7 * high)
    return 0.0, high


def _draw_bar(axes: Axes, place: int, row: MethodResult, left: float, colour: str) -> None:
    """Draw the bar of one method, with its value and its tightest limit behind it."""
    length = row.worst_relative_std - left
    bar = axes.barh(place, length, left=left, height=0.62, color=colour, linewidth=0.8)
    if not row.sound:
        bar[0].set(facecolor="white", edgecolor=MUTED_COLOUR, hatch="////")

    value = axes.text(
        row.worst_relative_std,
        place,
        f"  {format_number(row.worst_relative_std)}",
        va="center",
        fontsize=SMALL_FONT,
        color=TEXT_COLOUR,
    )
    kind, margin = row.tightest
    words = f"J {format_number(row.cost)}"
    if kind and np.isfinite(margin):
        words = f"{format_percent(margin)} {kind.replace('_', ' ')}"

    # The margin, or the cost, stands behind the value, wherever that ends.
    axes.annotate(
        f"  {words}",
        (1.0, 0.5),
        xycoords=value,
        va="center",
        fontsize=SMALL_FONT - 1.0,
        color=MUTED_COLOUR,
    )
