"""Pictures for Plotly: the traces and the layout of each panel.

A page holds all its pictures in one file. Curves are therefore thinned, and numbers are packed.
"""

from __future__ import annotations

import base64
from dataclasses import replace
from html import escape
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.output.panels import Axis, Cells, Mark, Panel, Picture
from mjfim.output.words import shorten

# An object for Plotly, of values that JSON can hold.
Plotly = dict[str, Any]

# Largest rounding with which numbers are stored in single precision, as a share of their range.
DISPLAY_PRECISION = 1e-5

# Plotly's names of the dashes and symbols of marks.
DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}
SYMBOLS = {
    "o": "circle",
    ".": "circle",
    "|": "line-ns-open",
    "_": "line-ew-open",
    "x": "x",
    "s": "square",
    "D": "diamond",
    "^": "triangle-up",
    "v": "triangle-down",
    "<": "triangle-left",
    ">": "triangle-right",
}

# CSS pixels of a point, of an inch, and of the lowest plot.
PIXELS, INCH, LEAST_HEIGHT = 1.3, 100, 170

# Width of a letter beside rows [CSS pixels], and largest number of letters of the name of a tick.
LETTER, NAME_WIDTH = 6.5, 26

# On a logarithmic axis of fewer decades, values between the powers of ten have labels, too.
SHORT_LOG_AXIS = 2.5


# A panel of a page, whether it takes the whole width, and its data.
Plot = tuple[Panel, bool, Plotly]


def plots_of(picture: Picture, limit: int) -> list[Plot]:
    """Turn a picture into plots.

    Args:
        picture: The picture.
        limit: Largest number of points of a curve.

    Returns:
        Of each panel: the panel, whether it takes the whole width, and what the script of the page
        reads.
    """
    # Only the lowest panel of a column names the axis that all panels of the column share. A panel
    # below all columns has an axis of its own.
    shared = {
        panel.place[1]: panel.x.label
        for panel in picture.panels
        if panel.x.label and (len(picture.widths) == 1 or not panel.is_wide)
    }
    plots = []
    for panel in picture.panels:
        label = panel.x.label or shared.get(panel.place[1], "")
        is_linked = panel.x.names is None and not panel.cells
        data = {
            "traces": [trace for mark in panel.marks for trace in _traces(mark, limit)]
            + ([] if panel.cells is None else [_heatmap(panel.cells)]),
            "layout": _layout(panel, label),
            "height": max(int(INCH * picture.heights[panel.place[0]]), LEAST_HEIGHT),
            "linked": f"{picture.title} {label}" if is_linked else "",
        }
        plots.append((panel, panel.is_wide or len(picture.widths) == 1, data))
    return plots


# ---- marks


def _traces(mark: Mark, limit: int) -> list[Plotly]:
    """The traces of a mark; none for straight lines and strips, see `_shapes`."""
    colour = f"role:{mark.role}"
    named = {"name": escape(mark.label), "legendgroup": mark.label, "opacity": mark.opacity}
    other = np.zeros(0) if mark.other is None else mark.other
    lines = {**named, "type": "scatter", "mode": "lines", "hoverinfo": "skip"}
    match mark.kind:
        case "line" | "steps" | "dots":
            return [{**named, **_points(mark, colour, limit)}]
        case "area":
            x, y = np.append(mark.x, mark.x[::-1]), np.append(mark.y, other[::-1])
            fill = {"fill": "toself", "fillcolor": colour, "line": {"width": 0}}
            return [{**lines, **fill, "x": packed(x), "y": packed(y)}]
        case "columns":
            return [
                {
                    **named,
                    "type": "bar",
                    "x": packed(0.5 * (mark.x[1:] + mark.x[:-1])),
                    "y": packed(mark.y),
                    "width": np.diff(mark.x).tolist(),
                    "marker": {"color": colour},
                }
            ]
        case "bars":
            pattern = {"pattern": {"shape": "/"}} if mark.hollow else {}
            return [
                {
                    **named,
                    "type": "bar",
                    "orientation": "h",
                    "base": other.tolist(),
                    "x": packed(mark.x - other),
                    "y": packed(mark.y),
                    "width": mark.size,
                    "marker": {"color": colour, **pattern},
                    "hovertext": [f"{value:.4g}" for value in mark.x],
                    "hoverinfo": "text+name",
                }
            ]
        case "intervals":
            gap = np.full(len(mark.x), np.nan)
            x = np.stack([mark.x, other, gap], axis=1).ravel()
            line = {"color": colour, "width": PIXELS * mark.width}
            return [{**lines, "line": line, "x": packed(x), "y": packed(np.repeat(mark.y, 3))}]
        case "words":
            words = [escape(text) for text in mark.texts]
            look = {
                "textposition": "middle right",
                "textfont": {"color": colour, "size": 11},
            }
            drawn = {**lines, **look, "mode": "text", "cliponaxis": False, "text": words}
            return [{**drawn, "x": packed(mark.x), "y": packed(mark.y)}]
    return []


