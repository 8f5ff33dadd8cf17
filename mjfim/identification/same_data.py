"""Search for recordings that hold the same data, which would count twice."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from mjfim.errors import RecordingError
from mjfim.records.recording import Recording

# Largest difference of two clocks that count as the same [mean sample periods]. Copies of a log in
# other formats have rounded times.
CLOCK_TOLERANCE = 0.01


def refuse_same_data(fitted: Sequence[Recording], held_out: Sequence[Recording]) -> None:
    """Refuse a recording that occurs twice among the fitted and the held-out ones.

    The contents are compared, because a copy of a file has another name.

    Args:
        fitted: Recordings to which the parameters are fitted.
        held_out: Recordings that are predicted.

    Raises:
        RecordingError: Two recordings hold the same data.
    """
    recordings = [*fitted, *held_out]

    for (i, one), (j, other) in combinations(enumerate(recordings), 2):
        if not _same_data(one, other):
            continue

        if i < len(fitted) <= j:
            consequence = "a fitted recording says nothing about predictions; hold out another one"
        else:
            consequence = "it would count twice; give it once"

        fault = f"{other.name} holds the same data as {one.name}"
        if one.name == other.name:
            fault = f"{one.name} is given twice"
        raise RecordingError(f"{fault}: {consequence}")


def _same_data(one: Recording, other: Recording) -> bool:
    """Whether two recordings have equal outputs, controls and measurements at the same times."""
    if one is other:
        return True
    shapes = (one.t.shape, one.y.shape)
    if one.outputs != other.outputs or shapes != (other.t.shape, other.y.shape):
        return False

    # Different recordings usually differ in their first row, so that most pairs end here.
    if not np.array_equal(one.y[:1], other.y[:1], equal_nan=True):
        return False

    same_values = np.array_equal(one.ctrl, other.ctrl, equal_nan=True)
    same_values = same_values and np.array_equal(one.y, other.y, equal_nan=True)
    if not same_values or not len(one.t):
        return bool(same_values)

    difference = (one.t - one.t[0]) - (other.t - other.t[0])
    period = (one.t[-1] - one.t[0]) / len(one.t)
    return bool(np.abs(difference).max() <= CLOCK_TOLERANCE * period)
