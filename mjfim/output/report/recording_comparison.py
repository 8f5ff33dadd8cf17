"""The section of a report on the comparison of recordings."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import NORMAL_95
from mjfim.output.report.curves import (
    axis,
    band,
    dots,
    error_bars,
    level,
    row_axis,
    rows_height,
)
from mjfim.output.report.page import Key, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.recording_comparison import describe_recordings
from mjfim.output.vocabulary import DESIGNED, IDENTIFIED, MEASURED
from mjfim.records.estimate import Estimate
from mjfim.records.labels import with_unit
from mjfim.records.robots import RecordingComparison

# Largest number of parameters with a plot; of more, those that differ most.
MAX_PANELS = 24

# Names in the legend.
ONE, ODD = "one recording, 95 % interval", "odd recording"


def recordings_section(estimate: Estimate) -> Section:
    """Return the comparison of the recordings in words, in tables and as plots.

    Args:
        estimate: An estimate from several recordings.
    """
    comparison = estimate.recording_comparison
    assert comparison is not None
    shown = comparison.order[:MAX_PANELS].tolist()
    shown = [j for j in shown if np.isfinite(comparison.values[:, j]).any()]
    keys = [Key(name=ONE, role=MEASURED.word)]
    if comparison.odd:
        keys.append(Key(name=ODD, role=DESIGNED.word))
    note = "The line and the strip are the mean and its 95 % interval."
    if len(shown) < len(comparison.parameters):
        note += (
            f" Shown: {len(shown)} of {len(comparison.parameters)} parameters, those that differ "
            "most."
        )
    group = PlotGroup(title="", panels=[_panel(comparison, j) for j in shown], keys=keys, note=note)
    parts = [*describe_recordings(estimate), *([group] if shown else [])]
    return Section(title="Recordings", parts=parts)


def _panel(comparison: RecordingComparison, j: int) -> Panel:
    """Return the plot of one parameter, a row for each recording."""
    odd = {recording.index for recording in comparison.odd}
    everyone = range(len(comparison.recordings))
    groups = {
        (ONE, MEASURED.word): [k for k in everyone if k not in odd],
        (ODD, DESIGNED.word): [k for k in everyone if k in odd],
    }
    traces = [
        _intervals(comparison, j, members, name, role)
        for (name, role), members in groups.items()
        if members
    ]
    mean = float(comparison.mean[j])
    shapes: list[Plotly] = []
    if np.isfinite(mean):
        low, high = (float(end) for end in comparison.interval[j])
        shapes = [
            band(low, high, across="y"),
            level(mean, IDENTIFIED.word, across="y", dash="solid", layer="below"),
        ]
    label = with_unit(comparison.parameters[j], comparison.units[j])
    return Panel(
        title=label if comparison.units[j] else f"{label} [–]",
        traces=traces,
        layout={
            "xaxis": axis(label),
            "yaxis": row_axis(comparison.recordings),
            "shapes": shapes,
            "hovermode": "closest",
        },
        height=rows_height(len(comparison.recordings), 30),
        narrow=True,
    )


def _intervals(
    comparison: RecordingComparison, j: int, members: list[int], name: str, role: str
) -> Plotly:
    """Return the values of some recordings with their intervals."""
    values, reach = comparison.values[members, j], NORMAL_95 * comparison.std[members, j]
    texts = [
        f"{comparison.recordings[k]}: {value:.4g} ± {width:.2g} {comparison.units[j]}".rstrip()
        for k, value, width in zip(members, values, reach, strict=True)
    ]
    trace = dots(values, np.array(members, dtype=float), name, role, size=8, texts=texts)
    trace["error_x"] = error_bars(role, reach)
    return trace
