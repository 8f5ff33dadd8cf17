"""Style of the figures: colours, fonts, number formats, labels, blank figures, atomic saving.

Only Figure and Agg objects are used: pyplot and its global state stay untouched. Settings of the
user, from a `matplotlibrc` or in Python, change no figure.
"""

from __future__ import annotations

import io
import os
import textwrap
import threading
from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

import matplotlib.style
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
from mjfim.output import vocabulary

# Arguments and result of a function that draws.
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# The settings of matplotlib belong to the whole process, so one thread draws at a time.
STYLE_LOCK = threading.RLock()

# Colour of the initial trajectory.
INITIAL_COLOUR = vocabulary.INITIAL.colour

# Colour of the designed trajectory, and of limits that are violated.
DESIGNED_COLOUR = vocabulary.DESIGNED.colour

# Colour of nominal models and of initial guesses.
NOMINAL_COLOUR = vocabulary.NOMINAL.colour

# Colour of identified models and of estimates.
IDENTIFIED_COLOUR = vocabulary.IDENTIFIED.colour

# Colour of text, of true values and of reference lines.
TEXT_COLOUR = "#222222"

# Colour of notes, frames and curves that stay in the background.
MUTED_COLOUR = "#6b7076"

# Colour of grid lines and of shaded bands.
GRID_COLOUR = "#d9dcdf"

# Colour of trajectories and methods that are neither initial nor designed.
OTHER_COLOUR = vocabulary.OTHER.colour

# Colour of measurements and of residuals.
MEASURED_COLOUR = vocabulary.MEASURED.colour

# Font sizes of tick labels and notes, of axis labels, and of titles [points].
SMALL_FONT, NORMAL_FONT, LARGE_FONT = 8.0, 9.0, 11.0

# Font size of the footnote below a figure [points].
NOTE_FONT = 7.5

# Characters of a footnote that fit in one inch.
NOTE_CHARACTERS_PER_INCH = 17

# Resolution at which a notebook shows figures; their files in it are twice as fine [pixels/inch].
NOTEBOOK_DPI = 80.0

# Name and colour in figures of the two trajectories of a design or study, by their name in the
# records.
TRAJECTORY_STYLES: dict[str, tuple[str, str]] = {
    key: (term.word, term.colour) for key, term in vocabulary.TRAJECTORY_TERMS.items()
}

# Digits of a power of ten, raised.
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


# ---- settings of matplotlib


def own_style(draw: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function draw with the defaults of matplotlib; the user's settings return after it.

    Args:
        draw: The function.

    Returns:
        The function that draws always in the same style.
    """

    @wraps(draw)
    def with_own_style(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        """Draw with matplotlib's default style, whatever the user has set."""
        with STYLE_LOCK, matplotlib.style.context("default"):
            return draw(*arguments, **options)

    return with_own_style


# ---- units


def quotient_unit(unit: str, divisor: str) -> str:
    """Return the unit of a quotient: `quotient_unit("m", "kg")` is "m/kg".

    Compound units are put in brackets.

    Args:
        unit: Unit of the numerator; may be empty.
        divisor: Unit of the denominator; may be empty.
    """
    numerator = unit or "1"
    if not divisor:
        return numerator
    return f"{bracketed_unit(numerator)}/{bracketed_unit(divisor)}"


def bracketed_unit(unit: str) -> str:
    """Return a unit that may be divided or raised as a whole.

    Args:
        unit: The unit.
    """
    compound = any(character in unit for character in " /·*^²³")
    return f"({unit})" if compound else unit


def squared_unit(unit: str) -> str:
    """Return the unit of a variance: "kg" becomes "kg²".

    Args:
        unit: Unit of the quantity; may be empty.
    """
    return f"{bracketed_unit(unit)}²" if unit else ""


# ---- numbers


def format_number(value: float, digits: int = 3) -> str:
    """Write a number with raised powers of ten: 0.874, 1.65×10⁴, ∞; a dash stands for NaN.

    Args:
        value: The number.
        digits: Significant digits.
    """
    if np.isnan(value):
        return "–"
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"

    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)

    # Numbers of moderate size are written without a power of ten.
    if value == 0.0 or -4 < power < max(4, digits):
        shown_power = power if value else 0
        decimals = max(digits - 1 - shown_power, 0)
        return f"{value:.{decimals}f}".replace("-", "−")

    raised = str(power).translate(SUPERSCRIPTS)
    return f"{mantissa}×10{raised}".replace("-", "−")


def format_with_uncertainty(value: float, half_width: float) -> str:
    """Write a value with as many digits as its uncertainty leaves: `0.994 ± 0.012`.

    Args:
        value: The value.
        half_width: Half the width of its interval, in the unit of the value.
    """
    usable = bool(np.isfinite(half_width)) and half_width > 0.0
    largest = max(abs(value), half_width)
    if not usable or not 1e-3 <= largest < 1e5:
        return f"{format_number(value, 4)} ± {format_number(half_width, 2)}"

    # The uncertainty has two significant digits.
    decimals = int(np.clip(1 - np.floor(np.log10(half_width)), 0, 8))
    text = f"{value:.{decimals}f} ± {half_width:.{decimals}f}"
    return text.replace("-", "−")


