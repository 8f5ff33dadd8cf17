"""Figure of the comparison of recordings: what each suggests alone, and their mean."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mjfim.arrays import NORMAL_95
from mjfim.output.plots.narrow_axis import place_ticks
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    IDENTIFIED_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    SMALL_FONT,
    add_title,
    as_sentence,
    fit_text,
    format_axes,
    new_figure,
    own_style,
    panel_width,
    shorten,
    text_width,
)
from mjfim.records.estimate import Estimate
from mjfim.records.labels import with_unit
from mjfim.records.robots import RecordingComparison

# Largest number of parameters and of recordings of a figure; of more parameters, those that differ
# most are drawn.
MAX_PARAMETERS, MAX_RECORDINGS = 9, 24

# Panels side by side.
COLUMNS = 3

# Characters to which the names of recordings are shortened.
NAME_WIDTH = 16

# Distance from the mean beyond which intervals are cut off, over the median reach of the intervals.
MAX_REACH = 3.0

# Height of a row, of all else of a panel, and of all else of the figure [inch].
ROW_HEIGHT, PANEL_HEIGHT, FRAME_HEIGHT = 0.2, 0.95, 1.2

# Row of another recording, below the last recording.
NEW_GAP = 0.4


@own_style
def recording_forest(estimate: Estimate) -> Figure:
    """Draw what each recording suggests for the parameters that differ most.

    Args:
        estimate: An estimate from several recordings.
    """
    comparison = estimate.recording_comparison
    assert comparison is not None
    shown = comparison.order[:MAX_PARAMETERS]
    recordings = _shown_recordings(comparison)
    lines = -(-len(shown) // COLUMNS)

    height = lines * (PANEL_HEIGHT + ROW_HEIGHT * (len(recordings) + 1)) + FRAME_HEIGHT
    figure = new_figure(height)
    grid = figure.add_gridspec(lines, min(len(shown), COLUMNS))
    for i, j in enumerate(shown):
        axes = figure.add_subplot(grid[i // COLUMNS, i % COLUMNS])
        _draw_parameter(axes, comparison, int(j), recordings, is_left=i % COLUMNS == 0)

    handles = [
        Line2D([], [], color=MEASURED_COLOUR, marker="o", label="one recording, 95 % interval"),
        Line2D([], [], color=IDENTIFIED_COLOUR, label="mean"),
        Patch(color=IDENTIFIED_COLOUR, alpha=0.2, label="95 % interval of the mean"),
    ]
    if np.isfinite(comparison.prediction[shown]).any():
        handles.append(Line2D([], [], color=MUTED_COLOUR, linewidth=3.0, label="another recording"))
    if comparison.odd:
        handles.insert(1, Line2D([], [], color=DESIGNED_COLOUR, marker="o", label="odd recording"))
    add_title(figure, _title(comparison), handles, _note(estimate, comparison, len(shown)))
    return figure


def _shown_recordings(comparison: RecordingComparison) -> list[int]:
    """Return the recordings to draw: of many, the odd ones and the first ones."""
    odd = [recording.index for recording in comparison.odd]
    others = [k for k in range(len(comparison.recordings)) if k not in odd]
    return sorted([*odd, *others][:MAX_RECORDINGS])


def _draw_parameter(
    axes: Axes, comparison: RecordingComparison, j: int, recordings: list[int], *, is_left: bool
) -> None:
    """Draw the values of parameter j, a row for each recording."""
    odd = {recording.index for recording in comparison.odd}
    low, high = _limits(comparison, j)
    mean = float(comparison.mean[j])
    begin, end = np.clip(comparison.interval[j], low, high)
    if np.isfinite(mean):
        axes.axvspan(begin, end, color=IDENTIFIED_COLOUR, alpha=0.2, linewidth=0.0)
        axes.axvline(mean, color=IDENTIFIED_COLOUR, linewidth=1.2)

    for row, k in enumerate(recordings):
        colour = DESIGNED_COLOUR if k in odd else MEASURED_COLOUR
        value, reach = float(comparison.values[k, j]), NORMAL_95 * float(comparison.std[k, j])
        if np.isfinite(value):
            _draw_interval(axes, value, reach, row, colour, (low, high))

    # What another recording would suggest.
    count = len(recordings)
    new_row = count - 1 + NEW_GAP + 0.6
    if np.isfinite(comparison.prediction[j]).all():
        begin, end = comparison.prediction[j]
        ends = np.clip((begin, end), low, high)
        axes.plot(ends, (new_row, new_row), color=MUTED_COLOUR, linewidth=3.0)
        _mark_cut_ends(axes, begin, end, new_row, MUTED_COLOUR, (low, high))

    axes.set(xlim=(low, high), ylim=(new_row + 0.6, -0.6))
    axes.grid(False, axis="y")
    names = [shorten(comparison.recordings[k], NAME_WIDTH) for k in recordings]
    axes.set_yticks(range(count), names)
    for label, k in zip(axes.get_yticklabels(), recordings, strict=True):
        label.set_color(DESIGNED_COLOUR if k in odd else label.get_color())
    axes.tick_params(labelleft=is_left)
    middle = mean if np.isfinite(mean) else 0.5 * (low + high)
    text = place_ticks(axes.xaxis, low, high, middle, intervals=3)
    unit = f"{text.power}{comparison.units[j]}".strip()
    suffix = with_unit(text.minus_offset, unit).strip()
    suffix = f" {suffix}" if suffix else ""
    room = panel_width(COLUMNS) - text_width(suffix, SMALL_FONT)
    format_axes(axes, fit_text(comparison.parameters[j], room, SMALL_FONT) + suffix)


def _draw_interval(
    axes: Axes,
    value: float,
    reach: float,
    row: int,
    colour: str,
    limits: tuple[float, float],
) -> None:
    """Draw one value with its interval; arrows mark where the axis cuts it off."""
    low, high = limits
    ends = np.clip((value - reach, value + reach), low, high)
    axes.plot(ends, (row, row), color=colour, linewidth=1.2)
    _mark_cut_ends(axes, value - reach, value + reach, row, colour, limits)
    if low <= value <= high:
        axes.plot(value, row, "o", color=colour, markersize=4.5, zorder=3)


def _mark_cut_ends(
    axes: Axes, begin: float, end: float, row: float, colour: str, limits: tuple[float, float]
) -> None:
    """Draw an arrow where the axis cuts off the end of an interval."""
    low, high = limits
    if begin < low:
        axes.plot(low, row, "<", color=colour, markersize=5, clip_on=False)
    if end > high:
        axes.plot(high, row, ">", color=colour, markersize=5, clip_on=False)


def _limits(comparison: RecordingComparison, j: int) -> tuple[float, float]:
    """Return the range of an axis; few very wide intervals do not widen it. It is never empty."""
    values, reach = comparison.values[:, j], NORMAL_95 * comparison.std[:, j]
    known = np.isfinite(values) & np.isfinite(reach)
    if not known.any():
        return -1.0, 1.0

    values, reach = values[known], reach[known]
    usual = float(np.median(reach))
    low = float(np.min(values - np.minimum(reach, MAX_REACH * usual)))
    high = float(np.max(values + np.minimum(reach, MAX_REACH * usual)))

    # Values that differ very much would make all others one point, and are cut off as well.
    middle, spread = float(np.median(values)), float(np.median(np.abs(values - np.median(values))))
    farthest = 20.0 * max(spread, usual)
    low, high = max(low, middle - farthest), min(high, middle + farthest)
    margin = 0.05 * (high - low) or max(abs(middle), np.finfo(float).tiny) * 1e-3
    return low - margin, high + margin


def _title(comparison: RecordingComparison) -> str:
    """Return the outcome in a sentence."""
    count = len(comparison.recordings)
    if comparison.odd:
        names = ", ".join(shorten(odd.name) for odd in comparison.odd)
        noun = "is" if len(comparison.odd) == 1 else "are"
        return f"{names} {noun} odd among {count} recordings"
    if comparison.apart:
        return f"{count} recordings that differ by more than their noise"
    return f"{count} recordings that agree"


def _note(estimate: Estimate, comparison: RecordingComparison, shown: int) -> str:
    """Say where the values come from, and what is left out."""
    note = "Each value is one Gauss-Newton step away from the estimate of all recordings."
    if np.isfinite(comparison.prediction).any():
        note += " Another recording: 95 % interval of what it would suggest."
    if estimate.misfit:
        note += " " + as_sentence(
            "the model does not explain the recordings, and its error can make them differ"
        )
    if shown < len(comparison.parameters):
        note += (
            f" Shown: {shown} of {len(comparison.parameters)} parameters, those that differ most."
        )
    if len(comparison.recordings) > MAX_RECORDINGS:
        note += f" Shown: {MAX_RECORDINGS} of {len(comparison.recordings)} recordings."
    return note
