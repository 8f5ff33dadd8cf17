"""Matplotlib draws pictures: style, axes, marks, legends, and files."""

from __future__ import annotations

import io
import os
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import rc_params_from_file
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis as DrawnAxis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from mjfim.errors import MjfimError
from mjfim.files import replacing
from mjfim.model.coordinates import split_unit
from mjfim.output.page import PictureFormat
from mjfim.output.panels import CELL_COLOURS, ROLES, Axis, Cells, Mark, Panel, Picture
from mjfim.output.words import format_number, shorten

# The settings of matplotlib belong to the whole process, so one thread draws at a time.
STYLE_LOCK = threading.RLock()

# The style sheet of all figures.
STYLE_SHEET: dict[str, Any] = dict(
    rc_params_from_file(
        Path(__file__).with_name("mjfim.mplstyle"), use_default_template=False
    ).items()
)

# Width of every figure [inch].
WIDTH = float(STYLE_SHEET["figure.figsize"][0])

# Font sizes of tick labels and remarks, of axis labels, of titles, of the footnote, and of names of
# very many rows [points], and number of rows from which on there are very many.
SMALL_FONT = float(STYLE_SHEET["xtick.labelsize"])
NORMAL_FONT = float(STYLE_SHEET["font.size"])
LARGE_FONT = float(STYLE_SHEET["figure.titlesize"])
NOTE_FONT, TINY_FONT, MANY = 7.5, 5.0, 30

# Heights of a line of title or legend, and of the footnote, and of what else surrounds the panels
# [inch].
TITLE_LINE, NOTE_LINE, FRAME = 0.2, 0.13, 0.35

# Width of the lines of the title over the width that is free; letters are up to 4 % wider at a low
# resolution.
TITLE_WIDTH = 0.96

# Space at both sides of titles, legends and notes, and part of the width of a panel that ticks and
# gaps take [inch].
SIDE_SPACE, PANEL_FRAME = 0.12, 0.6

# Width of a line with its gap in a legend, and space between two entries, over the font size.
LEGEND_LINE, LEGEND_GAP = 2.8, 2.0

# Characters of names beside rows, and below columns, space between columns of words beside rows
# [inch], and strength of the colour of a cell from which on its words are white.
NAME_WIDTH, UPRIGHT_WIDTH, COLUMN_GAP, DARK_CELL = 30, 18, 0.16, 0.6

# Resolution at which a notebook shows figures; their files in it are twice as fine [pixels/inch].
NOTEBOOK_DPI = 80.0

# Entries without a time in the files of the formats that hold one.
DATELESS: dict[str, dict[str, None]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}

# Digits of the ticks of a logarithmic axis, from few to many ticks per decade; ratio of its ends
# below which its ticks are evenly spaced, and the largest number of intervals between them.
TICK_DIGITS = ((1,), (1, 3), (1, 2, 5), (1, 2, 3, 4, 6, 8))
NARROW_AXIS, NARROW_TICKS = 3.0, 6


# ---- figures


@contextmanager
def own_style() -> Iterator[None]:
    """Draw with the style sheet, whatever the user has set; the user's settings return after it."""
    with STYLE_LOCK, matplotlib.style.context(["default", STYLE_SHEET]):
        yield


class NotebookFigure(Figure):
    """Figure that a notebook shows, also where the user has not imported pyplot."""

    def _repr_png_(self) -> tuple[bytes, dict[str, float]]:
        """Return the figure as PNG, and the width at which it is shown [pixels]."""
        stream = io.BytesIO()
        with own_style():
            self.savefig(stream, format="png", dpi=2.0 * NOTEBOOK_DPI)
        return stream.getvalue(), {"width": NOTEBOOK_DPI * self.get_figwidth()}


