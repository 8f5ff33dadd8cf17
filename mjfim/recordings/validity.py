"""What makes a log unusable: a clock that stands still, jumps or counts something else, holes, dead columns."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError

FEWEST = 3  # rows


SLOWEST, FASTEST = 1.0, 1e-6  # [s] median steps that a log in seconds has


TYPICAL = 5e-3  # [s] step of a log
HOLE = 5.0  # steps that are a hole
DEAD = 10  # equal values, and nothing else, of a column that measures nothing
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def check_clock(where: str, t: Array, first: int, unit: str, gap: float) -> None:
    """t: (M,) [s], as read in a unit;  first: row of the file that t begins with, from 0. Raises RecordingError."""
    if len(t) < FEWEST:
        raise RecordingError(
            f"{where}: too few rows ({len(t)}); an identification needs at least {FEWEST}"
        )
    if not np.isfinite(t).all():
        row = int(np.argmax(~np.isfinite(t)))
        raise RecordingError(
            f"{where} holds {'NaN' if np.isnan(t[row]) else 'an infinite time'} in data row {first + row + 1}"
        )
    steps = np.diff(t)
    if np.any(steps <= 0.0):
        raise RecordingError(_backwards(where, t, steps, first))
    median = float(np.median(steps))
    if not FASTEST <= median <= SLOWEST:
        raise RecordingError(
            f"{where}: the median step is {median:g} s, which is hardly one of a robot's log; "
            f'is it recording.time_unit = "{_likely(median, unit)}"?'
        )
    limit = gap_limit(t, gap)
    hole = int(np.argmax(steps))
    if steps[hole] > limit:
        raise RecordingError(
            f"{where}: a hole of {steps[hole]:g} s after data row {first + hole + 1} ({t[hole] - t[0]:g} s after the first one); "
            f"longer than {limit:g} s is not bridged: leave it out by recording.window, or raise recording.gap"
        )


def gap_limit(t: Array, gap: float) -> float:
    """Longest hole [s] that is bridged."""
    return max(gap, HOLE * float(np.median(np.diff(t))))


def _backwards(where: str, t: Array, steps: Array, first: int) -> str:
    row = int(np.argmax(steps <= 0.0))
    place = f"{where} does not increase in data row {first + row + 2}: {t[row]:.9g} s, then {t[row + 1]:.9g} s"
    if steps[row] == 0.0:
        count = int(np.sum(steps == 0.0))
        return f"{place} (a duplicate{f', one of {count}' if count > 1 else ''}); every row needs its own time"
    if t[row + 1] - t[0] < 0.1 * (t[row] - t[0]) and row + 2 < len(t):
        return f"{place} (the clock began anew, or wrapped around); cut the log there by recording.window, or in two files"
    return f"{place} (rows out of order); sort them by time"


def _likely(median: float, unit: str) -> str:
    """Unit in which the steps would be those of a usual log."""
    raw = median / SECONDS[unit]
    return min(SECONDS, key=lambda u: abs(np.log(raw * SECONDS[u] / TYPICAL)))


def check_finite(where: str, values: Array, first: int) -> None:
    """Raise RecordingError where values: (M,) hold an infinite one."""
    wrong = np.isinf(values)
    if wrong.any():
        raise RecordingError(
            f"{where} is infinite in data row {first + int(np.argmax(wrong)) + 1}; leave a field empty where there is no number"
        )


def check_measured(where: str, t: Array, values: Array, gap: float) -> None:
    """Raise RecordingError where a measured column is dead, or has holes that its own rate does not explain."""
    there = np.flatnonzero(np.isfinite(values))
    leave = "leave it out of the file or of [recording.columns]"
    if not len(there):
        raise RecordingError(f"{where} holds no number; {leave}")
    if len(there) >= DEAD and np.ptp(values[there]) == 0.0:
        raise RecordingError(
            f"{where} is {values[there[0]]:g} in all of its {len(there)} rows, a dead channel; {leave}"
        )
    limit = gap_limit(t[there], gap) if len(there) > 1 else gap
    edges = np.concatenate([t[:1], t[there], t[-1:]])
    hole = int(np.argmax(np.diff(edges)))
    if edges[hole + 1] - edges[hole] > limit:
        begin, end = edges[hole] - t[0], edges[hole + 1] - t[0]
        raise RecordingError(
            f"{where} is empty from {begin:g} to {end:g} s; longer than {limit:g} s is not bridged: "
            "leave that out by recording.window, or raise recording.gap"
        )


def held(t: Array, values: Array) -> tuple[Array, Array]:
    """A control held over its empty rows, NaN before its first value, and for how long it has been: (M,) each."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
    return values[last], t - t[last]


def check_held(where: str, t: Array, values: Array, age: Array, gap: float) -> None:
    """Raise RecordingError where a control, (M-1,) rows that count, is missing or was held for too long."""
    if np.isnan(values[0]):
        row = int(np.argmax(~np.isnan(values))) if np.isfinite(values).any() else None
        begins = "it holds no number" if row is None else f"it begins {t[row] - t[0]:g} s later"
        raise RecordingError(
            f"{where} has no value in the first row; {begins}; every control is needed from the start"
        )
    limit = gap_limit(t, gap)
    if age.max() > limit:
        end = int(np.argmax(age))
        raise RecordingError(
            f"{where} is empty for {age[end]:g} s until {t[end] - t[0]:g} s; longer than {limit:g} s is not held: "
            "leave that out by recording.window, or raise recording.gap"
        )
