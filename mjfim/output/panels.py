"""Pictures as data: panels with marks, axes and words, which know no drawing library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array, record
from mjfim.output.page import OTHER, TERMS

# Colours of roles that are no words of the vocabulary: text and reference lines, notes and curves
# that stay in the background, bands.
ROLES = {"text": "#222222", "muted": "#6b7076", "band": "#d9dcdf", "white": "#ffffff"} | {
    term: term.colour for term in (*TERMS, OTHER)
}

# Colours of curves that have no role; they differ also for readers who cannot tell red from green.
SERIES = (
    "#4477aa",
    "#ee6677",
    "#228833",
    "#ccbb44",
    "#66ccee",
    "#aa3377",
    "#332288",
    "#999933",
    "#882255",
    "#44aa99",
    "#dd8844",
    "#555555",
)
ROLES |= {f"series{i}": colour for i, colour in enumerate(SERIES)}

# Colours of negative, small and positive values of cells; those between are mixed in proportion.
CELL_COLOURS = ("#2166ac", "#f7f7f7", "#b2182b")
# Roles of two robots that a motion does not tell apart: orange and indigo.
ROBOT_ROLES = ("series10", "series6")

# Numbers of a mark.
Numbers = Sequence[float] | NDArray[Any]

# Kinds of marks: lines through points, held values between edges, dots; a strip between two curves,
# filled columns between edges; horizontal bars and intervals in rows; lines and strips through the
# whole panel, upright ("v") or level ("h"); words.
Kind = Literal[
    "line",
    "steps",
    "dots",
    "area",
    "columns",
    "bars",
    "intervals",
    "vline",
    "hline",
    "vspan",
    "hspan",
    "words",
]


@record
class Mark:
    """Something that is drawn in a panel.

    Attributes:
        kind: Kind of the mark.
        x: (n,) places across; edges of steps and columns are one more.
        y: (n,) places up.
        other: (n,) second edges: of an area upwards, of a bar or interval across.
        role: Word of the vocabulary, "text", "muted", "band" or "series0" to "series11".
        label: Entry of the legend; marks with equal labels share one.
        width: Width of lines [points].
        size: Size of dots [points], and height of bars over the height of a row.
        symbol: Symbol of dots, as matplotlib names it; with lines, empty for none.
        dash: Dashes of a line, as matplotlib names them.
        opacity: Opacity from 0 to 1.
        hollow: Whether dots are white inside, and bars hatched.
        front: Marks with larger numbers lie on others.
        texts: Words, one for each place.
    """

    kind: Kind
    x: Array
    y: Array
    other: Array | None = None
    role: str = "text"
    label: str = ""
    width: float = 1.3
    size: float = 4.0
    symbol: str = ""
    dash: str = "-"
    opacity: float = 1.0
    hollow: bool = False
    front: float = 2.0
    texts: Sequence[str] = ()


@record
class Axis:
    """An axis of a panel.

    Attributes:
        label: Quantity and unit.
        limits: Ends, in the direction of the axis; None where the marks state them.
        log: Whether it is logarithmic.
        ticks: Places of ticks, with `names`.
        names: Texts of these ticks; None for numbers.
        roles: Roles of the names.
        most: Largest number of intervals between ticks; 0 for the usual one.
        whole: Whether ticks are whole numbers.
        hidden: Whether ticks have no texts.
    """

    label: str = ""
    limits: tuple[float, float] | None = None
    log: bool = False
    ticks: Sequence[float] | None = None
    names: Sequence[str] | None = None
    roles: Sequence[str] = ()
    most: int = 0
    whole: bool = False
    hidden: bool = False


@record
class Cells:
    """Coloured cells, from blue over white to red.

    Attributes:
        values: (n, m) values; NaN is grey.
        middle: Value that is white.
        reach: Distance from the middle at which the colours end.
        texts: (n, m) words of the cells; empty for none.
        is_bold: (n, m) whether words are bold.
        scale: Values and names at a bar of colours beside the cells.
        edges: (m+1,) ends of the columns along the axis across; None for columns that are counted.
    """

    values: Array
    middle: float = 0.0
    reach: float = 1.0
    texts: Sequence[Sequence[str]] = ()
    is_bold: NDArray[np.bool_] | None = None
    scale: tuple[Sequence[float], Sequence[str]] | None = None
    edges: Array | None = None


@record
class Panel:
    """A part of a picture with its own axes.

    Attributes:
        marks: What is drawn.
        x: Axis across.
        y: Axis up.
        title: Name above the panel.
        role: Role of the title.
        remark: Small words below the title.
        message: Sentence in the middle of a panel that has nothing to draw.
        beside: Columns of words right of the rows: heading, role, and words of each row.
        cells: Coloured cells.
        place: Row and column in the picture.
        is_wide: Whether it takes all columns.
        is_shaded: Whether its background is grey.
    """

    marks: Sequence[Mark] = ()
    x: Axis = field(default_factory=Axis)
    y: Axis = field(default_factory=Axis)
    title: str = ""
    role: str = "text"
    remark: str = ""
    message: str = ""
    beside: Sequence[tuple[str, str, Sequence[str]]] = ()
    cells: Cells | None = None
    place: tuple[int, int] = (0, 0)
    is_wide: bool = False
    is_shaded: bool = False


@record
class Picture:
    """Panels under one title and one legend.

    Attributes:
        title: Result in a sentence.
        panels: The panels.
        note: Explanation below them.
        heights: Height of each row of panels [inch].
        widths: Widths of the columns, relative to each other.
        keys: Marks without points that the legend shows behind all others.
    """

    title: str
    panels: Sequence[Panel]
    note: str = ""
    heights: Sequence[float] = (3.0,)
    widths: Sequence[float] = (1.0,)
    keys: Sequence[Mark] = ()

    def legend(self) -> list[Mark]:
        """Return one mark for each entry of the legend."""
        marks = [mark for panel in self.panels for mark in panel.marks]
        return list({mark.label: mark for mark in (*marks, *self.keys) if mark.label}.values())


# ---- marks


def mark(kind: Kind, x: Numbers, y: Numbers, role: str, **look: Any) -> Mark:
    """Return a mark; the look are further attributes of `Mark`."""
    places = (np.asarray(values, dtype=np.float64) for values in (x, y))
    return Mark(kind=kind, x=next(places), y=next(places), role=role, **look)


# Lines through points, and dots.
line = partial(mark, "line")
dots = partial(mark, "dots", symbol="o")


def area(x: Numbers, low: Array, high: Array, role: str, **look: Any) -> Mark:
    """Return a strip between two curves."""
    return mark("area", x, low, role, other=high, **{"opacity": 0.25, **look})


def intervals(low: Numbers, high: Numbers, rows: Numbers, role: str, **look: Any) -> Mark:
    """Return intervals across; an arrow marks where the axis cuts one off."""
    return mark("intervals", low, rows, role, other=np.asarray(high), **look)


def bars(ends: Numbers, rows: Numbers, role: str, *, left: float, **look: Any) -> Mark:
    """Return bars across that begin at `left`."""
    begins = np.full(len(ends), left)
    return mark("bars", ends, rows, role, other=begins, **{"size": 0.6, **look})


def vline(x: float, role: str = "text", **look: Any) -> Mark:
    """Return an upright line through the panel."""
    return mark("vline", [x], [0.0], role, **{"width": 1.0, **look})


def hline(y: float, role: str = "text", **look: Any) -> Mark:
    """Return a level line through the panel."""
    return mark("hline", [0.0], [y], role, **{"width": 1.0, **look})


def vspan(low: float, high: float, role: str = "band", **look: Any) -> Mark:
    """Return an upright strip through the panel."""
    return mark("vspan", [low], [0.0], role, other=np.array([high]), **{"front": 0.0, **look})


def hspan(low: float, high: float, role: str = "band", **look: Any) -> Mark:
    """Return a level strip through the panel."""
    return mark("hspan", [0.0], [low], role, other=np.array([high]), **{"front": 0.0, **look})


def words(x: Numbers, y: Numbers, texts: Sequence[str], role: str, **look: Any) -> Mark:
    """Return words that begin right of places."""
    return mark("words", x, y, role, texts=tuple(texts), **look)


# ---- axes and places


def row_axis(names: Sequence[str], roles: Sequence[str] = ()) -> Axis:
    """Return a vertical axis with a name for each row, the first one at the top."""
    return replace(blank_rows(len(names)), ticks=range(len(names)), names=names, roles=roles)


def blank_rows(count: int) -> Axis:
    """Return a vertical axis with places for rows that a neighbour names."""
    return Axis(ticks=[], limits=(count - 0.5, -0.5))


def in_grid(panels: Sequence[Panel], columns: int, first_row: int = 0) -> list[Panel]:
    """Place panels row by row."""
    return [
        replace(panel, place=(first_row + k // columns, k % columns))
        for k, panel in enumerate(panels)
    ]


def grid(
    title: str, panels: Sequence[Panel], heights: Sequence[float], columns: int, note: str
) -> Picture:
    """Return a picture of panels row by row; a row is as high as its highest panel [inch]."""
    return Picture(
        title=title,
        panels=in_grid(panels, columns),
        note=note,
        heights=[max(heights[k : k + columns]) for k in range(0, len(panels), columns)],
        widths=[1.0] * columns,
    )


def around(values: Array, *, factor: float = 1.4) -> tuple[float, float]:
    """Return ends of a logarithmic axis that holds all positive values."""
    usable = values[np.isfinite(values) & (values > 0.0)]
    if not len(usable):
        return 0.1, 10.0
    return float(usable.min()) / factor, float(usable.max()) * factor


# Largest reach of an interval that is shown, over the median one, and largest distance from the
# median, over the median reach.
NEAR, FARTHEST = 3.0, 20.0


def range_of_intervals(centre: Array, low: Array, high: Array) -> tuple[float, float]:
    """Return ends of an axis that shows intervals; few wide or distant ones do not widen it.

    Args:
        centre: (n,) middles of the intervals.
        low: (n,) their lower ends.
        high: (n,) their upper ends.
    """
    known = np.isfinite([centre, low, high]).all(axis=0)
    if not known.any():
        return -1.0, 1.0
    centre, low, high = centre[known], low[known], high[known]
    usual = np.median(high - low) / 2.0
    distance = np.abs(centre - np.median(centre))
    shown = distance <= FARTHEST * max(usual, float(np.median(distance)))
    begin = float(np.maximum(low, centre - NEAR * usual)[shown].min())
    end = float(np.minimum(high, centre + NEAR * usual)[shown].max())
    margin = 0.06 * (end - begin) or 1e-3 * max(abs(begin), np.finfo(float).tiny)
    return begin - margin, end + margin