def figure_of(picture: Picture) -> Figure:
    """Draw a picture.

    Args:
        picture: The picture.

    Returns:
        The figure, with an Agg canvas; pyplot does not know it.
    """
    with own_style():
        width = WIDTH - 2.0 * SIDE_SPACE
        title = wrap(picture.title, TITLE_WIDTH * width, LARGE_FONT)
        note = wrap(picture.note, width, NOTE_FONT) if picture.note else []
        handles = [_handle(key) for key in picture.legend()]
        columns = legend_columns([str(handle.get_label()) for handle in handles], width)
        head = len(title) + -(-len(handles) // columns)

        height = sum(picture.heights) + TITLE_LINE * head + NOTE_LINE * len(note) + FRAME
        layout = ConstrainedLayoutEngine(w_pad=0.09, h_pad=0.07)
        figure = NotebookFigure(figsize=(WIDTH, height), layout=layout)
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(
            len(picture.heights),
            len(picture.widths),
            height_ratios=picture.heights,
            width_ratios=picture.widths,
        )
        # Names beside a wide panel make all columns narrower.
        wide = [name for panel in picture.panels if panel.is_wide for name in panel.y.names or ()]
        names = (text_width(shorten(name, NAME_WIDTH, wide), SMALL_FONT) for name in wide)
        room = WIDTH - max(names, default=0.0)
        for panel in picture.panels:
            row, column = panel.place
            across = slice(None) if panel.is_wide else column
            share = 1.0 if panel.is_wide else picture.widths[column] / sum(picture.widths)
            axes = figure.add_subplot(grid[row, across])
            _draw_panel(axes, panel, room * share - PANEL_FRAME, picture.heights[row])

        # Empty lines of the title keep room for the legend.
        left = SIDE_SPACE / WIDTH
        figure.suptitle(
            "\n".join([*title, *[" "] * (head - len(title))]),
            x=left,
            ha="left",
            fontsize=LARGE_FONT,
            linespacing=1.3,
        )
        if handles:
            figure.legend(
                handles=handles,
                loc="upper left",
                bbox_to_anchor=(left, 1.0 - (0.07 + TITLE_LINE * len(title)) / height),
                ncols=columns,
                borderaxespad=0.0,
                borderpad=0.2,
            )
        if note:
            figure.supxlabel(
                "\n".join(note), x=left, ha="left", fontsize=NOTE_FONT, color=ROLES["muted"]
            )
        return figure


def _handle(mark: Mark) -> Artist:
    """Return the entry of a mark in the legend."""
    colour = ROLES[mark.role]
    if mark.kind in ("area", "columns", "bars", "vspan", "hspan"):
        if mark.hollow:
            return Patch(facecolor="white", edgecolor=colour, hatch="////", label=mark.label)
        return Patch(color=colour, alpha=mark.opacity, label=mark.label, linewidth=0.0)
    is_dots = mark.kind == "dots"
    dash: Any = "" if is_dots else mark.dash
    return Line2D(
        [],
        [],
        color=colour,
        marker=mark.symbol or None,
        markerfacecolor="white" if mark.hollow else colour,
        markersize=max(mark.size, 4.0) if mark.symbol else None,
        markeredgewidth=mark.width if is_dots else None,
        linestyle=dash,
        linewidth=mark.width,
        alpha=mark.opacity,
        label=mark.label,
    )


# ---- panels


def _draw_panel(axes: Axes, panel: Panel, width: float, height: float) -> None:
    """Draw a panel with room for words of a width and a height [inch]."""
    if panel.is_shaded:
        axes.set_facecolor("#f1f2f3")
    if panel.cells is not None:
        _draw_cells(axes, panel.cells)
    _set_axis(axes, axes.xaxis, panel.x, width, height)
    _set_axis(axes, axes.yaxis, panel.y, height, height)
    for mark in panel.marks:
        _draw_mark(axes, mark)
    for axis, stated in ((axes.xaxis, panel.x), (axes.yaxis, panel.y)):
        if stated.log:
            # Few ticks, with plain numbers.
            low, high = axis.get_view_interval()
            axis.set_major_locator(FixedLocator(log_ticks(float(low), float(high))))
            axis.set_major_formatter(lambda value, _: plain_number(value))
            axis.set_minor_locator(NullLocator())

    remark = wrap(panel.remark, 0.7 * width, NOTE_FONT) if panel.remark else []
    axes.set_title(
        _fitting(panel.title, width),
        loc="left",
        color=ROLES[panel.role],
        pad=4.0 + 10.5 * len(remark),
    )
    if remark:
        # A common power of ten stands where no remark is.
        axes.yaxis.get_offset_text().set(x=1.0, ha="right")
        _write(
            axes,
            (0.0, 1.0),
            "\n".join(remark),
            "muted",
            offset=(0.0, 3.0),
            va="bottom",
            size=NOTE_FONT,
        )
    if panel.message:
        _write(axes, (0.5, 0.5), panel.message, "muted", ha="center")

    # Columns of words beside the rows.
    right = COLUMN_GAP
    rows = axes.get_yaxis_transform()
    for heading, role, texts in panel.beside:
        offset = (72.0 * right, 0.0)
        _write(axes, (1.0, 1.0), heading, role, offset=(offset[0], 4.0), va="bottom")
        for place, text in enumerate(texts):
            _write(axes, (1.0, place), text, role, offset=offset, system=rows)
        right += max(text_width(text, SMALL_FONT) for text in (heading, *texts)) + COLUMN_GAP


def _write(
    axes: Axes,
    place: tuple[float, float],
    text: str,
    role: str,
    *,
    offset: tuple[float, float] = (0.0, 0.0),
    system: Any = "axes fraction",
    ha: str = "left",
    va: str = "center",
    size: float = SMALL_FONT,
) -> None:
    """Write words at an offset [points] from a place in a panel."""
    axes.annotate(
        text,
        place,
        xycoords=system,
        xytext=offset,
        textcoords="offset points",
        ha=ha,
        va=va,
        fontsize=size,
        color=ROLES[role],
        annotation_clip=False,
    )


def _set_axis(axes: Axes, axis: DrawnAxis, stated: Axis, room: float, height: float) -> None:
    """Set range, ticks and label of an axis whose names have room [inch] together."""
    is_across = axis is axes.xaxis
    axis.get_offset_text().set(fontsize=SMALL_FONT)
    if is_across:
        # A common power of ten stands beside the axis, where no label is.
        axis.get_offset_text().set(x=1.02, ha="left")
        axes.set_xlabel(_fitting(stated.label, room))
    else:
        axes.set_ylabel(_fitting(stated.label, height, breaks=True))
    if stated.log:
        axis._set_axes_scale("log")  # type: ignore[attr-defined]
    if stated.limits is not None:
        set_limits = axes.set_xlim if is_across else axes.set_ylim
        set_limits(*stated.limits)
    if stated.most or stated.whole:
        count: Any = stated.most or "auto"
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10], integer=stated.whole))
    if stated.ticks is not None:
        axis.set_ticks(list(stated.ticks))
    if stated.names is not None:
        _name_ticks(axis, stated, room if is_across else 0.0)
    if stated.hidden:
        axis.set_tick_params(labelbottom=False, labelleft=False)


