"""Panels of pictures in Rerun: series over time, and plots of 2D lines on every timeline."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array, record
from mjfim.output.panels import SERIES, Axis, Mark, Panel
from mjfim.output.rerun.scene import (
    AXIS_COLOUR,
    WORD_COLOUR,
    EntityParts,
    entity_path,
    rgb,
    time_column,
)

# Largest number of plots on a page of a tab, above each other rather than in two columns, and in a
# line of the row of a question.
PLOTS_PER_PAGE, MAX_SINGLE_COLUMN, PLOTS_PER_ROW = 6, 3, 3

# Width and height of the axes of a plot of 2D lines, and space on the left, on the right, at the
# top and at the bottom of them [points].
SIZE, LEFT, RIGHT, TOP, BOTTOM = (380.0, 200.0), 58.0, 20.0, 14.0, 34.0

# Numbers beside an axis at most, and space above and below curves, over their range.
MOST_NUMBERS, MARGIN = 6, 0.06

# Share of a logarithmic axis that an axis of the viewer shows, which begins at zero.
SHOWN_SHARE = 1.0 / 3.0

# Plots of a group by the name of its tab.
Tabs = dict[str, list[Panel]]


# ---- tabs


def grid_tabs(name: str, views: Sequence[rrb.View]) -> list[rrb.Container]:
    """Arrange views in a tab, in two columns and on as many pages as they need.

    Args:
        name: Name of the tab.
        views: The views; none gives no tab.
    """
    pages = [views[k : k + PLOTS_PER_PAGE] for k in range(0, len(views), PLOTS_PER_PAGE)]
    grids: list[rrb.Container] = []
    for k, page in enumerate(pages):
        first = k * PLOTS_PER_PAGE + 1
        title = name if len(pages) == 1 else f"{first} to {first + len(page) - 1} of {len(views)}"
        columns = 1 if len(page) <= MAX_SINGLE_COLUMN else 2
        grids.append(rrb.Grid(*page, grid_columns=columns, name=title))
    return grids if len(grids) < 2 else [rrb.Tabs(*grids, name=name, active_tab=0)]


def series_tabs(tabs: Tabs) -> list[rrb.Container]:
    """Return a tab for each group of plots of series."""
    return [tab for name, panels in tabs.items() for tab in grid_tabs(name, _views(name, panels))]


def answers(questions: Iterable[tuple[str, Sequence[Panel]]]) -> rrb.Container:
    """Return the tab that is opened: a row of plots of series for each question.

    Args:
        questions: The name of a group, and some of its plots.
    """
    rows = [(name, panels) for name, panels in questions if panels]
    grids = [
        rrb.Grid(*_views(*row), grid_columns=min(len(row[1]), PLOTS_PER_ROW), name=row[0])
        for row in rows
    ]
    heights = [-(-len(panels) // PLOTS_PER_ROW) for _, panels in rows]
    return rrb.Vertical(*grids, row_shares=heights, name="answers")


def _views(name: str, panels: Sequence[Panel]) -> list[rrb.View]:
    """Return a view for each plot of a group; the first one of a page has a legend."""
    return [
        rrb.TimeSeriesView(
            origin=entity_path((name, panel.title)),
            name=panel.title,
            plot_legend=rrb.PlotLegend(visible=k % PLOTS_PER_PAGE == 0),
            axis_y=_range(panel.y),
        )
        for k, panel in enumerate(panels)
    ]


def _range(axis: Axis) -> rrb.ScalarAxis | None:
    """Return the stated range of an axis; the viewer shows the low part of a logarithmic one."""
    if axis.limits is None:
        return None
    return rrb.ScalarAxis(range=(0.0, SHOWN_SHARE * axis.limits[1]) if axis.log else axis.limits)


# ---- series over time


def log_series(rec: rr.RecordingStream, tabs: Tabs) -> None:
    """Log plots of series on the timeline `sim_time`.

    Args:
        rec: The recording.
        tabs: The plots, by the names of their tabs.
    """
    for name, panels in tabs.items():
        for panel in panels:
            times = [mark.x for mark in panel.marks if mark.kind in ("line", "steps", "dots")]
            ends = np.array([min(map(np.min, times)), max(map(np.max, times))])
            for k, mark in enumerate(panel.marks):
                _log_mark(rec, (name, panel.title, f"{k} {mark.label or mark.kind}"), mark, ends)


def with_curves(panel: Panel) -> Panel:
    """Return a panel of cells over time as one of curves, one for each row."""
    assert panel.cells is not None and panel.cells.edges is not None
    curves = [
        Mark(kind="steps", x=panel.cells.edges, y=row, role=f"series{k % len(SERIES)}", label=name)
        for k, (name, row) in enumerate(zip(panel.y.names or (), panel.cells.values, strict=True))
    ]
    return replace(panel, marks=curves)


def _log_mark(rec: rr.RecordingStream, parts: EntityParts, mark: Mark, ends: Array) -> None:
    """Log one mark, of a strip its edges; those that are level reach through the whole time."""
    x = mark.x[: len(mark.y)]
    if mark.kind in ("line", "steps", "dots"):
        _send(rec, parts, x, mark.y, mark)
    if mark.kind == "hline" or (mark.kind in ("hspan", "area") and mark.label):
        edges = [mark.y] if mark.other is None else [mark.y, mark.other]
        if mark.kind != "area":
            x, edges = ends, [np.repeat(level, 2) for level in edges]
            mark = replace(mark, width=1.0, label=mark.label or "limit")
        for k, edge in enumerate(edges):
            _send(rec, (*parts[:-1], f"{parts[-1]} {k}"), x, edge, mark)


def _send(rec: rr.RecordingStream, parts: EntityParts, t: Array, y: Array, mark: Mark) -> None:
    """Log a series with its look; values that are not finite are left out."""
    known = np.isfinite(y)
    if not known.any():
        return
    colours, names, path = [rgb(mark.role)], [mark.label], entity_path(parts)
    look: rr.SeriesLines | rr.SeriesPoints
    if mark.kind == "dots":
        look = rr.SeriesPoints(colors=colours, names=names, marker_sizes=[1.0])
    else:
        held = rr.components.InterpolationMode.StepAfter if mark.kind == "steps" else None
        look = rr.SeriesLines(
            colors=colours, names=names, widths=[1.3 * mark.width], interpolation_mode=held
        )
    rec.log(path, look, static=True, strict=True)
    columns = rr.Scalars.columns(scalars=y[known])
    rec.send_columns(path, [time_column(t[known])], columns, strict=True)


# ---- plots of 2D lines


@record
class Plane:
    """Axes of a plot of 2D lines.

    Attributes:
        parts: Entity of the plot.
        title: Title of its view.
        x: Ends of the axis across.
        y: Ends of the axis up; of their logarithms, if it is logarithmic.
        is_log: Whether the axis up is logarithmic.
    """

    parts: EntityParts
    title: str
    x: tuple[float, float]
    y: tuple[float, float]
    is_log: bool = False

    @classmethod
    def around(
        cls, parts: EntityParts, title: str, marks: Sequence[Mark], *, log: bool = False
    ) -> Plane:
        """Return axes that hold all lines and dots."""
        shown = [mark for mark in marks if mark.kind in ("line", "dots")]
        x = np.concatenate([np.zeros(0), *(mark.x for mark in shown)])
        y = np.concatenate([np.zeros(0), *(mark.y for mark in shown)])
        return cls(
            parts=parts,
            title=title,
            x=_ends(x),
            y=_ends(np.log10(y[y > 0.0]) if log else y),
            is_log=log,
        )

    def points(self, x: Array, y: Array) -> Array:
        """Return the finite points of a curve in plot coordinates, (n, 2)."""
        up = np.log10(np.where(y > 0.0, y, np.nan)) if self.is_log else y
        shares = [
            (values - low) / (high - low) for values, (low, high) in ((x, self.x), (up, self.y))
        ]
        points = np.column_stack([SIZE[0] * shares[0], SIZE[1] * (1.0 - shares[1])])
        return points[np.isfinite(points).all(axis=1)]

    def curve(self, x: Array, y: Array, role: str, width: float = 1.0) -> rr.LineStrips2D:
        """Return a curve."""
        radius = rr.Radius.ui_points(width)
        return rr.LineStrips2D([self.points(x, y)], colors=[rgb(role)], radii=radius)

    def log(
        self, rec: rr.RecordingStream, marks: Sequence[Mark] = (), *, static: bool = True
    ) -> None:
        """Log the axes with numbers, and lines and dots."""
        width, height = SIZE
        frame = [[(0.0, 0.0), (0.0, height), (width, height)]]
        lines = rr.LineStrips2D(frame, colors=[AXIS_COLOUR], radii=rr.Radius.ui_points(0.5))

        # The viewer writes a number below its point.
        across, up = round_numbers(*self.x), round_numbers(*self.y)
        below = np.column_stack(
            [width * (across - self.x[0]) / np.ptp(self.x), 0.0 * across + height + 8.0]
        )
        beside = np.column_stack(
            [0.0 * up - 28.0, height * (self.y[1] - up) / np.ptp(self.y) - 16.0]
        )
        texts = [f"{value:.4g}" for value in across]
        texts += [f"{10.0**value if self.is_log else value:.4g}" for value in up]
        parts: dict[str, rr.AsComponents] = {"axes": lines}
        parts["numbers"] = rr.Points2D(
            np.concatenate([below, beside]),
            labels=texts,
            colors=[WORD_COLOUR] * len(texts),
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )
        for k, mark in enumerate(marks):
            if mark.kind in ("line", "dots"):
                name = f"{k} {mark.label or mark.kind}"
                parts[name] = self.curve(mark.x, mark.y, mark.role, 0.6 * mark.width)
                if mark.kind == "dots":
                    parts[name] = rr.Points2D(
                        self.points(mark.x, mark.y),
                        colors=[rgb(mark.role)],
                        radii=rr.Radius.ui_points(2.0),
                    )
        for name, part in parts.items():
            rec.log(entity_path((*self.parts, name)), part, static=static, strict=True)

    def view(self) -> rrb.Spatial2DView:
        """Return the view of the plot."""
        bounds = rrb.VisualBounds2D(
            x_range=(-LEFT, SIZE[0] + RIGHT), y_range=(-TOP, SIZE[1] + BOTTOM)
        )
        return rrb.Spatial2DView(
            origin=entity_path(self.parts), name=self.title, visual_bounds=bounds
        )


def planes_of(name: str, panels: Sequence[Panel]) -> list[tuple[Plane, Panel]]:
    """Return axes for each panel of a group that has lines.

    Args:
        name: Name of the tab.
        panels: The panels; their axes are named in the titles.
    """
    planes = []
    for panel in panels:
        label = " ".join(panel.y.label.split())
        across = " ".join(panel.x.label.split())
        title = f"{label} over {across}" if across else panel.title
        if any(len(mark.x) for mark in panel.marks):
            planes.append((Plane.around((name, title), title, panel.marks, log=panel.y.log), panel))
    return planes


def _ends(values: Array) -> tuple[float, float]:
    """Return the ends of an axis around values, also around a constant and around nothing."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    margin = MARGIN * (high - low) or 0.5 * max(abs(low), 1e-9)
    return low - margin, high + margin


def round_numbers(low: float, high: float) -> Array:
    """Return round numbers in a range.

    Args:
        low: Lower end.
        high: Upper end.
    """
    power = 10.0 ** np.floor(np.log10((high - low) / MOST_NUMBERS))
    step = next(
        s * power for s in (1.0, 2.0, 5.0, 10.0) if (high - low) / (s * power) <= MOST_NUMBERS
    )
    numbers = step * np.arange(np.ceil(low / step), np.floor(high / step) + 1.0)
    # Round-off at zero is not shown.
    return np.where(np.abs(numbers) < 1e-9 * step, 0.0, numbers)
