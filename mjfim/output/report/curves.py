"""Curves, bars and cells for the plotting library, small enough for one file."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.output.report.page import Panel, Plotly

# Smallest and largest number of points of one curve; a longer one is thinned for display.
FEWEST_POINTS, MOST_POINTS = 40, 4000

# Share of the range of values below which single precision is exact enough for display.
DISPLAY_PRECISION = 1e-5

# Decades of a logarithmic axis below which values between the powers of ten have labels, too.
SHORT_LOG_AXIS = 2.5

# Decades below which an axis is not logarithmic.
SHORTEST_LOG_AXIS = 0.75

# Power of ten below which tick labels are written without it.
MAX_PLAIN_POWER = 4.0

# Characters to which names are shortened on an axis with names.
AXIS_NAME_WIDTH = 22

# Characters of the names beside and below a matrix, and largest number of columns whose names stand
# level.
ROW_NAME_WIDTH, COLUMN_NAME_WIDTH, MAX_LEVEL_NAMES = 20, 12, 3

# Numbers beside the colours of correlations, which change fastest near 0.
CORRELATION_TICKS = [-1, -0.5, -0.2, 0, 0.2, 0.5, 1]

# Largest number of parameters for which correlations are written into the cells.
MAX_WRITTEN_CELLS = 14

# Heights of a row of bars and of cells, and of what surrounds them [CSS pixels].
BAR_ROW, CELL_ROW, AXES_HEIGHT = 34, 34, 90

# Largest height of a plot with a row per parameter [CSS pixels].
MAX_ROWS_HEIGHT = 1400


# ---- arrays


def packed(values: Array | Sequence[float]) -> dict[str, str]:
    """Return numbers as the plotting library reads them from text, in single precision if possible.

    Args:
        values: (n,) numbers; NaN is a gap.
    """
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore"):
        single = array.astype(np.float32)
    finite = np.isfinite(array)
    extent = float(np.ptp(array[finite])) if finite.any() else 0.0
    with np.errstate(invalid="ignore"):
        rounding = np.abs(single - array)[finite]

    is_exact = bool((rounding <= DISPLAY_PRECISION * extent).all())
    kind, stored = ("f4", single) if is_exact else ("f8", array)
    content = stored.astype(f"<{kind}").tobytes()
    return {"dtype": kind, "bdata": base64.b64encode(content).decode("ascii")}


def points_per_curve(lengths: Sequence[int], points: int) -> int:
    """Return how many points each curve may have, so that all together have at most so many.

    Args:
        lengths: Number of points of each curve.
        points: Number of points of all curves together, as long as every curve keeps a few.
    """
    low, high = FEWEST_POINTS, MOST_POINTS
    while low < high:
        middle = (low + high + 1) // 2
        if sum(min(length, middle) for length in lengths) <= points:
            low = middle
        else:
            high = middle - 1
    return low


def thinned(values: Array, limit: int) -> np.ndarray:
    """Return which points of a curve are drawn, so that all of its peaks stay.

    The curve is divided into intervals, and the smallest and the largest value of each interval
    remain, with the first and the last point of all.

    Args:
        values: (n,) values; NaN is a gap.
        limit: Largest number of points.

    Returns:
        (m,) ascending indices, m <= limit; all indices of a curve that is short enough.
    """
    count = len(values)
    if count <= limit:
        return np.arange(count)

    # The last interval is filled up with its last value.
    bins = max((limit - 2) // 2, 1)
    width = -(-count // bins)
    bins = -(-count // width)
    filled = np.pad(values, (0, bins * width - count), mode="edge").reshape(bins, width)

    # A gap is shown only where an interval has no value at all.
    measured = np.isfinite(filled)
    starts = width * np.arange(bins)
    smallest = starts + np.where(measured, filled, np.inf).argmin(axis=1)
    largest = starts + np.where(measured, filled, -np.inf).argmax(axis=1)
    ends = np.concatenate([[0], smallest, largest, [count - 1]])
    return np.unique(np.minimum(ends, count - 1))


def is_line(trace: Plotly) -> bool:
    """Whether a trace is a line or dots, whose points are arrays that are thinned for display.

    Args:
        trace: The trace.
    """
    return bool(trace["type"] == "scatter")


def packed_trace(trace: Plotly, limit: int) -> Plotly:
    """Return a trace with at most so many points, as the plotting library reads it from text.

    Args:
        trace: The trace; only lines and dots are changed.
        limit: Largest number of points.
    """
    if not is_line(trace):
        return trace

    # Points with intervals are few, and each is shown.
    has_intervals = "error_x" in trace or "error_y" in trace
    kept = thinned(trace["y"], len(trace["y"]) if has_intervals else limit)
    changed: Plotly = {"x": packed(trace["x"][kept]), "y": packed(trace["y"][kept])}
    if "text" in trace:
        changed["text"] = [trace["text"][i] for i in kept]
    return {**trace, **changed}


# ---- traces


def curve(
    x: Array,
    y: Array,
    name: str,
    role: str,
    *,
    width: float = 1.6,
    dash: str = "solid",
    held: bool = False,
) -> Plotly:
    """Return a line, all points of it.

    Args:
        x: (n,) horizontal values.
        y: (n,) vertical values; NaN is a gap.
        name: Name in the legend.
        role: Role of its colour.
        width: Line width [CSS pixels].
        dash: "solid", "dot" or "dash".
        held: True where a value is held until the next one.
    """
    line = {"color": f"role:{role}", "width": width, "dash": dash}
    if held:
        line["shape"] = "hv"
    return {
        "type": "scatter",
        "mode": "lines",
        "x": np.asarray(x, dtype=np.float64),
        "y": np.asarray(y, dtype=np.float64),
        "name": escape(name),
        "legendgroup": name,
        "line": line,
    }


def dots(
    x: Array,
    y: Array,
    name: str,
    role: str,
    *,
    size: float = 4.0,
    symbol: str = "circle",
    texts: Sequence[str] | None = None,
) -> Plotly:
    """Return dots, all of them.

    Args:
        x: (n,) horizontal values.
        y: (n,) vertical values.
        name: Name in the legend.
        role: Role of their colour.
        size: Diameter [CSS pixels].
        symbol: Symbol of the plotting library.
        texts: n texts that are shown at the pointer.
    """
    trace: Plotly = {
        "type": "scatter",
        "mode": "markers",
        "x": np.asarray(x, dtype=np.float64),
        "y": np.asarray(y, dtype=np.float64),
        "name": escape(name),
        "legendgroup": name,
        "marker": {"color": f"role:{role}", "size": size, "symbol": symbol},
    }
    if texts is not None:
        trace["text"] = [escape(text) for text in texts]
        trace["hoverinfo"] = "text+name"
    return trace


def error_bars(
    role: str, above: Array, below: Array | None = None, *, width: int = 5, thickness: float = 2
) -> Plotly:
    """Error bars of a trace; values without a finite length have none.

    Args:
        role: Role of the colour.
        above: Lengths of the bars above the values, and below them if no others are given.
        below: Lengths of the bars below the values, or None.
        width: Width of the caps [pixel].
        thickness: Thickness of the lines [pixel].
    """
    lengths: Plotly = {"array": finite_or_null(above)}
    if below is not None:
        lengths = {"symmetric": False, **lengths, "arrayminus": finite_or_null(below)}
    return {
        "type": "data",
        **lengths,
        "color": f"role:{role}",
        "thickness": thickness,
        "width": width,
    }


def finite_or_null(values: Array) -> list[float | None]:
    """Numbers for JSON, which has no NaN.

    Args:
        values: (n,) numbers.
    """
    return [float(value) if np.isfinite(value) else None for value in values]


def rows_of_bars(
    values: Array, name: str, role: str, *, texts: Sequence[str], outside: bool = True
) -> Plotly:
    """Return horizontal bars, one for each row.

    Args:
        values: (n,) lengths; NaN is no bar.
        name: Name in the legend.
        role: Role of their colour.
        texts: n texts beside the bars.
        outside: True where the texts stand at the ends of the bars.
    """
    return {
        "type": "bar",
        "orientation": "h",
        "x": packed(values),
        "y": packed(np.arange(float(len(values)))),
        "name": escape(name),
        "legendgroup": name,
        "marker": {"color": f"role:{role}"},
        "text": [escape(text) for text in texts],
        "textposition": "outside" if outside else "none",
        "hoverinfo": "text+name",
        "cliponaxis": False,
    }


# ---- layouts


def axis(title: str = "", **settings: Any) -> Plotly:
    """Return an axis.

    Args:
        title: Its title with the unit.
        settings: Further settings of the plotting library.
    """
    named = {"title": {"text": escape(title)}} if title else {}
    return {**named, **settings}


def log_axis(title: str, values: Array, *, room: tuple[float, float] = (0.0, 0.0)) -> Plotly:
    """Return a logarithmic axis with few, complete tick labels.

    Args:
        title: Its title with the unit.
        values: (n,) values on it; those that are not positive are left out.
        room: Decades that the axis has beyond the smallest and the largest value; without them the
            plotting library chooses its ends.
    """
    usable = values[np.isfinite(values) & (values > 0.0)]
    if not usable.size:
        return axis(title)

    # A short range has more labels on a linear axis.
    low, high = (float(value) for value in np.log10([usable.min(), usable.max()]))
    low, high = low - room[0], high + room[1]
    span = high - low
    if span < SHORTEST_LOG_AXIS:
        return axis(title)

    settings: Plotly = {"type": "log", "dtick": max(1, int(np.ceil(span / 6.0)))}
    if span < SHORT_LOG_AXIS:
        settings.update(dtick="D2", minorloglabels="complete")
    if max(abs(low), abs(high)) < MAX_PLAIN_POWER:
        settings["tickformat"] = "~g"
    if any(room):
        settings["range"] = [low, high]
    return axis(title, **settings)


def row_axis(names: Sequence[str], width: int = AXIS_NAME_WIDTH) -> Plotly:
    """Return a vertical axis with a name for each row, the first at the top.

    Args:
        names: The names.
        width: Characters to which they are shortened.
    """
    count = len(names)
    return {
        "tickmode": "array",
        "tickvals": list(range(count)),
        "ticktext": [escape(shortened_name(name, width)) for name in names],
        "range": [count - 0.45, -0.55],
        "showgrid": False,
        "zeroline": False,
        "automargin": True,
        "fixedrange": True,
    }


def rows_height(count: int, row: int = BAR_ROW) -> int:
    """Return the height of a plot with a row for each name [CSS pixels].

    Args:
        count: Number of rows.
        row: Height of a row [CSS pixels].
    """
    return min(AXES_HEIGHT + row * count, MAX_ROWS_HEIGHT)


def shortened_name(name: str, width: int = AXIS_NAME_WIDTH) -> str:
    """Shorten a long name; both of its ends stay.

    Args:
        name: The name.
        width: Largest number of characters.
    """
    if len(name) <= width:
        return name
    kept = (width - 1) // 2
    return f"{name[:kept]}…{name[-kept:]}"


def level(
    value: float, role: str, *, across: str = "x", dash: str = "dash", layer: str = "above"
) -> Plotly:
    """Return a straight line through a plot.

    Args:
        value: Place of the line on the other axis.
        role: Role of its colour.
        across: "x" for a line along the horizontal axis, "y" for one along the vertical axis.
        dash: "solid", "dot" or "dash".
        layer: "above" for a line over grid, bars and curves, or "below".
    """
    ends = {"xref": "x domain", "x0": 0, "x1": 1, "y0": value, "y1": value}
    if across == "y":
        ends = {"yref": "y domain", "y0": 0, "y1": 1, "x0": value, "x1": value}
    line = {"color": f"role:{role}", "width": 1, "dash": dash}
    return {"type": "line", **ends, "line": line, "layer": layer}


def band(low: float, high: float, role: str = "band", *, across: str = "x") -> Plotly:
    """Return a shaded strip through a plot.

    Args:
        low: Its lower end.
        high: Its upper end.
        role: Role of its colour.
        across: "x" for a strip along the horizontal axis, "y" for one along the vertical axis.
    """
    ends = {"xref": "x domain", "x0": 0, "x1": 1, "y0": low, "y1": high}
    if across == "y":
        ends = {"yref": "y domain", "y0": 0, "y1": 1, "x0": low, "x1": high}
    return {
        "type": "rect",
        **ends,
        "fillcolor": f"role:{role}",
        "line": {"width": 0},
        "layer": "below",
    }


# ---- plots that several reports have


def correlation_panel(correlation: Array, names: Sequence[str], title: str) -> Panel:
    """Return a heat map of a correlation matrix; the diagonal and unknown cells are empty.

    Args:
        correlation: (n, n) correlations, -1 to 1; NaN where there is none.
        names: n names.
        title: Title of the plot.
    """
    shown = correlation.copy()
    np.fill_diagonal(shown, np.nan)
    count = len(names)
    texts = [
        [
            f"{escape(names[i])} and {escape(names[j])}: {shown[i, j]:+.3f}"
            if np.isfinite(shown[i, j])
            else ""
            for j in range(count)
        ]
        for i in range(count)
    ]
    trace: Plotly = {
        "type": "heatmap",
        "z": [[None if np.isnan(v) else round(float(v), 2) + 0.0 for v in row] for row in shown],
        "meta": "correlation",
        "hovertext": texts,
        "hoverinfo": "text",
        "hoverongaps": False,
        "colorscale": "role:diverging",
        "zmin": -1,
        "zmax": 1,
        "xgap": 1,
        "ygap": 1,
        "colorbar": {"thickness": 10, "outlinewidth": 0, "tickvals": CORRELATION_TICKS},
    }
    if count <= MAX_WRITTEN_CELLS:
        trace["texttemplate"] = "%{z:+.2f}"

    # Long names would be cut below the columns; numbers stand for them.
    is_numbered = count > MAX_LEVEL_NAMES and max(map(len, names)) > COLUMN_NAME_WIDTH
    numbers = [str(i + 1) for i in range(count)]
    columns = row_axis(numbers if is_numbered else names, COLUMN_NAME_WIDTH)
    columns.update(range=[-0.5, count - 0.5], side="bottom", tickangle=0)
    if count > MAX_LEVEL_NAMES and not is_numbered:
        columns["tickangle"] = -45
    pairs = zip(numbers, names, strict=True)
    numbered = [f"{shortened_name(name, ROW_NAME_WIDTH)}  {number}" for number, name in pairs]
    rows = row_axis(numbered if is_numbered else names, ROW_NAME_WIDTH + 4)
    rows["range"] = [count - 0.5, -0.5]
    return Panel(
        title=title,
        traces=[trace],
        layout={"xaxis": columns, "yaxis": rows, "hovermode": "closest"},
        height=rows_height(max(count, 4), CELL_ROW),
        narrow=True,
    )
