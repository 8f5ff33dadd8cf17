"""Plots of series in Rerun whose range of values is chosen from what is drawn in them.

A plot may have curves over simulated time and curves over the iterations of a search. The viewer
draws those of the timeline that is shown. Limits are drawn on both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.output.rerun.scene import EntityParts, entity_path, time_column

# Width of curves, and size of dots [points].
LINE_WIDTH, DOT_SIZE = 2.0, 1.0

# Share of the range of values that is left free above and below the curves.
MARGIN = 0.08

# The range of a plot reaches to the limits if it is then at most this many times as large.
LARGEST_ZOOM = 6.0

# Width and colour (0..255) of lines of limits.
LIMIT_WIDTH, LIMIT_COLOUR = 1.2, (150, 150, 150)

# Width of the edges of a band, as a share of the width of a curve.
EDGE_WIDTH = 0.5

# Range of values of a plot, or of a limited quantity; infinite without a bound.
Range = tuple[float, float]
NO_LIMITS: Range = (-np.inf, np.inf)

Timeline = Literal["sim_time", "iteration"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A series, or several that belong together such as the two edges of a band.

    Attributes:
        name: Name of its entity, and in the legend.
        t: (n,) times [s], or numbers of iterations.
        values: (n,) or (n, m) values of m series; rows that are not finite are left out.
        colour: Colour (0..255).
        look: A line, a line of steps held from each sample to the next, dots, or the thin edges of
            a band.
        timeline: The timeline of `t`.
        legend: Names of the m series in the legend; by default `name`.
        width: Width of its lines relative to that of others.
    """

    name: str
    t: Array
    values: Array
    colour: tuple[int, int, int]
    look: Literal["line", "steps", "dots", "edges"] = "line"
    timeline: Timeline = "sim_time"
    legend: tuple[str, ...] = ()
    width: float = 1.0

    @property
    def rows(self) -> Array:
        """(n, m) values, also of a single series."""
        return self.values[:, None] if self.values.ndim == 1 else self.values

    @property
    def finite(self) -> Array:
        """(n,) True for the rows that are logged."""
        return np.asarray(np.isfinite(self.rows).all(axis=1))

    def log(self, rec: rr.RecordingStream, parts: EntityParts) -> None:
        """Log the curve, unless it has no finite value.

        Args:
            rec: The recording.
            parts: Entity of the plot.
        """
        finite = self.finite
        if not finite.any():
            return

        path = entity_path((*parts, self.name))
        rec.log(path, self._appearance(), static=True, strict=True)
        rows = self.rows[finite]
        columns = rr.Scalars.columns(scalars=rows.ravel()).partition([rows.shape[1]] * len(rows))
        times = times_on(self.timeline, np.asarray(self.t)[finite])
        rec.send_columns(path, [times], columns, strict=True)

    def _appearance(self) -> rr.SeriesLines | rr.SeriesPoints:
        """Colours, names and widths."""
        count = self.rows.shape[1]
        names = list(self.legend or (self.name,) * count)
        colours = [self.colour] * count
        if self.look == "dots":
            return rr.SeriesPoints(colors=colours, names=names, marker_sizes=[DOT_SIZE] * count)

        width = LINE_WIDTH * self.width * (EDGE_WIDTH if self.look == "edges" else 1.0)
        held = rr.components.InterpolationMode.StepAfter if self.look == "steps" else None
        return rr.SeriesLines(
            colors=colours, names=names, widths=[width] * count, interpolation_mode=held
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class SeriesPlot:
    """A plot of curves with their limits.

    Attributes:
        parts: Entity of the plot.
        title: Title with the unit.
        curves: The curves.
        limits: Lower and upper limit of the plotted quantity, infinite without one.
        largest_zoom: The plot reaches to the limits if its range is then at most this many times as
            large.
    """

    parts: EntityParts
    title: str
    curves: Sequence[Curve]
    limits: Range = NO_LIMITS
    largest_zoom: float = LARGEST_ZOOM

    @property
    def is_empty(self) -> bool:
        """True if no curve has a finite value."""
        return not any(curve.finite.any() for curve in self.curves)

    @property
    def range(self) -> Range:
        """The range of values that is shown; it includes a limit that is near enough."""
        values = [curve.rows[curve.finite].ravel() for curve in self.curves]
        data = np.concatenate(values) if values else np.zeros(0)
        low, high = (float(data.min()), float(data.max())) if len(data) else (np.inf, -np.inf)

        return range_with_limits(low, high, self.limits, self.largest_zoom)

    @property
    def full_title(self) -> str:
        """The title; it names the limits that are outside the plot."""
        low, high = self.range
        outside = [
            f"{limit:.3g}"
            for limit in self.limits
            if np.isfinite(limit) and not low <= limit <= high
        ]
        return f"{self.title}, limits {', '.join(outside)}" if outside else self.title

    def log(self, rec: rr.RecordingStream) -> None:
        """Log all curves, and the limits from the first to the last time of each timeline.

        Args:
            rec: The recording.
        """
        for curve in self.curves:
            curve.log(rec, self.parts)
        for word, limit in zip(("lower limit", "upper limit"), self.limits, strict=True):
            if np.isfinite(limit):
                self._log_limit(rec, word, limit)

    def view(self, *, legend: bool = False) -> rrb.TimeSeriesView:
        """Return the view of the plot.

        Args:
            legend: True to show the legend.
        """
        corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
        return rrb.TimeSeriesView(
            origin=entity_path(self.parts),
            name=self.full_title,
            plot_legend=corner,
            axis_y=rrb.ScalarAxis(range=self.range, zoom_lock=False),
        )

    def _log_limit(self, rec: rr.RecordingStream, word: str, limit: float) -> None:
        """Log a limit as a horizontal line, which the viewer does not draw for static data."""
        line = rr.SeriesLines(colors=[LIMIT_COLOUR], names=[word], widths=[LIMIT_WIDTH])
        path = entity_path((*self.parts, word))
        rec.log(path, line, static=True, strict=True)

        timelines: tuple[Timeline, ...] = ("sim_time", "iteration")
        for timeline in timelines:
            times = [np.asarray(c.t) for c in self.curves if c.timeline == timeline]
            every = np.concatenate([np.zeros(0), *times])
            if not len(every):
                continue
            ends = times_on(timeline, np.array([every.min(), every.max()]))
            columns = rr.Scalars.columns(scalars=[limit, limit])
            rec.send_columns(path, [ends], columns, strict=True)


def times_on(timeline: Timeline, t: Array) -> rr.TimeColumn:
    """Return times on a timeline.

    Args:
        timeline: The timeline.
        t: (n,) times [s], or numbers of iterations.
    """
    if timeline == "sim_time":
        return time_column(t)
    return rr.TimeColumn("iteration", sequence=np.rint(t).astype(np.int64))


def range_with_limits(
    low: float, high: float, limits: Range, largest_zoom: float = LARGEST_ZOOM
) -> Range:
    """Return the range of a plot, which includes the limits if they are near enough.

    Args:
        low: Smallest value; infinite without any.
        high: Largest value.
        limits: Lower and upper limit, infinite without one.
        largest_zoom: See `SeriesPlot`.
    """
    finite_limits = [limit for limit in limits if np.isfinite(limit)]
    whole_low, whole_high = min([low, *finite_limits]), max([high, *finite_limits])
    if not high > low or whole_high - whole_low <= largest_zoom * (high - low):
        return padded(whole_low, whole_high)
    return padded(low, high)


def padded(low: float, high: float) -> Range:
    """Return a range with a margin, also around a constant and where there is nothing.

    Args:
        low: Smallest value; infinite without any.
        high: Largest value.
    """
    if not (np.isfinite(low) and np.isfinite(high)):
        return -1.0, 1.0
    span = high - low

    # Round-off of a constant is not magnified.
    size = max(abs(low), abs(high))
    if span <= 1e-9 * size or not span:
        half = 0.5 * size or 1.0
        return low - half, high + half
    return low - MARGIN * span, high + MARGIN * span


def views_of(plots: Sequence[SeriesPlot]) -> list[rrb.View]:
    """Return the views of plots that are not empty; the first one has a legend.

    Args:
        plots: The plots.
    """
    filled = [plot for plot in plots if not plot.is_empty]
    return [plot.view(legend=k == 0) for k, plot in enumerate(filled)]
