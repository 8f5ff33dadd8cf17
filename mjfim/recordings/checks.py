"""Checks that refuse an unusable log, and remarks about the quality of measured data.

The checks concern the clock, gaps, dead channels, numbers that cannot be measured, and angles in
degrees; a message says where the fault is and what to do. The remarks concern noise, spikes, and
columns that contradict each other.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.model.coordinates import joint_names, scalar_joints
from mjfim.model.units import ANGLE
from mjfim.recordings.channels import Channels
from mjfim.recordings.formats import SECONDS
from mjfim.records.trajectory import Recording

# Smallest number of rows of a usable log.
MIN_ROWS = 3

# Shortest and longest plausible median step of a robot's log [s]. Outside this range, the unit of
# time is probably wrong. A typical step, from which the unit is guessed.
MIN_MEDIAN_STEP, MAX_MEDIAN_STEP = 1e-6, 1.0
TYPICAL_STEP = 5e-3

# A gap of up to this number of median steps is bridged, even if it is longer than `gap`.
MIN_GAP_STEPS = 5.0

# A measured column with at least this number of values, all equal, is a dead channel.
DEAD_CHANNEL_ROWS = 10

# Share of the rows that are left out where their times repeat or are out of order. More of them are
# a fault of the log.
MAX_DISORDER = 0.01

# A clock that jumps back to less than this fraction of the elapsed time has restarted. After a
# smaller jump back, the rows are out of order.
RESTART_SHARE = 0.1

# Largest number whose square is finite in float64.
LARGEST_VALUE = float(np.sqrt(np.finfo(np.float64).max))

# Degrees per radian, and the relative tolerance for this ratio and for a joint's range.
DEGREES = 180.0 / np.pi
TOLERANCE = 0.2

# Correlation above which two columns are considered to belong to one motion.
MIN_CORRELATION = 0.5

# Time between the positions whose difference is taken [s]; it is long enough that resolution and
# noise have little effect.
DIFFERENCE_TIME = 0.05

# Angles beyond this multiple of a joint's range are implausible.
MAX_RANGE_RATIO = 3.0

# An angle [rad] and a speed [rad/s] that are implausible if a joint exceeds both.
MAX_PLAUSIBLE_ANGLE, MAX_PLAUSIBLE_SPEED = 50.0, 200.0


def in_order(t: Array) -> np.ndarray:
    """Find the rows that have to be left out, so that the times of the others increase.

    Args:
        t: (M,) times [s].

    Returns:
        (M,) True for the rows that stay. All stay where more than a few would be left out, or a
        time is not finite.
    """
    if (np.diff(t) > 0.0).all():
        return np.ones(len(t), dtype=bool)
    # A row is late after a time that is not smaller, or early before one that is not larger.
    earlier = np.concatenate([[-np.inf], np.maximum.accumulate(t)[:-1]])
    later = np.concatenate([np.minimum.accumulate(t[::-1])[-2::-1], [np.inf]])
    stays = max((t > earlier, t < later), key=np.count_nonzero)
    few = np.count_nonzero(~stays) <= MAX_DISORDER * len(t) and np.isfinite(t).all()
    return stays if few else np.ones(len(t), dtype=bool)


def check_clock(where: str, t: Array, numbers: Sequence[int], unit: str, gap: float) -> None:
    """Refuse times that cannot be the clock of a robot's log.

    Args:
        where: File and column, for messages.
        t: (M,) times inside the window [s].
        numbers: M places of the rows in the log from 0, for messages.
        unit: Unit of time that the experiment file states.
        gap: Longest accepted gap [s].

    Raises:
        RecordingError: Too few rows, a time that is not finite or does not increase, an implausible
            rate, or a gap.
    """
    if len(t) < MIN_ROWS:
        raise RecordingError(
            f"{where}: too few rows ({len(t)}); an identification needs at least {MIN_ROWS}"
        )
    if not np.isfinite(t).all():
        row = int(np.argmax(~np.isfinite(t)))
        fault = "NaN" if np.isnan(t[row]) else "an infinite time"
        raise RecordingError(f"{where} holds {fault} in data row {numbers[row] + 1}")

    steps = np.diff(t)
    if np.any(steps <= 0.0):
        row = int(np.argmax(steps <= 0.0))
        raise RecordingError(
            f"{where} does not increase in data row {numbers[row + 1] + 1}: {t[row]:.9g} s, then "
            f"{t[row + 1]:.9g} s {_why_not_later(t, steps, row)}"
        )
    median = np.median(steps)
    if not MIN_MEDIAN_STEP <= median <= MAX_MEDIAN_STEP:
        likely = likely_unit(float(np.log(median) - np.log(SECONDS[unit])))
        raise RecordingError(
            f"{where}: the median step is {median:g} s, which is unlikely for a robot's log; "
            f'should it be recording.time_unit = "{likely}"?'
        )

    limit = longest_bridged_gap(t, gap)
    row = int(np.argmax(steps))
    if steps[row] > limit:
        raise RecordingError(
            f"{where}: a gap of {steps[row]:g} s after data row {numbers[row] + 1} "
            f"({t[row] - t[0]:g} s after the first one); gaps longer than {limit:g} s are not "
            "bridged: exclude this gap by recording.window, or raise recording.gap"
        )


def likely_unit(log_step: float) -> str:
    """Guess the unit of time stamps.

    Args:
        log_step: Logarithm of their typical step, which neither vanishes nor overflows.
    """
    size = log_step - np.log(TYPICAL_STEP)
    return min(SECONDS, key=lambda unit: abs(size + np.log(SECONDS[unit])))


def longest_bridged_gap(t: Array, gap: float) -> float:
    """Longest gap that is bridged [s]: the stated one, or some median steps of t: (M,)."""
    return max(gap, MIN_GAP_STEPS * float(np.median(np.diff(t))))


def _why_not_later(t: Array, steps: Array, row: int) -> str:
    """Probable cause of a time that is not later than the one before, and its cure."""
    if steps[row] == 0.0:
        count = np.sum(steps == 0.0)
        others = f", one of {count}" if count > 1 else ""
        return f"(a duplicate{others}); every row needs a different time"
    # A clock that restarts jumps back to the beginning and continues from there.
    is_last = row + 2 == len(t)
    if t[row + 1] - t[0] < RESTART_SHARE * (t[row] - t[0]) and not is_last:
        return (
            "(the clock restarted or wrapped around); cut the log there by recording.window, or in "
            "two files"
        )
    return "(rows out of order); sort them by time"


def check_finite(where: str, values: Array, numbers: Sequence[int]) -> None:
    """Refuse a column with a value that is infinite or whose square is; NaN is an empty field.

    Raises:
        RecordingError: There is such a value; the message names its row by `numbers`, from 0.
    """
    too_large = np.abs(values) > LARGEST_VALUE
    if too_large.any():
        at = int(np.argmax(too_large))
        raise RecordingError(
            f"{where} is {values[at]:g} in data row {numbers[at] + 1}, which is too large to be a "
            "measured number; leave the field empty if there is no number"
        )


def check_measured(where: str, t: Array, values: Array, gap: float, *, may_rest: bool) -> None:
    """Refuse a measured column that is empty or constant, or has gaps that are too long.

    Args:
        where: File and column, for messages.
        t: (M,) times [s].
        values: (M,) numbers, NaN where the column is empty.
        gap: Longest accepted gap [s].
        may_rest: True for a joint whose reference rests, so that its readings may be constant.

    Raises:
        RecordingError: The column cannot be used.
    """
    present = np.flatnonzero(np.isfinite(values))
    advice = "remove it from the file or from [recording.columns]"
    if not len(present):
        raise RecordingError(f"{where} holds no number; {advice}")
    if not may_rest and len(present) >= DEAD_CHANNEL_ROWS and np.ptp(values[present]) == 0.0:
        raise RecordingError(
            f"{where} is {values[present[0]]:g} in all of its {len(present)} rows, which suggests "
            f"a dead channel; {advice}"
        )

    # A column with a low rate is empty in most rows, so its gaps are compared with its median step.
    limit = longest_bridged_gap(t[present], gap) if len(present) > 1 else gap
    edges = np.concatenate([t[:1], t[present], t[-1:]])
    longest = np.argmax(np.diff(edges))
    begin, end = edges[longest : longest + 2] - t[0]
    if end - begin > limit:
        raise RecordingError(
            f"{where} is empty from {begin:g} to {end:g} s; gaps longer than {limit:g} s are not "
            "bridged: exclude this time by recording.window, or raise recording.gap"
        )


def check_held(where: str, t: Array, values: Array, age: Array, gap: float) -> None:
    """Refuse a control that is missing in the first row, or that is held for too long.

    Args:
        where: File and column, for messages.
        t: (M,) times [s].
        values: (M,) numbers, each held over the empty rows after it.
        age: (M,) times since they were set [s].
        gap: Longest time for which a control is held [s].

    Raises:
        RecordingError: The control cannot be used.
    """
    if np.isnan(values[0]):
        reason = "it holds no number"
        if np.isfinite(values).any():
            row = np.argmax(~np.isnan(values))
            reason = f"it begins {t[row] - t[0]:g} s later"
        raise RecordingError(
            f"{where} has no value in the first row; {reason}; every control is needed from the "
            "first row on"
        )
    limit = longest_bridged_gap(t, gap)
    if age.max() > limit:
        end = np.argmax(age)
        raise RecordingError(
            f"{where} is empty for {age[end]:g} s until {t[end] - t[0]:g} s; a control is not held "
            f"longer than {limit:g} s: exclude this time by recording.window, or raise "
            "recording.gap"
        )


# ---- degrees


def check_angles(
    where: str,
    channels: Channels,
    t: Array,
    columns: Mapping[str, Array],
    stated: Collection[str],
    hint: str,
) -> None:
    """Refuse angles of hinge joints, and references for them, that are probably in degrees.

    Args:
        where: The file, for messages.
        channels: The signals of the experiment.
        t: (M,) times [s].
        columns: (M,) columns of the recording by name.
        stated: Names of columns whose unit the experiment file states; they are not doubted.
        hint: How to state units that the file does not name; may be empty.

    Raises:
        RecordingError: A column is probably in degrees.
    """
    for name, why in (
        *doubtful_angles(channels.model, t, columns),
        *_doubtful_references(channels, columns),
    ):
        if name not in stated:
            per_second = "/s" if name.startswith("qvel:") else ""
            raise RecordingError(
                f"{where}: {why}; {name!r} is probably in deg{per_second}: state unit = "
                f'"deg{per_second}" for it in [recording.columns], or unit = "rad{per_second}" if '
                f"it is not{hint and f'. {hint}'}"
            )


def doubtful_angles(
    model: mujoco.MjModel, t: Array, columns: Mapping[str, Array]
) -> Iterator[tuple[str, str]]:
    """Find columns of hinge joints that look like degrees.

    Args:
        model: The compiled model.
        t: (M,) times [s].
        columns: (M,) columns of the recording by name.

    Yields:
        Name of each such column, and why.
    """
    for j, joint in enumerate(joint_names(model)):
        if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE:
            continue
        position, velocity = f"qpos:{joint}", f"qvel:{joint}"
        q, v = columns.get(position), columns.get(velocity)
        if q is not None and v is not None:
            ratio = _slope_ratio(t, q, v)
            why = f"the slope of {position!r} is {ratio:.3g} times {velocity!r}"
            if abs(ratio / DEGREES - 1.0) < TOLERANCE:
                yield position, why
            if abs(ratio * DEGREES - 1.0) < TOLERANCE:
                yield velocity, why
        if q is None:
            continue

        smallest, largest = float(np.nanmin(q)), float(np.nanmax(q))
        size = max(abs(smallest), abs(largest))
        low, high = model.jnt_range[j].tolist()
        tolerance = TOLERANCE * (high - low)
        is_beyond = size > MAX_RANGE_RATIO * max(abs(low), abs(high))
        is_inside = low - tolerance <= smallest / DEGREES and largest / DEGREES <= high + tolerance
        if model.jnt_limited[j] and is_beyond and is_inside:
            yield (
                position,
                f"column {position!r} ranges from {smallest:g} to {largest:g}, but its joint from "
                f"{low:g} to {high:g} rad",
            )
        present = np.isfinite(q)
        speed = np.abs(np.diff(q[present]) / np.diff(t[present])).max(initial=0.0)
        if size > MAX_PLAUSIBLE_ANGLE and speed > MAX_PLAUSIBLE_SPEED:
            yield position, f"column {position!r} reaches {size:g} rad at {speed:.3g} rad/s"


def _doubtful_references(
    channels: Channels, columns: Mapping[str, Array]
) -> Iterator[tuple[str, str]]:
    """References of control laws that move as far in degrees as the position does in radians."""
    if channels.laws is None:
        return
    for law in channels.laws.laws:
        name, unit, _ = channels.laws.inputs[law.columns["reference"]]
        q, r = columns.get(f"qpos:{law.joint}"), columns.get(name)
        if q is None or r is None or unit != ANGLE:
            continue
        both = np.isfinite(q) & np.isfinite(r)
        ratio = _ratio(q[both] - q[both].mean(), r[both] - r[both].mean())
        if abs(ratio / DEGREES - 1.0) < TOLERANCE:
            yield name, f"{name!r} moves {ratio:.3g} times as far as 'qpos:{law.joint}'"


def _slope_ratio(t: Array, q: Array, v: Array) -> float:
    """Ratio of the slope of q: (M,) to v: (M,), where both belong to one motion."""
    both = np.isfinite(q) & np.isfinite(v)
    if both.sum() < MIN_ROWS:
        return float("nan")
    dq, dv, _ = displacements(t[both], q[both], v[both], DIFFERENCE_TIME, max(1, both.sum() // 10))
    return _ratio(dv, dq)


def _ratio(x: Array, y: Array) -> float:
    """Least-squares ratio of y: (M,) to x: (M,); NaN where they hardly belong to one motion."""
    square, product = float(x @ x), float(x @ y)
    if product <= MIN_CORRELATION * np.sqrt(square * float(y @ y)):
        return float("nan")
    return product / square


# Only the first rows of a long recording are inspected.
MAX_ROWS = 200_000

# Width of the running median filter that separates smooth motion from noise and spikes [rows].
MEDIAN_ROWS = 7

# Length of the shortest column that is inspected [rows].
SHORTEST_COLUMN = 4 * MEDIAN_ROWS

# A measured column is rough if the running median removes more than this fraction of its variance,
# and a fitted model does not explain this part.
MAX_ROUGH_SHARE = 0.1

# Correlation of the rough parts of two motions above which they are one motion.
MIN_SAME_MOTION = 0.6

# A deviation counts only if it exceeds this number of stated standard deviations of the noise.
SIGNIFICANT_SIGMAS = 3.0

# A control is rough if the running median removes more than this fraction of its variance. The
# limit is higher than for measured columns, because a control may jump intentionally.
MAX_ROUGH_CONTROL_SHARE = 0.5

# A control that jumps intentionally is still correlated with the previous row. Below this
# correlation it is considered noise.
MIN_CONTROL_CORRELATION = 0.5

# Largest fraction of the rows in which a control may be outside its range.
MAX_SHARE_OUTSIDE_RANGE = 1e-3

# Tolerance of the range of a control, as a fraction of its width.
RANGE_TOLERANCE = 1e-6

# A position and the integral of its velocity contradict each other if their displacements differ by
# more than this fraction of the displacements' standard deviation.
MAX_DISAGREEMENT = 0.1

# Number of times by which a motion may be quicker than that of a model that may be wrong.
MODEL_FACTOR = 2.0

# Time over which displacements are compared [s].
COMPARISON_TIME = 0.2


def plausibility_remarks(
    channels: Channels, recording: Recording, predicted: Array | None = None
) -> tuple[str, ...]:
    """Describe properties of a recording that make its data implausible.

    Args:
        channels: Names, ranges and noise of the recording's columns.
        recording: The measured data.
        predicted: (M, m) outputs of a fitted model at the rows of the recording, in the order of
            the channels; None before a fit. A motion that is quick at the rate of the recording
            is rough, too, and only a model tells it from noise.

    Returns:
        One sentence per remark; empty if the data are plausible.
    """
    return (
        *_control_remarks(channels, recording.ctrl[:MAX_ROWS]),
        *_roughness_remarks(channels, recording, predicted),
        *contradiction_remarks(channels, recording, predicted),
    )


def _range_remark(name: str, u: Array, low: float, high: float) -> Iterator[str]:
    """Remark about a control u: (n,) that is outside its range in more than a few rows."""
    tolerance = RANGE_TOLERANCE * (high - low)
    share = np.mean((u < low - tolerance) | (u > high + tolerance))
    if share > MAX_SHARE_OUTSIDE_RANGE:
        yield (
            f"control {name!r} is outside its ctrlrange [{low:g}, {high:g}] in {100 * share:.2g} % "
            f"of the rows (it ranges from {u.min():.3g} to {u.max():.3g}); the simulation clamps "
            "it to the range"
        )


def _control_remarks(channels: Channels, ctrl: Array) -> Iterator[str]:
    """Remarks about controls ctrl: (M-1, nu) that are outside their range or look like noise."""
    model = channels.model
    for column, u in zip(channels.control_columns, ctrl.T, strict=True):
        # References of control laws jump where the user commands it, and have no range.
        if not (column.startswith("ctrl:") and _moves(u[1:]) and _moves(u[:-1])):
            continue
        name = column.removeprefix("ctrl:")
        i = channels.controls.index(name)
        if model.actuator_ctrllimited[i]:
            yield from _range_remark(name, u, *model.actuator_ctrlrange[i])

        rough = np.var(_rough_part(u)) / np.var(u)
        correlation = np.corrcoef(u[1:], u[:-1])[0, 1]
        if rough > MAX_ROUGH_CONTROL_SHARE and correlation < MIN_CONTROL_CORRELATION:
            yield (
                f"control {name!r} jumps from row to row ({100 * rough:.0f} % of its variance lies "
                f"within {MEDIAN_ROWS} rows, correlation with the previous row {correlation:.2f}): "
                "if it was measured instead of commanded, the simulation treats its noise as a "
                "force, and the estimates are biased"
            )


def _roughness_remarks(
    channels: Channels, recording: Recording, predicted: Array | None
) -> Iterator[str]:
    """Remarks about outputs whose jumps are large compared with both their noise and motion."""
    sigma = _sigma_by_name(channels)
    for i, name in enumerate(recording.outputs):
        y = recording.y[:MAX_ROWS, i]
        present = np.isfinite(y)
        y = y[present]
        if not _moves(y):
            continue

        rough, explanation = _rough_part(y), "is too quick for a smooth motion"
        unexplained, least = float(np.var(rough)), MAX_ROUGH_SHARE * np.var(y)
        if predicted is not None and name in channels.outputs and unexplained > least:
            motion = predicted[:MAX_ROWS, channels.outputs.index(name)][present]
            quick, explanation = _rough_part(motion), "is not explained by the identified motion"
            correlation = np.corrcoef(quick, rough)[0, 1] if quick.any() else 0.0
            unexplained *= 1.0 - correlation**2
            # A model whose motion is another one shows at least how quick it is.
            if correlation < MIN_SAME_MOTION:
                unexplained = min(unexplained, float(np.var(rough) - MODEL_FACTOR * np.var(quick)))
        noise = SIGNIFICANT_SIGMAS * sigma.get(name, 0.0)
        if unexplained > least and unexplained > noise**2:
            share = unexplained / np.var(y)
            yield (
                f"{name} is rough: {100 * share:.0f} % of its variance lies within {MEDIAN_ROWS} "
                f"rows and {explanation}; noise, spikes or steps hide the motion of the robot"
            )


def contradiction_remarks(
    channels: Channels, recording: Recording, predicted: Array | None = None
) -> Iterator[str]:
    """Remarks about joints whose position does not follow the integral of their velocity."""
    t = recording.t[:MAX_ROWS]
    columns = {name: recording.y[:MAX_ROWS, i] for i, name in enumerate(recording.outputs)}
    sigma = _sigma_by_name(channels)
    for joint in scalar_joints(channels.model):
        position, velocity = joint.position_column, joint.velocity_column
        if position not in columns or velocity not in columns:
            continue
        both = np.isfinite(columns[position]) & np.isfinite(columns[velocity])
        if both.sum() < SHORTEST_COLUMN:
            continue

        q, v = columns[position][both], columns[velocity][both]
        dq, dv, lag = displacements(t[both], q, v, COMPARISON_TIME, len(q) // 4)
        size, difference = np.std(dq), np.std(dq - dv)
        # Noise of a difference of positions, and of an integral of velocities.
        integral = np.sqrt(lag) * np.median(np.diff(t[both]))
        expected = SIGNIFICANT_SIGMAS * np.hypot(
            np.sqrt(2.0) * sigma.get(position, 0.0), integral * sigma.get(velocity, 0.0)
        )
        # Where the motion is quick at the rate of the recording, those of a model differ, too.
        if predicted is not None:
            q, v = (
                predicted[:MAX_ROWS, channels.outputs.index(name)][both]
                for name in (position, velocity)
            )
            of_model = np.subtract(*displacements(t[both], q, v, COMPARISON_TIME, len(q) // 4)[:2])
            expected += MODEL_FACTOR * np.std(of_model)
        if size > 0.0 and difference > max(MAX_DISAGREEMENT * size, expected):
            yield (
                f"{position} and the integral of {velocity} differ by "
                f"{100 * difference / size:.0f} % of the motion; one of them is wrong, delayed "
                "or has the other sign"
            )


def displacements(
    t: Array, q: Array, v: Array, duration: float, max_lag: int
) -> tuple[Array, Array, int]:
    """Compute displacements over a fixed number of rows from a position and from a velocity.

    Args:
        t: (M,) times [s].
        q: (M,) positions without NaN.
        v: (M,) velocities without NaN.
        duration: Approximate time of a displacement [s].
        max_lag: Largest number of rows of a displacement.

    Returns:
        (M-lag,) differences of the position, (M-lag,) integrals of the velocity by the trapezoidal
        rule, and lag, the number of rows of a displacement.
    """
    lag = int(np.clip(round(duration / np.median(np.diff(t))), 1, max_lag))
    integral = scipy.integrate.cumulative_trapezoid(v, t, initial=0.0)
    return q[lag:] - q[:-lag], integral[lag:] - integral[:-lag], lag


def _sigma_by_name(channels: Channels) -> dict[str, float]:
    return dict(zip(channels.outputs, channels.sigma.tolist(), strict=True))


def _moves(x: Array) -> bool:
    """Whether a column x: (M,) is long enough to be inspected, and not constant."""
    return len(x) >= SHORTEST_COLUMN and float(np.ptp(x)) > 0.0


def _rough_part(x: Array) -> Array:
    """(M,) what a running median removes from x: (M,); beyond its ends, x keeps its last values."""
    smooth: Array = scipy.ndimage.median_filter(x, size=MEDIAN_ROWS, mode="nearest")
    return x - smooth