def _name_ticks(axis: DrawnAxis, stated: Axis, room: float) -> None:
    """Write names at the ticks of an axis; across, upright where they have no room [inch]."""
    every, width = stated.names or (), UPRIGHT_WIDTH if room else NAME_WIDTH
    names = [shorten(name, width, every) for name in every]
    axis.set_ticklabels(names, fontsize=SMALL_FONT if len(names) <= MANY else TINY_FONT)
    if room:
        widest = max((text_width(name, SMALL_FONT) for name in names), default=0.0)
        axis.set_tick_params(rotation=90 if widest > 0.65 * room / max(len(names), 1) else 0)
    for label, role in zip(axis.get_ticklabels(), stated.roles, strict=False):
        label.set_color(ROLES[role])
    axis.set_tick_params(length=0.0)
    axis.grid(False)


def _draw_points(axes: Axes, mark: Mark, stroke: Mapping[str, Any]) -> None:
    """Draw a line or dots."""
    axes.plot(
        mark.x,
        mark.y,
        **{**stroke, "linestyle": "" if mark.kind == "dots" else mark.dash},
        marker=mark.symbol or None,
        markersize=mark.size,
        markerfacecolor="white" if mark.hollow else stroke["color"],
        markeredgewidth=mark.width if mark.symbol in ("|", "_", "x") else 1.0,
    )