def _points(mark: Mark, colour: str, limit: int) -> Plotly:
    """The trace of a curve, of held values or of dots, with at most about `limit` points."""
    y = np.append(mark.y, mark.y[-1:]) if mark.kind == "steps" else mark.y
    kept = thinned(y, limit)
    drawn: Plotly = {"type": "scatter", "x": packed(mark.x[kept]), "y": packed(y[kept])}
    parts = [] if mark.kind == "dots" else ["lines"]
    if parts:
        look = {"color": colour, "width": PIXELS * mark.width, "dash": DASHES[mark.dash]}
        drawn["line"] = look | ({"shape": "hv"} if mark.kind == "steps" else {})
    if mark.symbol:
        parts.append("markers")
        drawn["marker"] = _marker(mark, colour)
    if mark.texts:
        drawn["text"] = [escape(mark.texts[i]) for i in kept]
        drawn["hoverinfo"] = "text+name"
    return {**drawn, "mode": "+".join(parts)}


def _marker(mark: Mark, colour: str) -> Plotly:
    """The look of dots."""
    symbol = SYMBOLS[mark.symbol]
    if mark.hollow and not symbol.endswith("open"):
        symbol += "-open"
    size = max(PIXELS * mark.size * (0.6 if mark.symbol == "." else 1.0), 3.0)
    marker: Plotly = {"color": colour, "size": size, "symbol": symbol}
    if symbol.startswith("line"):
        marker["line"] = {"width": PIXELS * mark.width, "color": colour}
    return marker


def _heatmap(cells: Cells) -> Plotly:
    values = cells.values - cells.middle
    trace = {
        "type": "heatmap",
        "z": [[float(v) if np.isfinite(v) else None for v in row] for row in values],
        "colorscale": "role:diverging",
        "zmin": -cells.reach,
        "zmax": cells.reach,
        "xgap": 1,
        "ygap": 1,
        "hoverongaps": False,
        "hoverinfo": "z",
        "showscale": cells.scale is not None,
    }
    if cells.edges is not None:
        trace |= {"x": cells.edges.tolist(), "xgap": 0, "hoverinfo": "x+z"}
    if cells.scale is not None:
        places = [float(place) - cells.middle for place in cells.scale[0]]
        ticks = {"tickvals": places, "ticktext": list(cells.scale[1])}
        trace["colorbar"] = {"thickness": 10, "outlinewidth": 0, **ticks}
    if len(cells.texts):
        texts = [[escape(text) for text in row] for row in cells.texts]
        trace |= {"text": texts, "texttemplate": "%{text}", "hoverinfo": "text"}
    return trace


# ---- layout


def _layout(panel: Panel, label: str) -> Plotly:
    """Axes, straight lines and strips, and words beside the rows."""
    # Where the rows of cells have no names, they are named like the columns.
    rows = panel.y
    if panel.cells is not None and not rows.names:
        rows = replace(panel.x, limits=(len(panel.cells.values) - 0.5, -0.5))
    annotations, right = _words_beside(panel)
    layout = {
        "xaxis": _axis(panel.x, label),
        "yaxis": _axis(rows, rows.label if panel.title else ""),
        "shapes": [shape for mark in panel.marks for shape in _shapes(mark)],
        "annotations": annotations,
        "barmode": "overlay",
        "bargap": 0,
    }
    if panel.message:
        place = {"xref": "paper", "yref": "paper", "x": 0.5, "y": 0.5, "showarrow": False}
        annotations.append({**place, "text": escape(panel.message)})
    if panel.y.names is not None or panel.cells is not None:
        layout["hovermode"] = "closest"
    if panel.beside:
        layout["margin"] = {"r": int(right) + 6, "t": 24}
    return layout


