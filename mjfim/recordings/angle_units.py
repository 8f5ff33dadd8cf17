"""Detection of angles that are probably logged in degrees although the experiment file does not say so."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.model.coordinates import joint_names
from mjfim.recordings.plausibility import displacements

# Degrees per radian.
DEGREES = 180.0 / np.pi

# Relative tolerance of a factor between degrees and radians, and of a joint's range.
TOLERANCE = 0.2

# Correlation above which a position and a velocity count as measurements of one motion.
MIN_CORRELATION = 0.5

# Time over which positions are differenced [s], so that their resolution and noise have little
# effect.
DIFFERENCE_TIME = 0.05

# Angles beyond this multiple of a joint's range are implausible.
MAX_RANGE_RATIO = 3.0

# Angle [rad] and speed [rad/s] that together are implausible for a joint without a known range.
MAX_PLAUSIBLE_ANGLE = 50.0
MAX_PLAUSIBLE_SPEED = 200.0


def check_angles(
    where: str, model: Any, t: Array, columns: Mapping[str, Array], stated: Collection[str]
) -> None:
    """Refuse a column of a hinge that looks like degrees.

    Args:
        where: The file, for messages.
        model: The compiled MuJoCo model.
        t: (M,) times [s].
        columns: (M,) values by name of the recording's column, NaN where empty.
        stated: Names of the columns whose unit the experiment file states; they are not checked.

    Raises:
        RecordingError: A column is probably in degrees; the message says how to state its unit.
    """
    for j, joint in enumerate(joint_names(model)):
        if int(model.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_HINGE):
            continue

        position, velocity = f"qpos:{joint}", f"qvel:{joint}"
        q, v = columns.get(position), columns.get(velocity)
        if q is not None and v is not None:
            _check_slope(where, t, (position, q), (velocity, v), stated)

        if q is None or position in stated:
            continue
        if model.jnt_limited[j]:
            _check_range(where, position, q, model.jnt_range[j])
        _check_speed(where, position, t, q)


def _check_slope(
    where: str,
    t: Array,
    position: tuple[str, Array],
    velocity: tuple[str, Array],
    stated: Collection[str],
) -> None:
    """Refuse a position whose slope is its velocity times the factor between degrees and radians, or the reverse."""
    ratio = _slope_ratio(t, position[1], velocity[1])

    for name, factor, degrees, radians in (
        (position[0], DEGREES, "deg", "rad"),
        (velocity[0], 1.0 / DEGREES, "deg/s", "rad/s"),
    ):
        if name not in stated and abs(ratio / factor - 1.0) < TOLERANCE:
            raise RecordingError(
                f"{where}: the slope of {position[0]!r} is {ratio:.3g} times {velocity[0]!r}; "
                f"{_advice(name, degrees, radians)}"
            )


def _slope_ratio(t: Array, q: Array, v: Array) -> float:
    """Least-squares ratio of the slope of q: (M,) to v: (M,); NaN where they do not show one motion."""
    both = np.isfinite(q) & np.isfinite(v)
    t, q, v = t[both], q[both], v[both]
    if len(t) < 3:
        return float("nan")

    dq, dv, _ = displacements(t, q, v, DIFFERENCE_TIME, max(1, len(t) // 10))
    square = float(dv @ dv)
    product = float(dq @ dv)

    if square <= 0.0 or product < MIN_CORRELATION * np.sqrt(square * float(dq @ dq)):
        return float("nan")
    return product / square


def _check_range(where: str, name: str, q: Array, limits: Array) -> None:
    """Refuse angles q: (M,) far beyond the joint's range, limits: (2,) [rad], if they are inside it as degrees."""
    low, high = (float(x) for x in limits)
    smallest, largest = float(np.nanmin(q)), float(np.nanmax(q))

    reach = max(abs(low), abs(high))
    is_beyond = max(abs(smallest), abs(largest)) > MAX_RANGE_RATIO * reach

    slack = TOLERANCE * (high - low)
    from_degrees = smallest / DEGREES, largest / DEGREES
    is_inside = low - slack <= from_degrees[0] and from_degrees[1] <= high + slack

    if is_beyond and is_inside:
        raise RecordingError(
            f"{where}: column {name!r} ranges from {smallest:g} to {largest:g}, its joint from "
            f"{low:g} to {high:g} rad; {_advice(name, 'deg', 'rad')}"
        )


def _check_speed(where: str, name: str, t: Array, q: Array) -> None:
    """Refuse angles q: (M,) of many turns that change faster than any joint."""
    largest = float(np.nanmax(np.abs(q)))
    if largest <= MAX_PLAUSIBLE_ANGLE:
        return

    speed = _largest_slope(t, q)
    if speed > MAX_PLAUSIBLE_SPEED:
        raise RecordingError(
            f"{where}: column {name!r} reaches {largest:g} rad at {speed:.3g} rad/s; "
            f"{_advice(name, 'deg', 'rad')}"
        )


def _largest_slope(t: Array, q: Array) -> float:
    """Largest slope of q: (M,) [per s] between rows that have a value."""
    present = np.isfinite(q)
    steps = np.diff(t[present])
    if not len(steps):
        return 0.0
    return float(np.abs(np.diff(q[present]) / steps).max())


def _advice(name: str, degrees: str, radians: str) -> str:
    """End of a message: how the experiment file states the unit of a column."""
    return (
        f'{name!r} is probably in {degrees}: state unit = "{degrees}" for it in [recording.columns], '
        f'or unit = "{radians}" if it is not'
    )
