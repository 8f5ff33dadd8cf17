"""Plots that are drawn as 2D lines, so that the viewer shows them on every timeline.

The axes are drawn as well, because a 2D view of Rerun has none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.output.rerun.scene import EntityParts, entity_path
from mjfim.output.rerun.series import LIMIT_COLOUR, NO_LIMITS, Range

# Space for the numbers on the left, free space on the right and at the top, and space for the
# numbers at the bottom [points].
LEFT, RIGHT, TOP, BOTTOM = 58.0, 20.0, 26.0, 34.0

# Colours (0..255) of axes and of the numbers beside them.
AXIS_COLOUR, NUMBER_COLOUR = (110, 110, 110), (205, 205, 205)

# Thickness of axes, limits and curves [points].
AXIS_THICKNESS, LIMIT_THICKNESS, CURVE_THICKNESS = 0.5, 0.6, 1.0

# Width and height of a number beside an axis, with free space around it [points].
NUMBER_WIDTH, NUMBER_HEIGHT = 70.0, 30.0

# Smallest and largest of the largest numbers of numbers beside an axis. With four of them, every
# range has at least two.
LEAST_NUMBERS, MOST_NUMBERS = 4, 8

# Sizes of the steps between the numbers, times a power of ten.
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0, 20.0, 25.0, 50.0)

# Width of the name of a curve in the legend [points].
NAME_WIDTH = 64.0

# Shift of the numbers away from the axes [points].
SHIFT_LEFT, SHIFT_DOWN = 28.0, 8.0

# Length of the line that stands for a curve with a single point [points].
SINGLE_POINT = 6.0


@dataclass(frozen=True, kw_only=True)
class StripPlot:
    """Axes of a plot of 2D lines.

    Plot coordinates are points of the screen in a window of 1280 x 800 pixels; Rerun's y axis
    points downwards.

    Attributes:
        parts: Entity of the plot.
        title: Title, which names both axes with their units.
        x: Range of the horizontal axis.
        y: Range of the vertical axis.
        size: Width and height of the whole plot [points].
        logarithmic: True if the values are logarithms to base 10; the numbers beside the axis are
            those of which they are logarithms.
        counts: True if the horizontal axis counts something, so that its numbers are whole.
    """

    parts: EntityParts
    title: str
    x: Range
    y: Range
    size: tuple[float, float]
    logarithmic: bool = False
    counts: bool = False

    @property
    def width(self) -> float:
        """Length of the horizontal axis [points]."""
        return self.size[0] - LEFT - RIGHT

    @property
    def height(self) -> float:
        """Length of the vertical axis [points]."""
        return self.size[1] - TOP - BOTTOM

    def points(self, x: Array, y: Array) -> Array:
        """Return the finite points of a curve in plot coordinates, (n, 2).

        Args:
            x: (n,) horizontal values.
            y: (n,) vertical values.
        """
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        points = np.column_stack([self.width * across, self.height * (1.0 - up)])
        return np.asarray(points[np.isfinite(points).all(axis=1)])

    def curve(
        self, x: Array, y: Array, colour: Sequence[int], width: float = 1.0
    ) -> rr.AsComponents:
        """Return a curve; a single point becomes a short line.

        Args:
            x: (n,) horizontal values.
            y: (n,) vertical values.
            colour: Colour (0..255).
            width: Thickness relative to that of other curves.
        """
        points = self.points(x, y)
        if len(points) == 1:
            points = points + np.array([[0.0, 0.0], [SINGLE_POINT, 0.0]])
        radius = rr.Radius.ui_points(width * CURVE_THICKNESS)
        return rr.LineStrips2D([points], colors=[colour], radii=radius)

    def upright(self, x: float, colour: Sequence[int]) -> rr.AsComponents:
        """Return a vertical line through the whole plot.

        Args:
            x: Its place.
            colour: Colour (0..255).
        """
        return self.curve(np.array([x, x]), np.array(self.y), colour)

    def log_axes(
        self, rec: rr.RecordingStream, limits: Range = NO_LIMITS, *, static: bool = True
    ) -> None:
        """Log the axes with their numbers, and the limits as lines.

        Args:
            rec: The recording.
            limits: Lower and upper limit of the plotted quantity; those outside the plot, and
                infinite ones, are not drawn.
            static: False for axes that change, which are logged at the time that is set.
        """
        frame = [[(0.0, 0.0), (0.0, self.height), (self.width, self.height)]]
        axes = rr.LineStrips2D(
            frame, colors=[AXIS_COLOUR], radii=rr.Radius.ui_points(AXIS_THICKNESS)
        )
        rec.log(entity_path((*self.parts, "axes")), axes, static=static, strict=True)
        self._log_numbers(rec, static=static)

        shown = [limit for limit in limits if self.y[0] <= limit <= self.y[1]]
        if shown:
            lines = [self.points(np.array(self.x), np.full(2, limit)) for limit in shown]
            strips = rr.LineStrips2D(
                lines,
                colors=[LIMIT_COLOUR] * len(lines),
                radii=rr.Radius.ui_points(LIMIT_THICKNESS),
            )
            rec.log(entity_path((*self.parts, "limits")), strips, static=static, strict=True)

    def log_legend(self, rec: rr.RecordingStream, colours: Mapping[str, Sequence[int]]) -> None:
        """Log the names of curves at the top right, each in its colour.

        Args:
            rec: The recording.
            colours: Colour (0..255) of each curve by name.
        """
        count = len(colours)
        across = self.width - NAME_WIDTH * (np.arange(count)[::-1] + 0.5)
        names = rr.Points2D(
            np.column_stack([across, np.full(count, -TOP)]),
            labels=list(colours),
            colors=list(colours.values()),
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )
        rec.log(entity_path((*self.parts, "legend")), names, static=True, strict=True)

    def view(self) -> rrb.Spatial2DView:
        """Return the view of the plot."""
        return rrb.Spatial2DView(
            origin=entity_path(self.parts),
            name=self.title,
            visual_bounds=rrb.VisualBounds2D(
                x_range=(-LEFT, self.width + RIGHT), y_range=(-TOP, self.height + BOTTOM)
            ),
        )

    def _log_numbers(self, rec: rr.RecordingStream, *, static: bool) -> None:
        """Log the numbers beside the axes."""
        across = round_numbers(*self.x, _count(self.width, NUMBER_WIDTH))
        if self.counts:
            across = across[across == np.rint(across)]
        rounded = round_logarithms if self.logarithmic else round_numbers
        up = rounded(*self.y, _count(self.height, NUMBER_HEIGHT))
        below = self.points(across, np.full(len(across), self.y[0]))
        beside = self.points(np.full(len(up), self.x[0]), up)

        # The viewer writes a number below its point.
        below[:, 1] += SHIFT_DOWN
        beside -= (SHIFT_LEFT, 2.0 * SHIFT_DOWN)

        texts = [f"{value:.6g}" for value in across]
        texts += [f"{10.0**value if self.logarithmic else value:.6g}" for value in up]
        places = np.concatenate([below, beside])
        numbers = rr.Points2D(
            places,
            labels=texts,
            colors=[NUMBER_COLOUR] * len(places),
            radii=rr.Radius.ui_points(0.0),
            show_labels=True,
        )
        rec.log(entity_path((*self.parts, "numbers")), numbers, static=static, strict=True)


def _count(length: float, room: float) -> int:
    """Largest number of numbers beside an axis of a length, each of which needs room [points]."""
    return int(np.clip(length // room, LEAST_NUMBERS, MOST_NUMBERS))


def round_numbers(low: float, high: float, most: int) -> Array:
    """Return round numbers in a range, as many as are permitted.

    Args:
        low: Lower end of the range.
        high: Upper end of the range.
        most: Largest number of them.
    """
    power = 10.0 ** np.floor(np.log10((high - low) / most))
    for size in STEPS:
        step = size * power
        first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
        if last - first < most:
            break
    numbers = step * np.arange(first, last + 1.0)

    # Round-off at zero is not shown.
    return np.where(np.abs(numbers) < 1e-9 * step, 0.0, numbers)


def round_logarithms(low: float, high: float, most: int) -> Array:
    """Return logarithms to base 10 of round numbers in a range of logarithms.

    Args:
        low: Lower end of the range.
        high: Upper end of the range.
        most: Largest number of them.
    """
    decades = np.arange(np.floor(low), np.ceil(high) + 1.0)
    for sizes in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
        numbers = np.add.outer(decades, np.log10(sizes)).ravel()
        numbers = numbers[(numbers >= low) & (numbers <= high)]
        if 2 <= len(numbers) <= most:
            return np.asarray(numbers)

    # Over many decades only some have a number; within a small part of one, any number has.
    steps = np.unique(np.rint(round_numbers(low, high, most)))
    steps = steps[(steps >= low) & (steps <= high)]
    return np.asarray(steps) if len(steps) >= 2 else round_numbers(low, high, most)
