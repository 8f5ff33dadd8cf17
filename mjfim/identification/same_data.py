"""Search for recordings that hold the same data, which would count twice."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import chain, combinations

import numpy as np

from mjfim.errors import RecordingError
from mjfim.records.trajectory import Recording

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

    # Only recordings whose first rows are equal are compared pair by pair.
    groups: dict[Hashable, list[int]] = {}
    for i, recording in enumerate(recordings):
        groups.setdefault(_beginning(recording), []).append(i)

    for i, j in chain.from_iterable(combinations(group, 2) for group in groups.values()):
        one, other = recordings[i], recordings[j]
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


def _beginning(recording: Recording) -> Hashable:
    """Key that recordings with the same data share: sizes, outputs and the first row."""
    # Missing values are equal to each other and to zero here, and zero has no sign. Recordings that
    # begin alike are compared as a whole later.
    first = np.nan_to_num(recording.y[:1].ravel()) + 0.0
    return recording.t.shape, recording.y.shape, recording.outputs, tuple(first.tolist())


def _same_data(one: Recording, other: Recording) -> bool:
    """Whether two recordings that begin alike have equal values at the same times."""
    if one is other:
        return True

    same_values = np.array_equal(one.ctrl, other.ctrl, equal_nan=True)
    same_values = same_values and np.array_equal(one.y, other.y, equal_nan=True)
    if not same_values or not len(one.t):
        return bool(same_values)

    difference = (one.t - one.t[0]) - (other.t - other.t[0])
    period = (one.t[-1] - one.t[0]) / len(one.t)
    return bool(np.abs(difference).max() <= CLOCK_TOLERANCE * period)
