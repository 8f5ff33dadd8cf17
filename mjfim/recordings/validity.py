"""Checks that refuse an unusable log.

They concern its clock, gaps in the rows, and columns without content.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError

# Smallest number of rows of a usable log.
MIN_ROWS = 3

# Shortest and longest plausible median step of a robot's log [s]. Outside this range, the unit of
# time is probably wrong.
MIN_MEDIAN_STEP = 1e-6
MAX_MEDIAN_STEP = 1.0

# Typical step of a robot's log [s], from which the unit of time is guessed.
TYPICAL_STEP = 5e-3

# A gap of up to this number of median steps is bridged, even if it is longer than `gap`.
MIN_GAP_STEPS = 5.0

# A measured column with at least this number of values, all equal, is a dead channel.
DEAD_CHANNEL_ROWS = 10

# A clock that jumps back to less than this fraction of the elapsed time has restarted. After a
# smaller jump back, the rows are out of order.
RESTART_SHARE = 0.1

# Largest number whose square is finite in float64.
LARGEST_VALUE = float(np.sqrt(np.finfo(np.float64).max))

# Seconds per unit of time.
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


def check_clock(where: str, t: Array, first: int, unit: str, gap: float) -> None:
    """Refuse times that cannot be the clock of a robot's log.

    Args:
        where: File and column, for messages.
        t: (M,) times [s].
        first: Row of the file in which `t` begins, counted from 0.
        unit: Unit of time that the experiment file states.
        gap: Longest gap that is bridged [s].

    Raises:
        RecordingError: There are too few rows, a time is missing, the times do not increase, their
            unit is probably wrong, or a gap is too long.
    """
    if len(t) < MIN_ROWS:
        raise RecordingError(
            f"{where}: too few rows ({len(t)}); an identification needs at least {MIN_ROWS}"
        )

    if not np.isfinite(t).all():
        row = int(np.argmax(~np.isfinite(t)))
        fault = "NaN" if np.isnan(t[row]) else "an infinite time"
        raise RecordingError(f"{where} holds {fault} in data row {first + row + 1}")

    steps = np.diff(t)
    if np.any(steps <= 0.0):
        raise RecordingError(_describe_reversal(where, t, steps, first))

    median = float(np.median(steps))
    if not MIN_MEDIAN_STEP <= median <= MAX_MEDIAN_STEP:
        raise RecordingError(
            f"{where}: the median step is {median:g} s, which is unlikely for a robot's log; "
            f'should it be recording.time_unit = "{_likely_unit(median, unit)}"?'
        )

    limit = longest_bridged_gap(t, gap)
    row = int(np.argmax(steps))
    if steps[row] > limit:
        raise RecordingError(
            f"{where}: a gap of {steps[row]:g} s after data row {first + row + 1} "
            f"({t[row] - t[0]:g} s after the first one); gaps longer than {limit:g} s are not "
            "bridged: exclude this gap by recording.window, or raise recording.gap"
        )


def longest_bridged_gap(t: Array, gap: float) -> float:
    """Compute the longest gap that is bridged.

    Args:
        t: (M,) times of rows that have a value [s], M > 1.
        gap: Longest gap that the experiment file allows [s].

    Returns:
        The larger of this gap and a few median steps [s].
    """
    return max(gap, MIN_GAP_STEPS * float(np.median(np.diff(t))))


def _describe_reversal(where: str, t: Array, steps: Array, first: int) -> str:
    """Message about the first time that is not later than the previous time.

    Args:
        where: File and column, for messages.
        t: (M,) times [s].
        steps: (M-1,) differences of the times [s].
        first: Row of the file in which `t` begins, counted from 0.
    """
    row = int(np.argmax(steps <= 0.0))
    before, after = t[row], t[row + 1]
    place = (
        f"{where} does not increase in data row {first + row + 2}: {before:.9g} s, then "
        f"{after:.9g} s"
    )

    if steps[row] == 0.0:
        count = int(np.sum(steps == 0.0))
        others = f", one of {count}" if count > 1 else ""
        return f"{place} (a duplicate{others}); every row needs a different time"

    # A clock that restarts jumps back to the beginning and continues from there.
    is_last = row + 2 == len(t)
    if after - t[0] < RESTART_SHARE * (before - t[0]) and not is_last:
        return (
            f"{place} (the clock restarted or wrapped around); cut the log there by "
            "recording.window, or in two files"
        )

    return f"{place} (rows out of order); sort them by time"


def _likely_unit(median: float, unit: str) -> str:
    """Unit of time with which the median step is closest to that of a typical log.

    Args:
        median: Median step, read with the stated unit [s].
        unit: The stated unit.
    """
    # Logarithms neither vanish nor overflow where a step is extremely short or long.
    typical = float(np.log(median) - np.log(SECONDS[unit]) - np.log(TYPICAL_STEP))

    def distance(other: str) -> float:
        """Logarithmic distance from a typical step if the raw step has another unit."""
        return abs(typical + float(np.log(SECONDS[other])))

    return min(SECONDS, key=distance)


def check_finite(where: str, values: Array, first: int) -> None:
    """Refuse a column with a value that is infinite or whose square is.

    Args:
        where: File and column, for messages.
        values: (M,) values; NaN is allowed.
        first: Row of the file in which they begin, counted from 0.

    Raises:
        RecordingError: A value is infinite, or too large to be a measurement.
    """
    infinite = np.isinf(values)
    if infinite.any():
        row = first + int(np.argmax(infinite)) + 1
        raise RecordingError(
            f"{where} is infinite in data row {row}; leave the field empty if there is no number"
        )

    # Sums of squares would be infinite. A comparison with NaN is False.
    too_large = np.abs(values) > LARGEST_VALUE
    if too_large.any():
        at = int(np.argmax(too_large))
        raise RecordingError(
            f"{where} is {values[at]:g} in data row {first + at + 1}, which is too large to be a "
            "measured number; leave the field empty if there is no number"
        )


def check_measured(where: str, t: Array, values: Array, gap: float) -> None:
    """Refuse a measured column that is empty or constant, or has gaps that are too long.

    Args:
        where: File and column, for messages.
        t: (M,) times [s].
        values: (M,) values, NaN where empty.
        gap: Longest gap that is bridged [s].

    Raises:
        RecordingError: The column is empty or constant, or a gap is too long.
    """
    present = np.flatnonzero(np.isfinite(values))
    advice = "remove it from the file or from [recording.columns]"

    if not len(present):
        raise RecordingError(f"{where} holds no number; {advice}")

    if len(present) >= DEAD_CHANNEL_ROWS and np.ptp(values[present]) == 0.0:
        raise RecordingError(
            f"{where} is {values[present[0]]:g} in all of its {len(present)} rows, which suggests "
            f"a dead channel; {advice}"
        )

    # A column with a low rate is empty in most rows, so its gaps are compared with its median step.
    limit = longest_bridged_gap(t[present], gap) if len(present) > 1 else gap
    edges = np.concatenate([t[:1], t[present], t[-1:]])
    longest = int(np.argmax(np.diff(edges)))

    if edges[longest + 1] - edges[longest] > limit:
        begin, end = edges[longest] - t[0], edges[longest + 1] - t[0]
        raise RecordingError(
            f"{where} is empty from {begin:g} to {end:g} s; gaps longer than {limit:g} s are not "
            "bridged: exclude this time by recording.window, or raise recording.gap"
        )


def hold_last_value(t: Array, values: Array) -> tuple[Array, Array]:
    """Fill empty rows of a control with the last value before them.

    Args:
        t: (M,) times [s].
        values: (M,) values of the control, NaN where empty.

    Returns:
        (M,) filled values, NaN before the first value, and (M,) time since each value was logged
        [s].
    """
    rows = np.where(np.isfinite(values), np.arange(len(values)), 0)
    last = np.maximum.accumulate(rows)
    return values[last], t - t[last]


def check_held(where: str, t: Array, values: Array, age: Array, gap: float) -> None:
    """Refuse a control that is missing in the first row, or that is held for too long.

    Args:
        where: File and column, for messages.
        t: (M-1,) times of the rows that have a control [s].
        values: (M-1,) control with its empty rows filled, NaN before its first value.
        age: (M-1,) time since each value was logged [s].
        gap: Longest time for which a control is held [s].

    Raises:
        RecordingError: The control is missing in the first row, or held for too long.
    """
    if np.isnan(values[0]):
        reason = "it holds no number"
        if np.isfinite(values).any():
            row = int(np.argmax(~np.isnan(values)))
            reason = f"it begins {t[row] - t[0]:g} s later"
        raise RecordingError(
            f"{where} has no value in the first row; {reason}; every control is needed from the "
            "first row on"
        )

    limit = longest_bridged_gap(t, gap)
    if age.max() > limit:
        end = int(np.argmax(age))
        raise RecordingError(
            f"{where} is empty for {age[end]:g} s until {t[end] - t[0]:g} s; a control is not held "
            f"longer than {limit:g} s: exclude this time by recording.window, or raise "
            "recording.gap"
        )
