"""Style of the figures: colours, fonts, number formats, labels, blank figures, atomic saving.

The style sheet `mjfim.mplstyle` beside this file has the width of all figures and the sizes of the
fonts. Only Figure and Agg objects are used: pyplot and its global state stay untouched. Settings of
the user, from a `matplotlibrc` or in Python, change no figure.
"""

from __future__ import annotations

import io
import os
import textwrap
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib.style
import numpy as np
from matplotlib import rc_params_from_file
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from mjfim.errors import MjfimError
from mjfim.files import replacing
from mjfim.model.coordinates import split_unit
from mjfim.output import vocabulary
from mjfim.output.picture_format import PictureFormat

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

# The style sheet of all figures.
STYLE_SHEET: dict[str, Any] = dict(
    rc_params_from_file(
        Path(__file__).with_name("mjfim.mplstyle"), use_default_template=False
    ).items()
)

# Width of every figure [inch].
WIDTH = float(STYLE_SHEET["figure.figsize"][0])

# Font sizes of tick labels and notes, of axis labels, and of titles [points].
SMALL_FONT = float(STYLE_SHEET["xtick.labelsize"])
NORMAL_FONT = float(STYLE_SHEET["font.size"])
LARGE_FONT = float(STYLE_SHEET["figure.titlesize"])

# Font size of the footnote below a figure [points].
NOTE_FONT = 7.5

# Height of a line of the title, and space above it [inch].
TITLE_LINE, TITLE_SPACE = 0.2, 0.07

# Width of the lines of the title over the width that is free; letters are up to 4 % wider at a low
# resolution.
TITLE_WIDTH = 0.96

# Space at both sides of titles, legends and notes [inch].
SIDE_SPACE = 0.12

# Part of the width of a panel that ticks and gaps take [inch].
PANEL_FRAME = 0.6

# Width of a line with its gap in a legend, and space between two entries, over the font size.
LEGEND_LINE, LEGEND_GAP = 2.8, 2.0

# Resolution at which a notebook shows figures; their files in it are twice as fine [pixels/inch].
NOTEBOOK_DPI = 80.0

# Name and colour in figures of the two trajectories of a design or study, by their name in the
# records.
TRAJECTORY_STYLES: dict[str, tuple[str, str]] = {
    key: (term.word, term.colour) for key, term in vocabulary.TRAJECTORY_TERMS.items()
}

# Entries without a time in the files of the formats that hold one.
DATELESS: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}

# Digits of the tick values of a logarithmic axis, from few to many ticks per decade.
TICK_DIGITS = ((1,), (1, 3), (1, 2, 5), (1, 2, 3, 4, 6, 8))

# Ratio of the ends of a logarithmic axis below which its ticks are evenly spaced numbers, and the
# largest number of intervals between them.
NARROW_AXIS, NARROW_TICKS = 3.0, 6

# Digits of a power of ten, raised.
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


# ---- settings of matplotlib


