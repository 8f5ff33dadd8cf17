"""Search for the value of a recording that stands out most, where a fit cannot begin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.records.trajectory import Recording

# A value is extreme if it exceeds the typical magnitude of its column by this factor.
EXTREME_RATIO = 1e6


def describe_extreme_value(recordings: Sequence[Recording], controls: Sequence[str]) -> str:
    """Describe the most extreme value of the recordings.

    Args:
        recordings: Recordings in SI units.
        controls: Names of the columns of the control.

    Returns:
        A clause with recording, column, row and value; empty if no value is extreme.
    """
    worst, description = EXTREME_RATIO, ""

    for recording in recordings:
        for name, values in _columns(recording, controls):
            magnitudes = np.where(np.isfinite(values), np.abs(values), 0.0)
            present = magnitudes[magnitudes > 0.0]
            if not len(present):
                continue

            row, typical = int(np.argmax(magnitudes)), float(np.median(present))
            if magnitudes[row] > worst * typical:
                worst = float(magnitudes[row]) / typical
                description = (
                    f"{recording.name}: column {name!r} holds {values[row]:g} in row {row + 1} of "
                    f"the recording (t = {recording.t[row]:g} s), where its typical magnitude is "
                    f"{typical:.3g}"
                )
    return description


def _columns(recording: Recording, controls: Sequence[str]) -> Iterator[tuple[str, Array]]:
    """Names and values of all columns of a recording, except the time."""
    yield from zip(controls, recording.ctrl.T, strict=False)
    yield from zip(recording.outputs, recording.y.T, strict=False)