def _draw_mark(axes: Axes, mark: Mark) -> None:
    stroke: dict[str, Any] = {
        "color": ROLES[mark.role],
        "alpha": mark.opacity,
        "zorder": mark.front,
        "linewidth": mark.width,
        "linestyle": mark.dash,
    }
    match mark.kind:
        case "line" | "dots":
            _draw_points(axes, mark, stroke)
        case "steps":
            # Stairs take ten times as long, because they are curves for matplotlib.
            held = np.append(mark.y, mark.y[-1:])
            axes.plot(mark.x, held, drawstyle="steps-post", snap=False, **stroke)
        case "intervals":
            _draw_intervals(axes, mark, ROLES[mark.role])
        case "vline":
            axes.axvline(mark.x[0], **stroke)
        case "hline":
            axes.axhline(mark.y[0], **stroke)
        case "words":
            for x, y, text in zip(mark.x, mark.y, mark.texts, strict=True):
                _write(axes, (x, y), text, mark.role, offset=(4.0, 0.0), system="data")
        case _:
            _draw_filled(axes, mark, {**stroke, "linewidth": 0.0})


def _draw_filled(axes: Axes, mark: Mark, look: dict[str, Any]) -> None:
    """Draw a filled mark; bars that are hollow are hatched."""
    other: Any = mark.other
    match mark.kind:
        case "area":
            axes.fill_between(mark.x, mark.y, other, **look)
        case "columns":
            axes.stairs(mark.y, mark.x, fill=True, **look)
        case "vspan":
            axes.axvspan(mark.x[0], other[0], **look)
        case "hspan":
            axes.axhspan(mark.y[0], other[0], **look)
        case "bars":
            colour = look["color"]
            bar = {"color": colour, "alpha": mark.opacity}
            if mark.hollow:
                bar = {"facecolor": "white", "edgecolor": colour, "hatch": "////", "linewidth": 0.5}
            axes.barh(mark.y, mark.x - other, left=other, height=mark.size, **bar)


def _draw_intervals(axes: Axes, mark: Mark, colour: str) -> None:
    """Draw intervals across; arrows mark where the axis cuts them off."""
    ends: Any = mark.other
    low, high = sorted(axes.get_xlim())
    begin, end = np.clip(mark.x, low, high), np.clip(ends, low, high)
    axes.hlines(
        mark.y, begin, end, color=colour, linewidth=mark.width, alpha=mark.opacity, capstyle="butt"
    )
    for cut, place, symbol in ((mark.x < low, low, "<"), (ends > high, high, ">")):
        # A line without points has no extent, which the layout needs.
        if cut.any():
            places = np.full(np.count_nonzero(cut), place)
            axes.plot(places, mark.y[cut], symbol, color=colour, markersize=5, clip_on=False)


def _draw_cells(axes: Axes, cells: Cells) -> None:
    """Draw coloured cells with their words, or with a bar of colours."""
    ends = None
    if cells.edges is not None:
        ends = (*cells.edges[[0, -1]].tolist(), len(cells.values) - 0.5, -0.5)
    image = axes.imshow(
        np.ma.masked_invalid(cells.values),
        cmap=LinearSegmentedColormap.from_list("cells", CELL_COLOURS).with_extremes(
            bad=ROLES["band"]
        ),
        vmin=cells.middle - cells.reach,
        vmax=cells.middle + cells.reach,
        aspect="auto",
        extent=ends,
    )
    axes.spines[:].set_visible(False)
    axes.grid(False)
    if cells.scale is not None:
        bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, pad=0.015, aspect=30)
        bar.set_ticks(list(cells.scale[0]), labels=list(cells.scale[1]))
    _write_cells(axes, cells)


def _write_cells(axes: Axes, cells: Cells) -> None:
    """Write the words of cells, white ones into dark cells."""
    for i, row in enumerate(cells.texts):
        for j, text in enumerate(row):
            is_dark = abs(cells.values[i, j] - cells.middle) > DARK_CELL * cells.reach
            is_bold = cells.is_bold is not None and bool(cells.is_bold[i, j])
            axes.text(
                j,
                i,
                text,
                ha="center",
                va="center",
                fontsize=SMALL_FONT,
                color=ROLES["white" if is_dark else "text"],
                weight="bold" if is_bold else "normal",
            )


# ---- ticks and words