def format_percent(value: float) -> str:
    """Write a fraction as percent with two significant digits.

    Args:
        value: The fraction, 1 for 100 %.
    """
    if not np.isfinite(value):
        return format_number(value)
    return f"{format_number(100.0 * value, 2)} %"


# ---- labels


def shorten(text: str, width: int = 28) -> str:
    """Shorten a long name; both of its ends stay, with an ellipsis between them.

    Args:
        text: The name.
        width: Largest number of characters.
    """
    if len(text) <= width:
        return text
    kept = (width - 1) // 2
    return f"{text[:kept]}…{text[-kept:]}"


def shorten_label(label: str, width: int = 28) -> str:
    """Shorten the name in a label `name [unit]`; the unit stays.

    Args:
        label: The label.
        width: Largest number of characters of the name.
    """
    name, unit = split_unit(label)
    short = shorten(name, width)
    return f"{short} [{unit}]" if unit else short


def break_before_unit(label: str, width: int = 18) -> str:
    """Break a long label `name [unit]` before its unit, for the side of a low panel.

    Args:
        label: The label.
        width: Largest number of characters of a line.
    """
    name, unit = split_unit(label)
    if len(label) <= width or not unit:
        return label
    return f"{shorten(name, width)}\n[{unit}]"


def as_sentence(text: str) -> str:
    """Return a text with a capital first letter and a full stop.

    Args:
        text: The text, without a full stop.
    """
    return f"{text[:1].upper()}{text[1:]}."


def trajectory_style(trajectory: str) -> tuple[str, str]:
    """Return the name of a trajectory in figures, and its colour.

    Args:
        trajectory: Its name in the records.
    """
    return TRAJECTORY_STYLES.get(trajectory, (trajectory, OTHER_COLOUR))


# ---- figures and axes


class NotebookFigure(Figure):
    """Figure that a notebook shows, also where the user has not imported pyplot."""

    def _repr_png_(self) -> tuple[bytes, dict[str, float]]:
        """Return the figure as PNG, and the width at which it is shown [pixels]."""
        stream = io.BytesIO()
        with STYLE_LOCK, matplotlib.style.context("default"):
            self.savefig(stream, format="png", dpi=2.0 * NOTEBOOK_DPI)
        return stream.getvalue(), {"width": NOTEBOOK_DPI * self.get_figwidth()}


def new_figure(width: float, height: float) -> Figure:
    """Return a blank figure with an Agg canvas and constrained layout.

    Args:
        width: Width [inch].
        height: Height [inch].
    """
    layout = ConstrainedLayoutEngine(w_pad=0.09, h_pad=0.07)
    figure = NotebookFigure(figsize=(width, height), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def format_axes(axes: Axes, xlabel: str = "", ylabel: str = "") -> Axes:
    """Give axes an open frame, a pale grid, small ticks and labels.

    Args:
        axes: The axes.
        xlabel: Label of the horizontal axis.
        ylabel: Label of the vertical axis.

    Returns:
        The axes.
    """
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED_COLOUR)
    axes.grid(True, color=GRID_COLOUR, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=SMALL_FONT, color=MUTED_COLOUR, labelcolor=TEXT_COLOUR)

    # A common power of ten of the ticks stands beside the axis, where no label is.
    axes.xaxis.get_offset_text().set(x=1.02, ha="left", fontsize=SMALL_FONT)
    axes.yaxis.get_offset_text().set(fontsize=SMALL_FONT)

    axes.set_xlabel(xlabel, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    axes.set_ylabel(ylabel, fontsize=NORMAL_FONT, color=TEXT_COLOUR)
    return axes


def write_message(axes: Axes, sentence: str) -> None:
    """Write a sentence in the middle of a panel that has nothing to draw.

    Args:
        axes: Axes of the panel.
        sentence: The sentence.
    """
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
    """Write a title at the top left, a legend under it, and a wrapped footnote at the bottom left.

    Args:
        figure: The figure.
        title: The title.
        handles: Entries of the legend.
        note: The footnote.
    """
    left = 0.12 / figure.get_figwidth()

    # A second, empty line of the title keeps room for the legend.
    lines = f"{title}\n " if handles else title
    figure.suptitle(
        lines, x=left, ha="left", fontsize=LARGE_FONT, color=TEXT_COLOUR, linespacing=1.3
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
        width = int(figure.get_figwidth() * NOTE_CHARACTERS_PER_INCH)
        wrapped = textwrap.fill(note, width)
        figure.supxlabel(wrapped, x=left, ha="left", fontsize=NOTE_FONT, color=MUTED_COLOUR)


def trajectory_handles() -> list[Line2D]:
    """Return the legend entries of the initial and the designed trajectory."""
    return [
        Line2D([], [], color=colour, label=name, linewidth=2.0)
        for name, colour in TRAJECTORY_STYLES.values()
    ]


@own_style
def save(figure: Figure, path: str | os.PathLike[str], dpi: float = 200.0) -> Path:
    """Write a figure as PNG in one step: readers find the old file or the complete new one.

    Args:
        figure: The figure.
        path: The file; its name ends in .png.
        dpi: Resolution [pixels/inch].

    Returns:
        The file.

    Raises:
        MjfimError: The name does not end in .png.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise MjfimError(f"figures are saved as PNG: {target.name!r} should end in .png")

    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi)
    return target