def own_style(draw: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function draw with the style sheet; the user's settings return after it.

    Args:
        draw: The function.

    Returns:
        The function that draws always in the same style.
    """

    @wraps(draw)
    def with_own_style(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        """Draw with the style sheet, whatever the user has set."""
        with STYLE_LOCK, matplotlib.style.context(["default", STYLE_SHEET]):
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


def without_zeros(text: str) -> str:
    """Leave out zeros at the end of a decimal number: `0.05000` becomes `0.05`.

    Args:
        text: The number, as `format_number` writes it.
    """
    mantissa, times, power = text.partition("×")
    if "." in mantissa:
        mantissa = mantissa.rstrip("0").rstrip(".")
    return mantissa + times + power


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


def fit_text(text: str, width: float, size: float) -> str:
    """Shorten a text in its middle until it fits.

    Args:
        text: The text.
        width: Width that is free [inch].
        size: Size of the font [points].
    """
    characters = len(text)
    while characters > 3 and text_width(shorten(text, characters), size) > width:
        characters -= 1
    return shorten(text, characters)


def fit_label(label: str, width: float, size: float) -> str:
    """Shorten the name in a label `name [unit]` until the label fits; the unit stays.

    Args:
        label: The label.
        width: Width that is free [inch].
        size: Size of the font [points].
    """
    name, unit = split_unit(label)
    suffix = f" [{unit}]" if unit else ""
    return fit_text(name, width - text_width(suffix, size), size) + suffix


def panel_width(columns: int) -> float:
    """Return the width that a title above one of several panels side by side may have [inch].

    Args:
        columns: Number of panels side by side.
    """
    return WIDTH / columns - PANEL_FRAME


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
        with STYLE_LOCK, matplotlib.style.context(["default", STYLE_SHEET]):
            self.savefig(stream, format="png", dpi=2.0 * NOTEBOOK_DPI)
        return stream.getvalue(), {"width": NOTEBOOK_DPI * self.get_figwidth()}


def new_figure(height: float) -> Figure:
    """Return a blank figure of the usual width, with an Agg canvas and constrained layout.

    Args:
        height: Height [inch].
    """
    layout = ConstrainedLayoutEngine(w_pad=0.09, h_pad=0.07)
    figure = NotebookFigure(figsize=(WIDTH, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def format_axes(axes: Axes, xlabel: str = "", ylabel: str = "") -> Axes:
    """Label axes, and put the common power of ten of their ticks where no label is.

    Args:
        axes: The axes.
        xlabel: Label of the horizontal axis.
        ylabel: Label of the vertical axis.

    Returns:
        The axes.
    """
    # A common power of ten of the ticks stands beside the axis, where no label is.
    axes.xaxis.get_offset_text().set(x=1.02, ha="left", fontsize=SMALL_FONT)
    axes.yaxis.get_offset_text().set(fontsize=SMALL_FONT)

    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    return axes


def scale_axis(axis: Axis, largest: float) -> str:
    """Let the ticks of an axis count in a power of ten, for its label.

    Args:
        axis: The axis.
        largest: Largest absolute value on it.

    Returns:
        The power with a space behind it, such as `10⁻³ `; empty where numbers of moderate size
        need none.
    """
    power = power_of_ten(largest)
    if power:
        scale = 10.0**power
        axis.set_major_formatter(lambda value, _: f"{value / scale:g}".replace("-", "−"))
    return power_text(power)


def power_of_ten(largest: float) -> int:
    """Return the power of ten in which the ticks of an axis count; 0 for moderate numbers.

    Args:
        largest: Largest absolute value on the axis.
    """
    power = int(np.floor(np.log10(largest))) if np.isfinite(largest) and largest > 0.0 else 0
    if -1 <= power < 4:
        return 0
    return 3 * (power // 3) if power < 0 else power


def power_text(power: int) -> str:
    """Return a power of ten for a label, with a space behind it; empty for 0.

    Args:
        power: The exponent.
    """
    return f"10{str(power).translate(SUPERSCRIPTS)} " if power else ""


def set_plain_log_ticks(axis: Axis) -> None:
    """Let a logarithmic axis have few ticks, with plain numbers.

    Args:
        axis: The axis, with its final limits.
    """
    low, high = axis.get_view_interval()
    axis.set_major_locator(FixedLocator(log_ticks(float(low), float(high))))
    axis.set_major_formatter(lambda value, _: plain_number(float(value)))
    axis.set_minor_locator(NullLocator())


def log_ticks(low: float, high: float) -> list[float]:
    """Return round numbers on a logarithmic axis: three to about five of them where it has some.

    Args:
        low: Lower end of the axis, positive.
        high: Upper end of the axis.
    """
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    decades = decades[:: max(len(decades) // 4, 1)]
    if high < NARROW_AXIS * low:
        even = np.asarray(MaxNLocator(NARROW_TICKS, steps=[1, 2, 5, 10]).tick_values(low, high))
        return [float(tick) for tick in even if low <= tick <= high]

    ticks: list[float] = []
    for digits in TICK_DIGITS:
        candidates = np.sort(np.outer(10.0**decades, digits).ravel())
        within = (candidates >= low) & (candidates <= high)
        ticks = candidates[within].tolist()
        if len(ticks) >= 3:
            break
    return ticks


def plain_number(value: float) -> str:
    """Write the number of a tick: 0.01, 300, 10⁵.

    Args:
        value: The number.
    """
    if 1e-4 < value < 1e5:
        return f"{value:g}"
    return format_number(value, 1).removeprefix("1×")


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
    """Write a title at the top left, a legend under it, and a footnote at the bottom left.

    All three are broken into as many lines as the width of the figure needs.

    Args:
        figure: The figure.
        title: The title.
        handles: Entries of the legend.
        note: The footnote.
    """
    width = figure.get_figwidth() - 2.0 * SIDE_SPACE
    left = SIDE_SPACE / figure.get_figwidth()
    lines = wrap(title, TITLE_WIDTH * width, LARGE_FONT)

    # Empty lines of the title keep room for the legend.
    columns = legend_columns([str(handle.get_label()) for handle in handles], width)
    legend_lines = -(-len(handles) // columns)
    text = "\n".join([*lines, *[" "] * legend_lines])
    figure.suptitle(text, x=left, ha="left", fontsize=LARGE_FONT, linespacing=1.3)
    if handles:
        top = TITLE_SPACE + TITLE_LINE * len(lines)
        figure.legend(
            handles=list(handles),
            loc="upper left",
            bbox_to_anchor=(left, 1.0 - top / figure.get_figheight()),
            ncols=columns,
            borderaxespad=0.0,
            borderpad=0.2,
        )
    if note:
        wrapped = "\n".join(wrap(note, width, NOTE_FONT))
        figure.supxlabel(wrapped, x=left, ha="left", fontsize=NOTE_FONT, color=MUTED_COLOUR)


def legend_columns(labels: Sequence[str], width: float, size: float = NORMAL_FONT) -> int:
    """Return into how many columns a legend is put, so that it fits.

    Args:
        labels: Texts of the entries.
        width: Width that is free [inch].
        size: Size of the font [points].

    Returns:
        The number of columns, at least 1.
    """
    entry = (LEGEND_LINE + LEGEND_GAP) * size / 72.0
    widths = [text_width(label, size) + entry for label in labels]
    for columns in range(len(labels), 1, -1):
        # The entries of a legend run down its columns.
        rows = -(-len(labels) // columns)
        total = sum(max(widths[k : k + rows]) for k in range(0, len(widths), rows))
        if total <= width:
            return columns
    return 1


def wrap(text: str, width: float, size: float) -> list[str]:
    """Break a text into lines.

    Args:
        text: The text.
        width: Width of the lines [inch].
        size: Size of the font [points].
    """
    # The printed width of the text says how many characters of it fit, up to long words.
    characters = int(len(text) * width / max(text_width(text, size), 1e-9))
    lines = textwrap.wrap(text, max(characters, 1), break_long_words=True)
    while characters > 8 and any(text_width(line, size) > width for line in lines):
        characters -= 4
        lines = textwrap.wrap(text, characters, break_long_words=True)
    return lines or [""]


@lru_cache(maxsize=4096)
def text_width(text: str, size: float = NORMAL_FONT) -> float:
    """Return the printed width of a text [inch].

    Args:
        text: The text.
        size: Size of the font [points].
    """
    font = get_font(findfont(FontProperties()))
    font.set_size(size, 72)
    font.set_text(text)
    return float(font.get_width_height()[0]) / 64.0 / 72.0


def trajectory_handles() -> list[Line2D]:
    """Return the legend entries of the initial and the designed trajectory."""
    return [
        Line2D([], [], color=colour, label=name, linewidth=2.0)
        for name, colour in TRAJECTORY_STYLES.values()
    ]


@own_style
def save(figure: Figure, path: str | os.PathLike[str], dpi: float | None = None) -> Path:
    """Write a figure in one step: readers find the old file or the complete new one.

    Args:
        figure: The figure.
        path: The file; the ending .png, .svg or .pdf of its name states the format.
        dpi: Resolution [pixels/inch]. Default: that of the style sheet.

    Returns:
        The file.

    Raises:
        MjfimError: The name has another ending.
    """
    target = Path(path)
    format_name = target.suffix.lower().removeprefix(".")
    if format_name not in tuple(PictureFormat):
        raise MjfimError(
            f"{target.name!r}: the ending of a figure's file states its format; "
            f"valid: {', '.join(f'.{known}' for known in PictureFormat)}"
        )

    with replacing(target) as temporary:
        _save(figure, temporary, format_name, dpi)
    return target


@own_style
def content(figure: Figure, format_name: str) -> bytes:
    """Return what `save` writes to a file.

    Args:
        figure: The figure.
        format_name: Format of the file: png, svg or pdf.
    """
    stream = io.BytesIO()
    _save(figure, stream, format_name)
    return stream.getvalue()


def _save(
    figure: Figure, target: Path | io.BytesIO, format_name: str, dpi: float | None = None
) -> None:
    """Draw a figure. Files of equal figures are equal: they do not hold the present time."""
    resolution = dpi or STYLE_SHEET["savefig.dpi"]
    if format_name == "png":
        _save_png(figure, target, resolution)
        return

    metadata = DATELESS.get(format_name)
    figure.savefig(target, format=format_name, dpi=resolution, metadata=metadata)


def _save_png(figure: Figure, target: Path | io.BytesIO, dpi: float) -> None:
    """Draw a figure once; `savefig` would draw it twice, the first time for the layout alone."""
    usual_canvas, usual_dpi = figure.canvas, figure.dpi
    canvas: Any = FigureCanvasAgg(figure)
    figure.dpi = dpi
    try:
        canvas.print_png(target)
    finally:
        figure.dpi = usual_dpi
        figure.set_canvas(usual_canvas)
