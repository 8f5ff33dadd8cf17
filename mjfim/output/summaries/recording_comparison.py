"""The comparison of recordings in words and tables."""

from __future__ import annotations

import numpy as np

from mjfim.output.summary_parts import (
    Emphasis,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    SummaryTable,
    columns,
)
from mjfim.records.estimate import Estimate
from mjfim.records.robots import RecordingComparison, p_text

# Headings of the table of the scatter.
BETWEEN = "σ between"
SHARE = "I²"
P_VALUE = "p"

# Largest number of rows of the table with the values of single recordings.
MAX_VALUES = 60

# Advice where the recordings differ although the model does not explain them either.
MODEL_OR_RECORDING = (
    "The model does not explain the recordings: its error acts differently along different "
    "motions, and this alone can make recordings differ."
)


def describe_recordings(estimate: Estimate) -> list[Part]:
    """Describe whether recordings agree, their scatter, and what each of them suggests.

    Args:
        estimate: The estimate; with a single recording, there is nothing to describe.
    """
    comparison = estimate.recording_comparison
    if comparison is None:
        return []

    # An odd recording is a warning already.
    differs = bool(comparison.odd or comparison.apart)
    in_short_form = differs and not comparison.odd
    emphasis = Emphasis.WARNING if differs else Emphasis.NORMAL
    text = str(comparison)
    parts: list[Part] = [Paragraph(text=text, emphasis=emphasis, detail=not in_short_form)]
    if differs and estimate.misfit:
        parts.append(Paragraph(text=MODEL_OR_RECORDING, emphasis=Emphasis.WEAK, detail=True))
    return [*parts, _scatter_table(comparison), _value_table(comparison)]


def _scatter_table(comparison: RecordingComparison) -> SummaryTable:
    """Tabulate means over the recordings, and the scatter between them."""
    rows = []
    for j, name in enumerate(comparison.parameters):
        low, high = comparison.interval[j]
        new_low, new_high = comparison.prediction[j]
        is_apart = j in comparison.apart
        is_stated = bool(comparison.is_stated[j])
        cells = (
            Name(name=name, unit=comparison.units[j]),
            Quantity(value=float(comparison.mean[j]), digits=4),
            Quantity(value=float(low), digits=4),
            Quantity(value=float(high), digits=4),
            Quantity(value=float(comparison.tau[j]), digits=2),
            Quantity(value=100.0 * float(comparison.share[j]), digits=2, suffix=" %"),
            Quantity(value=float(new_low) if np.isfinite(new_low) else np.nan, digits=4),
            Quantity(value=float(new_high) if np.isfinite(new_high) else np.nan, digits=4),
            "stated" if is_stated else p_text(comparison.p[j]).removeprefix("p = "),
        )
        rows.append(Row(cells=cells, emphasis=Emphasis.WARNING if is_apart else Emphasis.NORMAL))

    return SummaryTable(
        key="recordings",
        title="Means over the recordings, and another recording",
        columns=columns(
            "parameter",
            "mean",
            "95 % low",
            "high",
            BETWEEN,
            SHARE,
            "new low",
            "new high",
            P_VALUE,
            optional=["95 % low", "high", SHARE, "new low", "new high"],
        ),
        rows=tuple(rows),
        note=(
            "σ between: standard deviation between recordings beyond their noise; I²: its share of "
            "the scatter; new: 95 % interval of what another recording would suggest; p: "
            "probability of a scatter as large if all recordings had the same value, corrected for "
            "the number of parameters."
        ),
        detail=True,
    )


def _value_table(comparison: RecordingComparison) -> SummaryTable:
    """Tabulate what each recording suggests alone; of many, the parameters that differ most."""
    count = len(comparison.recordings)
    shown = comparison.order[: max(MAX_VALUES // count, 1)]
    odd = {recording.index for recording in comparison.odd}
    rows = tuple(
        Row(
            cells=(
                comparison.recordings[k],
                Name(name=comparison.parameters[j], unit=comparison.units[j]),
                Quantity(value=float(comparison.values[k, j]), digits=4),
                Quantity(value=float(comparison.std[k, j]), digits=2, infinite="-"),
                "odd" if k in odd else "",
            ),
            emphasis=Emphasis.WARNING if k in odd else Emphasis.NORMAL,
        )
        for j in shown
        for k in range(count)
    )
    note = "Each value is one Gauss-Newton step away from the estimate of all recordings."
    if len(shown) < len(comparison.parameters):
        note += (
            f" Shown: {len(shown)} of {len(comparison.parameters)} parameters, those that differ "
            "most."
        )
    return SummaryTable(
        key="values of recordings",
        title="What each recording suggests alone",
        columns=columns("recording", "parameter", "value", "σ", "", left=["parameter", ""]),
        rows=rows,
        note=note,
        detail=True,
    )
