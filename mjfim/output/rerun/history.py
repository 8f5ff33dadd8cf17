"""History of a search in Rerun, as 2D plots that are visible on every timeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.rerun.panels import plot_size
from mjfim.output.rerun.scene import entity_path
from mjfim.output.rerun.series import padded
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.output.rerun.strips import StripPlot
from mjfim.records.design import HistoryRow

# Numbers of iterations and values of one quantity, both (n,).
Series = tuple[NDArray[np.int64], Array]

# Colour (0..255) of the line at the iteration that is shown.
NOW_COLOUR = (205, 205, 205)

# How the title of a series begins whose values are logarithms.
LOGARITHM = "log10 "


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
            series[f"{LOGARITHM}{title}"] = (iterations[usable], np.log10(kept))
        else:
            series[title] = (iterations[usable], kept)

    known = np.isfinite(step)
    series["step length"] = (iterations[known], step[known])
    return series


@dataclass(frozen=True, kw_only=True, eq=False)
class HistoryPlot:
    """Plot of one quantity over the iterations, with a line at the iteration that is shown.

    Attributes:
        iterations: (n,) numbers of iterations.
        values: (n,) values.
        plot: The axes.
        style: Style with the colour of the curve.
    """

    iterations: NDArray[np.int64]
    values: Array
    plot: StripPlot
    style: RobotStyle

    def log(self, rec: rr.RecordingStream) -> None:
        """Log axes, curve and line.

        Args:
            rec: The recording.
        """
        self.plot.log_axes(rec)
        curve = self.plot.curve(self.iterations.astype(np.float64), self.values, self.style.accent)
        rec.log(entity_path((*self.plot.parts, "curve")), curve, static=True, strict=True)

        path = entity_path((*self.plot.parts, "now"))
        for iteration in self.iterations.tolist():
            rec.set_time("iteration", sequence=iteration)
            rec.log(path, self.plot.upright(iteration, NOW_COLOUR), strict=True)
        rec.reset_time()


def history_plots(
    history: Sequence[HistoryRow], styles: Sequence[RobotStyle], start: str
) -> list[HistoryPlot]:
    """Return a plot of each quantity that has values.

    Args:
        history: The history.
        styles: Style of each quantity.
        start: Name of the initial control from which the search came.
    """
    filled = {title: each for title, each in history_series(history).items() if len(each[0])}
    last = max((row.iteration for row in history), default=0)
    plots = []
    for (title, (iterations, values)), style in zip(filled.items(), styles, strict=False):
        name = title.removeprefix(LOGARITHM)
        origin = f" (start: {start})" if name == "cost" else ""
        plot = StripPlot(
            parts=("history", title),
            title=f"{name} over iterations{origin}",
            x=(0.0, float(max(last, 1))),
            y=padded(float(values.min()), float(values.max())),
            size=plot_size(len(filled)),
            logarithmic=title.startswith(LOGARITHM),
            counts=True,
        )
        plots.append(HistoryPlot(iterations=iterations, values=values, plot=plot, style=style))
    return plots
