"""Plots of series in Rerun whose range of values is chosen from what is drawn in them.

A plot may have curves over simulated time and curves over the iterations of a search. The viewer
draws those of the timeline that is shown. Limits are drawn on both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.output.rerun.panels import pages_of, plot_size
from mjfim.output.rerun.scene import EntityParts, entity_path, time_column

# Width of curves, and size of dots [points].
LINE_WIDTH, DOT_SIZE = 2.0, 1.0

# Share of the range of values that is left free above and below the curves.
MARGIN = 0.08

# The range of a plot reaches to the limits if it is then at most this many times as large.
LARGEST_ZOOM = 6.0

# Width and colour (0..255) of lines of limits, and their name in the legend.
LIMIT_WIDTH, LIMIT_COLOUR, LIMIT_NAME = 1.2, (150, 150, 150), "limit"

# Width of the edges of a band, as a share of the width of a curve.
EDGE_WIDTH = 0.5

# Width and height of the smallest plot in a window of 1280 x 800 pixels, without its title and the
# numbers beside its axes [points].
LEAST_WIDTH, LEAST_HEIGHT = 345.0, 176.0

# The viewer writes multiples of a power of ten that are at least this far from each other [points].
NUMBER_SPACING = 20.0

# A range is widened for a second number beside its axis at most by this factor.
LARGEST_WIDENING = 1.4

# Height of the numbers below a plot [points].
NUMBERS_BELOW = 20.0

# Width of the numbers beside a plot [points].
NUMBERS_BESIDE = 40.0

# Free space behind the last sample, as a share of the time, in which the last number of the axis
# has room, and largest free space for a legend: the motion rests while it is played.
TIME_ROOM, MOST_ROOM = 0.05, 0.35

# Width of a legend beside its names, of a character, and of its height per name and beside them
# [points].
LEGEND_ROOM, CHARACTER_WIDTH, LEGEND_ROW, LEGEND_EDGE = 36.0, 7.0, 23.0, 14.0

# Largest number of samples of a curve that decide where the legend stands.
LEGEND_SAMPLES = 400

# Corners in which a legend may stand, the usual one first, with the place of each: right and top.
CORNERS = {
    rrb.Corner2D.LeftTop: (False, True),
    rrb.Corner2D.RightTop: (True, True),
    rrb.Corner2D.LeftBottom: (False, False),
    rrb.Corner2D.RightBottom: (True, False),
}

# Range of values of a plot, or of a limited quantity; infinite without a bound.
Range = tuple[float, float]
NO_LIMITS: Range = (-np.inf, np.inf)

# Entity of the samples without a value behind the last one.
ROOM = "room"

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
        sets_range: False where the range of the plot is chosen without it.
    """

    name: str
    t: Array
    values: Array
    colour: tuple[int, int, int]
    look: Literal["line", "steps", "dots", "edges"] = "line"
    timeline: Timeline = "sim_time"
    legend: tuple[str, ...] = ()
    width: float = 1.0
    sets_range: bool = True

    @property
    def rows(self) -> Array:
        """(n, m) values, also of a single series."""
        return self.values[:, None] if self.values.ndim == 1 else self.values

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the m series in the legend."""
        return self.legend or (self.name,) * self.rows.shape[1]

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
        names = list(self.names)
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
        own_legend: True for a plot whose names are not those of the plots beside it.
        room: Free space behind the last sample, as a share of the time.
        height: Height of the plot without its title in a window of 1280 x 800 pixels [points].
    """

    parts: EntityParts
    title: str
    curves: Sequence[Curve]
    limits: Range = NO_LIMITS
    largest_zoom: float = LARGEST_ZOOM
    own_legend: bool = False
    room: float = TIME_ROOM
    height: float = LEAST_HEIGHT

    @property
    def is_empty(self) -> bool:
        """True if no curve has a finite value."""
        return not any(curve.finite.any() for curve in self.curves)

    @property
    def range(self) -> Range:
        """The range of values that is shown; it includes a limit that is near enough."""
        values = [curve.rows[curve.finite].ravel() for curve in self.curves if curve.sets_range]
        data = np.concatenate(values) if values else np.zeros(0)
        low, high = (float(data.min()), float(data.max())) if len(data) else (np.inf, -np.inf)

        shown = range_with_limits(low, high, self.limits, self.largest_zoom)
        return with_two_numbers(*shown, self.height)

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

    def with_height(self, height: float) -> SeriesPlot:
        """Return the plot with a height below its title, numbers included [points].

        Args:
            height: The height.
        """
        return replace(self, height=height - NUMBERS_BELOW)

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
        self._log_room(rec)

    def view(self, *, legend: bool = False) -> rrb.TimeSeriesView:
        """Return the view of the plot.

        Args:
            legend: True to show the legend.
        """
        corner = rrb.PlotLegend(self.emptiest_corner, visible=legend)
        return rrb.TimeSeriesView(
            origin=entity_path(self.parts),
            name=self.full_title,
            plot_legend=corner,
            axis_y=rrb.ScalarAxis(range=self.range, zoom_lock=False),
        )

    @property
    def emptiest_corner(self) -> rrb.Corner2D:
        """The corner in which a legend covers the fewest samples of the curves over time."""
        curves = [curve for curve in self.curves if curve.timeline == "sim_time"]
        width = self.legend_width / LEAST_WIDTH
        height = (LEGEND_EDGE + LEGEND_ROW * len(self._names)) / self.height

        # (n, 2) samples as shares of the width and the height of the plot.
        samples = np.concatenate([np.zeros((0, 2)), *map(self._as_shares, curves)])
        covered = {}
        for corner, (is_right, is_top) in CORNERS.items():
            across = 1.0 - samples[:, 0] if is_right else samples[:, 0]
            up = 1.0 - samples[:, 1] if is_top else samples[:, 1]
            covered[corner] = int(np.count_nonzero((across < width) & (up < height)))
        return min(covered, key=lambda corner: covered[corner])

    @property
    def legend_width(self) -> float:
        """Width of the legend [points]."""
        return LEGEND_ROOM + CHARACTER_WIDTH * max(map(len, self._names), default=0)

    @property
    def _names(self) -> set[str]:
        """Names in the legend of the curves over time."""
        curves = [curve for curve in self.curves if curve.timeline == "sim_time"]
        names = {name for curve in curves if curve.finite.any() for name in curve.names}
        return names | {LIMIT_NAME for limit in self.limits if np.isfinite(limit)}

    @property
    def _times(self) -> tuple[float, float]:
        """First and last time of the curves over time [s]."""
        times = [
            np.asarray(curve.t)[curve.finite]
            for curve in self.curves
            if curve.timeline == "sim_time" and curve.finite.any()
        ]
        every = np.concatenate(times) if times else np.zeros(1)
        return float(every.min()), float(every.max())

    def _as_shares(self, curve: Curve) -> Array:
        """Samples of a curve as shares of the width and the height of the plot, (n, 2)."""
        rows = np.flatnonzero(curve.finite)
        rows = rows[evenly_spread_indices(len(rows), LEGEND_SAMPLES)] if len(rows) else rows
        t, values = np.asarray(curve.t, dtype=np.float64)[rows], curve.rows[rows]
        if not len(t):
            return np.zeros((0, 2))

        low, high = self.range
        first, last = self._times
        across = (t - first) / ((1.0 + self.room) * (last - first) or 1.0)
        up = (values - low) / (high - low)
        return np.column_stack([np.repeat(across, up.shape[1]), up.ravel()])

    def _log_room(self, rec: rr.RecordingStream) -> None:
        """Log two samples without a value, which make room behind the last one.

        They have the name and the colour of a curve, so that the legend does not show them.
        """
        curves = [
            curve
            for curve in self.curves
            if curve.timeline == "sim_time" and curve.look != "dots" and curve.finite.any()
        ]
        if not curves:
            return

        first, last = self._times
        path = entity_path((*self.parts, ROOM))
        line = rr.SeriesLines(colors=[curves[0].colour], names=[curves[0].names[0]])
        rec.log(path, line, static=True, strict=True)
        times = times_on("sim_time", np.array([last, last + self.room * (last - first)]))
        nothing = rr.Scalars.columns(scalars=[np.nan, np.nan])
        rec.send_columns(path, [times], nothing, strict=True)

    def _log_limit(self, rec: rr.RecordingStream, word: str, limit: float) -> None:
        """Log a limit as a horizontal line, which the viewer does not draw for static data."""
        line = rr.SeriesLines(colors=[LIMIT_COLOUR], names=[LIMIT_NAME], widths=[LIMIT_WIDTH])
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


