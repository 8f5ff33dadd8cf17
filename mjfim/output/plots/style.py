"""House style of the figures: colours, number formats, blank figures, atomic saving.

Only Figure and Agg objects are used: pyplot and its global state stay untouched, so threads may draw at once.
"""

from __future__ import annotations

import os
import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from mjfim.atomic_io import replacing
from mjfim.errors import MjfimError
from mjfim.model.coordinates import split_unit

INITIAL_COLOUR = "#0077bb"
OPTIMIZED_COLOUR = "#cc3311"
TEXT_COLOUR = "#222222"
MUTED_COLOUR = "#6b7076"
GRID_COLOUR = "#d9dcdf"
OTHER_COLOUR = "#8a6d3b"
MEASURED_COLOUR = "#009988"


SMALL_FONT, NORMAL_FONT, LARGE_FONT = 8.0, 9.0, 11.0


# How the two trajectories of a design or study are named and coloured.
TRAJECTORY_STYLES: dict[str, tuple[str, str]] = {
    "initial": ("initial", INITIAL_COLOUR),
    "final": ("optimized", OPTIMIZED_COLOUR),
}
BEST_CASE = "Predicted standard deviations are a best case: they hold if the model and the stated noise are right."


def quotient_unit(unit: str, divisor: str) -> str:
    """Unit of a quotient: quotient_unit("m", "kg") is "m/kg"; compound units are bracketed."""
    top = unit or "1"
    if not divisor:
        return top
    return f"{bracketed_unit(top)}/{bracketed_unit(divisor)}"


def bracketed_unit(unit: str) -> str:
    """A unit that may be divided or raised as a whole."""
    return f"({unit})" if any(c in unit for c in " /·*^²³") else unit


def squared_unit(unit: str) -> str:
    """Unit of a variance: "kg" becomes "kg²"."""
    return f"{bracketed_unit(unit)}²" if unit else ""


def format_number(value: float, digits: int = 3) -> str:
    """Significant digits without trailing exponent code: 0.874, 1.65×10⁴, ∞; a dash for NaN."""
    if np.isnan(value):
        return "–"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if value == 0.0 or -4 < power < max(4, digits):
        decimals = max(digits - 1 - (power if value else 0), 0)
        return f"{value:.{decimals}f}".replace("-", "−")
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{mantissa}×10{raised}".replace("-", "−")


def format_with_uncertainty(value: float, half: float) -> str:
    """`0.994 ± 0.012`: the value to the digits that its half width leaves."""
    if not np.isfinite(half) or half <= 0.0 or not 1e-3 <= max(abs(value), half) < 1e5:
        return f"{format_number(value, 4)} ± {format_number(half, 2)}"
    decimals = int(np.clip(1 - np.floor(np.log10(half)), 0, 8))
    return f"{value:.{decimals}f} ± {half:.{decimals}f}".replace("-", "−")


def format_percent(value: float) -> str:
    """A fraction as percent with two significant digits."""
    return f"{format_number(100.0 * value, 2)} %" if np.isfinite(value) else format_number(value)


def shorten(text: str, width: int = 28) -> str:
    """Long names keep both ends around an ellipsis."""
    keep = (width - 1) // 2
    return text if len(text) <= width else f"{text[:keep]}…{text[-keep:]}"


def break_before_unit(label: str, width: int = 18) -> str:
    """`name [unit]` for the side of a low panel: a long label breaks before its unit."""
    name, unit = split_unit(label)
    return label if len(label) <= width or not unit else f"{shorten(name, width)}\n[{unit}]"


def shorten_label(label: str, width: int = 28) -> str:
    """`name [unit]` with a shortened name and the whole unit."""
    name, unit = split_unit(label)
    return f"{shorten(name, width)} [{unit}]" if unit else shorten(name, width)


def new_figure(width: float, height: float) -> Figure:
    """Blank figure of width x height [inch] with its own Agg canvas and constrained layout."""
    layout = ConstrainedLayoutEngine(w_pad=0.09, h_pad=0.07)
    figure = Figure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def format_axes(axes: Axes, xlabel: str = "", ylabel: str = "") -> Axes:
    """Open frame, faint grid, small ticks, labels."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED_COLOUR)
    axes.grid(True, color=GRID_COLOUR, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR, labelcolor=TEXT_COLOUR)
    axes.set_xlabel(xlabel, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    axes.set_ylabel(ylabel, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    return axes


def write_message(axes: Axes, sentence: str) -> None:
    """A sentence in the middle of a panel that has nothing to draw."""
    axes.text(
        0.5,
        0.5,
        sentence,
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=NORMAL_FONT,
        color=MUTED_COLOUR,
    )


def add_title(figure: Figure, title: str, handles: Sequence[Artist] = (), note: str = "") -> None:
    """Title at the top left, legend under it, wrapped footnote at the bottom left."""
    left = 0.12 / figure.get_figwidth()
    # The title's second, empty line keeps room for the legend.
    figure.suptitle(
        f"{title}\n ", x=left, ha="left", fontsize=LARGE_FONT, color=TEXT_COLOUR, linespacing=1.3
    )
    if handles:
        figure.legend(
            handles=list(handles),
            loc="upper left",
            bbox_to_anchor=(left, 1.0 - 0.27 / figure.get_figheight()),
            ncols=len(handles),
            frameon=False,
            fontsize=NORMAL_FONT,
            borderaxespad=0.0,
            borderpad=0.2,
        )
    if note:
        wrapped = textwrap.fill(note, int(figure.get_figwidth() * 17))
        figure.supxlabel(wrapped, x=left, ha="left", fontsize=SMALL_FONT - 0.5, color=MUTED_COLOUR)


def trajectory_handles() -> list[Line2D]:
    """Legend entries of the two trajectories."""
    return [
        Line2D([], [], color=colour, label=name, linewidth=2.0)
        for name, colour in TRAJECTORY_STYLES.values()
    ]


def save(figure: Figure, path: str | os.PathLike[str], dpi: float = 200.0) -> Path:
    """Write the figure as PNG in one step: readers see the old file or the new one, never half of it."""
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise MjfimError(f"figures are saved as PNG: {target.name!r} should end in .png")
    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)
    return target