def log_ticks(low: float, high: float) -> list[float]:
    """Return round numbers on a logarithmic axis: three to about five of them where it has some.

    Args:
        low: Lower end of the axis.
        high: Upper end.
    """
    decades = np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    decades = decades[:: max(len(decades) // 4, 1)]
    if high < NARROW_AXIS * low:
        even = np.asarray(MaxNLocator(NARROW_TICKS, steps=[1, 2, 5, 10]).tick_values(low, high))
        return [float(tick) for tick in even if low <= tick <= high]

    ticks = []
    for digits in TICK_DIGITS:
        candidates = np.sort(np.outer(10.0**decades, digits).ravel())
        ticks = candidates[(candidates >= low) & (candidates <= high)].tolist()
        if len(ticks) >= 3:
            break
    return ticks


def plain_number(value: float) -> str:
    """Write the number of a tick: 0.01, 300, 10⁵."""
    if 1e-4 < value < 1e5:
        return f"{value:g}"
    return format_number(value, 1).removeprefix("1×")


def _fitting(label: str, width: float, *, breaks: bool = False) -> str:
    """Shorten the name in a label `name [unit]` until it fits; its unit may have its own line."""
    if "\n" in label or "$" in label or text_width(label) <= width:
        return label
    name, unit = split_unit(label)
    suffix = f" [{unit}]" if unit else ""
    if breaks and unit:
        suffix = f"\n[{unit}]"
    room = width - (0.0 if breaks else text_width(suffix))
    characters = len(name)
    while characters > 3 and text_width(shorten(name, characters)) > room:
        characters -= 1
    return shorten(name, characters) + suffix


def legend_columns(labels: Sequence[str], width: float) -> int:
    """Return into how many columns a legend is put, so that it fits into a width [inch]."""
    entry = (LEGEND_LINE + LEGEND_GAP) * NORMAL_FONT / 72.0
    widths = [text_width(label) + entry for label in labels]
    for columns in range(len(labels), 1, -1):
        # The entries of a legend run down its columns, of which the first ones may be longer.
        if sum(map(max, np.array_split(widths, columns))) <= width:
            return columns
    return 1


def wrap(text: str, width: float, size: float) -> list[str]:
    """Break a text into lines of at most a width [inch], for a font of a size [points]."""
    # The printed width of the text says how many characters of it fit, up to long words.
    characters = int(len(text) * width / max(text_width(text, size), 1e-9))
    lines = textwrap.wrap(text, max(characters, 1), break_long_words=True)
    while characters > 8 and any(text_width(line, size) > width for line in lines):
        characters -= 4
        lines = textwrap.wrap(text, characters, break_long_words=True)
    return lines or [""]


@lru_cache(maxsize=4096)
def text_width(text: str, size: float = NORMAL_FONT) -> float:
    """Return the printed width of a text in one line [inch]."""
    font = get_font(findfont(FontProperties()))
    font.set_size(size, 72)
    font.set_text(text)
    return float(font.get_width_height()[0]) / 64.0 / 72.0


# ---- files


def save(drawn: Figure | Picture, path: str | os.PathLike[str], dpi: float | None = None) -> Path:
    """Write a figure in one step: readers find the old file or the complete new one.

    Args:
        drawn: The figure, or a picture to draw.
        path: File; its ending states the format.
        dpi: Resolution [pixels/inch]; default: that of the style sheet.

    Returns:
        The file.

    Raises:
        MjfimError: The ending is no format.
    """
    target = Path(path)
    format_name = target.suffix.lower().removeprefix(".")
    if format_name not in tuple(PictureFormat):
        raise MjfimError(
            f"{target.name!r}: the ending of a figure's file states its format; "
            f"valid: {', '.join(f'.{known}' for known in PictureFormat)}"
        )
    with replacing(target) as temporary:
        temporary.write_bytes(content(drawn, format_name, dpi))
    return target


def content(drawn: Figure | Picture, format_name: str, dpi: float | None = None) -> bytes:
    """Return what `save` writes; files of equal figures are equal, without the present time."""
    figure = figure_of(drawn) if isinstance(drawn, Picture) else drawn
    stream = io.BytesIO()
    resolution = dpi or STYLE_SHEET["savefig.dpi"]
    with own_style():
        if format_name != "png":
            metadata = DATELESS.get(format_name)
            figure.savefig(stream, format=format_name, dpi=resolution, metadata=metadata)
            return stream.getvalue()

        # `savefig` would draw the figure twice, the first time for the layout alone.
        usual_canvas, usual_dpi = figure.canvas, figure.dpi
        canvas: Any = FigureCanvasAgg(figure)
        figure.dpi = resolution
        try:
            canvas.print_png(stream)
        finally:
            figure.dpi = usual_dpi
            figure.set_canvas(usual_canvas)
    return stream.getvalue()