def with_two_numbers(low: float, high: float, height: float) -> Range:
    """Widen a range a little if the viewer then writes at least two numbers beside the axis.

    The viewer writes multiples of a power of ten, as many as have room in a plot.

    Args:
        low: Lower end of the range.
        high: Upper end of the range.
        height: Height of the plot [points].
    """
    smallest = (high - low) * NUMBER_SPACING / height
    step = 10.0 ** np.ceil(np.log10(smallest))
    first, last = np.ceil(low / step), np.floor(high / step)
    if last - first >= 1.0:
        return low, high

    # Without any number there is one below and one above; beside a single one, the nearer end of
    # the range moves on to the next.
    edge = 0.5 * MARGIN * (high - low)
    if last < first:
        wide = (float(last * step - edge), float(first * step + edge))
    elif high - last * step >= first * step - low:
        wide = (low, float((last + 1.0) * step + edge))
    else:
        wide = (float((first - 1.0) * step - edge), high)
    return wide if wide[1] - wide[0] <= LARGEST_WIDENING * (high - low) else (low, high)


def with_room_for_legends(plots: Sequence[SeriesPlot]) -> list[SeriesPlot]:
    """Return plots whose legends stand behind the last sample, all with the same axis of time.

    Args:
        plots: All plots of a tab, each with a legend of its own.
    """
    shares = [
        plot.legend_width / (plot_size(len(plots), k)[0] - NUMBERS_BESIDE)
        for k, plot in enumerate(plots)
    ]
    share = max(shares, default=0.0)
    room = min(max(share / (1.0 - share) if share < 1.0 else MOST_ROOM, TIME_ROOM), MOST_ROOM)
    return [replace(plot, room=room) for plot in plots]


def views_of(plots: Sequence[SeriesPlot]) -> list[rrb.View]:
    """Return the views of plots that are not empty; the first one of each page has a legend.

    Args:
        plots: The plots.
    """
    filled = [plot for plot in plots if not plot.is_empty]
    first = {page.start for page in pages_of(len(filled))}
    views: list[rrb.View] = []
    for k, plot in enumerate(filled):
        sized = plot.with_height(plot_size(len(filled), k)[1])
        views.append(sized.view(legend=plot.own_legend or k in first))
    return views