def _axis(axis: Axis, label: str) -> Plotly:
    shown: Plotly = {"title": {"text": escape(label)}} if label else {}
    if axis.limits is not None:
        ends = np.log10(axis.limits) if axis.log else np.asarray(axis.limits)
        shown["range"] = ends.tolist()
    if axis.log:
        shown |= {"type": "log", "tickformat": "~g"}
        span = abs(shown["range"][1] - shown["range"][0]) if "range" in shown else SHORT_LOG_AXIS
        shown["dtick"] = max(1, int(np.ceil(span / 6.0)))
        if span < SHORT_LOG_AXIS:
            shown |= {"dtick": "D2", "minorloglabels": "complete"}
    if axis.whole:
        shown["tickformat"] = "d"
    if axis.ticks is not None:
        shown |= {"tickmode": "array", "tickvals": [float(tick) for tick in axis.ticks]}
    if axis.names is not None:
        names = [escape(shorten(name, NAME_WIDTH, axis.names)) for name in axis.names]
        shown |= {"ticktext": names, "showgrid": False, "zeroline": False, "fixedrange": True}
    return shown


def _shapes(mark: Mark) -> list[Plotly]:
    """The shape of a straight line or of a strip through the whole panel; none for other marks."""
    if mark.kind not in ("vline", "hline", "vspan", "hspan"):
        return []
    upright = mark.kind[0] == "v"
    along, across = ("x", "y") if upright else ("y", "x")
    begin = float((mark.x if upright else mark.y)[0])
    end = begin if mark.other is None else float(mark.other[0])
    place = {f"{along}0": begin, f"{along}1": end, f"{across}ref": f"{across} domain"}
    place |= {f"{across}0": 0, f"{across}1": 1, "layer": "below", "opacity": mark.opacity}
    colour = f"role:{mark.role}"
    if mark.kind.endswith("span"):
        return [{"type": "rect", **place, "fillcolor": colour, "line": {"width": 0}}]
    line = {"color": colour, "width": PIXELS * mark.width, "dash": DASHES[mark.dash]}
    return [{"type": "line", **place, "line": line}]


def _words_beside(panel: Panel) -> tuple[list[Plotly], float]:
    """The columns of words right of the rows, and where they end [CSS pixels]."""
    found, right = [], 8.0
    place = {"xref": "paper", "x": 1.0, "xanchor": "left", "showarrow": False}
    for heading, role, texts in panel.beside:
        look = {**place, "xshift": right, "font": {"size": 11, "color": f"role:{role}"}}
        top = {"yref": "paper", "y": 1.0, "yanchor": "bottom"}
        found.append({**look, **top, "text": escape(heading)})
        found += [{**look, "y": row, "text": escape(text)} for row, text in enumerate(texts)]
        right += LETTER * (2 + max(map(len, (heading, *texts))))
    return found, right


# ---- numbers


def packed(values: Array) -> dict[str, str]:
    """Return numbers as base64 text, which Plotly reads, in single precision if possible."""
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        single = array.astype(np.float32)
        rounding = np.abs(single - array)
    finite = np.isfinite(array)
    extent = float(np.ptp(array[finite])) if finite.any() else 0.0
    is_exact = bool((rounding[finite] <= DISPLAY_PRECISION * extent).all())
    kind, stored = ("f4", single) if is_exact else ("f8", array)
    content = stored.astype(f"<{kind}").tobytes()
    return {"dtype": kind, "bdata": base64.b64encode(content).decode("ascii")}


def thinned(values: Array, limit: int) -> np.ndarray:
    """Return the indices of the points that are drawn: the peaks of equal intervals of a curve."""
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
