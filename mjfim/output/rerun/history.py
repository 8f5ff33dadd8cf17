"""History of an optimisation in Rerun.

Series are on the timeline `iteration`; static bars are visible on every timeline.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.rerun.panels import LINE_WIDTH, series_view
from mjfim.output.rerun.scene import entity_path
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.records.design import HistoryRow

# Numbers of iterations and values of one quantity, both (n,).
Series = tuple[NDArray[np.int64], Array]


def history_series(history: Sequence[HistoryRow]) -> dict[str, Series]:
    """Return cost, smallest eigenvalue, slope and step length over the iterations.

    Args:
        history: The history.

    Returns:
        Iterations and values by title. Quantities that are always positive are log10, which their
        title says; iterations without a value are left out.
    """
    iterations = np.array([row.iteration for row in history], dtype=np.int64)
    cost = np.array([row.cost for row in history], dtype=np.float64)
    eigenvalue = np.array([row.min_eigenvalue for row in history], dtype=np.float64)
    slope = np.array([abs(row.slope) for row in history], dtype=np.float64)
    step = np.array([row.gamma for row in history], dtype=np.float64)

    # An eigenvalue or a slope of exactly 0 stands for "not computed"; a cost of 0 is a value.
    series = {}
    for title, values, usable in (
        ("cost", cost, np.isfinite(cost)),
        ("λ_min", eigenvalue, np.isfinite(eigenvalue) & (eigenvalue != 0.0)),
        ("slope", slope, np.isfinite(slope) & (slope != 0.0)),
    ):
        kept = values[usable]
        if len(kept) and bool(np.all(kept > 0.0)):
            series[f"log10 {title}"] = (iterations[usable], np.log10(kept))
        else:
            series[title] = (iterations[usable], kept)

    known = np.isfinite(step)
    series["step length"] = (iterations[known], step[known])
    return series


def log_history(
    rec: rr.RecordingStream, history: Sequence[HistoryRow], styles: Sequence[RobotStyle]
) -> None:
    """Log every series on the timeline `iteration`, and as static bars.

    Args:
        rec: The recording.
        history: The history.
        styles: Style of each series.
    """
    series = history_series(history)
    for (title, (iterations, values)), style in zip(series.items(), styles, strict=False):
        path = entity_path(("history", title))
        line = rr.SeriesLines(colors=[style.accent], names=[title], widths=[LINE_WIDTH])
        rec.log(path, line, static=True, strict=True)
        if not len(iterations):
            continue

        columns = rr.Scalars.columns(scalars=values)
        timeline = rr.TimeColumn("iteration", sequence=iterations)
        rec.send_columns(path, [timeline], columns, strict=True)
        bars = rr.BarChart(values, abscissa=iterations, color=style.accent)
        rec.log(entity_path(("bars", title)), bars, static=True, strict=True)


def history_bars(history: Sequence[HistoryRow]) -> rrb.Tabs:
    """Return a tab with bars for each series; they are static and do not depend on the timeline.

    Args:
        history: The history.
    """
    views = []
    for title in _filled_series(history):
        view = rrb.BarChartView(
            origin=entity_path(("bars", title)),
            name=f"{title} by iteration",
            plot_legend=rrb.PlotLegend(visible=False),
        )
        views.append(view)
    return rrb.Tabs(*views, active_tab=0, name="optimiser")


def history_lines(history: Sequence[HistoryRow]) -> list[rrb.View]:
    """Return a view of each series as a line; it is visible on the timeline `iteration` only.

    Args:
        history: The history.
    """
    titles = _filled_series(history)
    return [series_view(("history", title), title, legend=False) for title in titles]


def _filled_series(history: Sequence[HistoryRow]) -> list[str]:
    """Return the titles of the series that have values."""
    series = history_series(history)
    return [title for title, (iterations, _) in series.items() if len(iterations)]
