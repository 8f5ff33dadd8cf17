"""Detection of angles that are probably in degrees although the experiment file states no unit."""

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

# Relative tolerance for the ratio of degrees to radians, and for a joint's range.
TOLERANCE = 0.2

# Correlation above which a position and a velocity are considered to belong to one motion.
MIN_CORRELATION = 0.5

# Time between the positions whose difference is taken [s]; it is long enough that resolution and
# noise have little effect.
DIFFERENCE_TIME = 0.05

# Angles beyond this multiple of a joint's range are implausible.
MAX_RANGE_RATIO = 3.0

# An angle [rad] and a speed [rad/s] that are implausible if a joint exceeds both.
MAX_PLAUSIBLE_ANGLE = 50.0
MAX_PLAUSIBLE_SPEED = 200.0


def check_angles(
    where: str, model: Any, t: Array, columns: Mapping[str, Array], stated: Collection[str]
) -> None:
    """Refuse columns of hinge joints that are probably in degrees.

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
    """Refuse a position and velocity of which one is probably in degrees, the other in radians.

    Args:
        where: The file, for messages.
        t: (M,) times [s].
        position: Name and (M,) values of the position.
        velocity: Name and (M,) values of the velocity.
        stated: Names of the columns whose unit the experiment file states.
    """
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
    """Least-squares ratio of the slope of q: (M,) to v: (M,).

    NaN if they are not correlated enough to belong to one motion.
    """
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
    """Refuse angles that are far outside the joint's range, but inside it if they are in degrees.

    Args:
        where: The file, for messages.
        name: Name of the column.
        q: (M,) values.
        limits: (2,) range of the joint [rad].
    """
    low, high = (float(x) for x in limits)
    smallest, largest = float(np.nanmin(q)), float(np.nanmax(q))

    reach = max(abs(low), abs(high))
    is_beyond = max(abs(smallest), abs(largest)) > MAX_RANGE_RATIO * reach

    tolerance = TOLERANCE * (high - low)
    is_inside = low - tolerance <= smallest / DEGREES and largest / DEGREES <= high + tolerance

    if is_beyond and is_inside:
        raise RecordingError(
            f"{where}: column {name!r} ranges from {smallest:g} to {largest:g}, but its joint from "
            f"{low:g} to {high:g} rad; {_advice(name, 'deg', 'rad')}"
        )


def _check_speed(where: str, name: str, t: Array, q: Array) -> None:
    """Refuse angles q: (M,) of many turns if they change faster than a joint can move."""
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
    """Largest absolute slope of q: (M,) between successive rows that have a value [1/s]."""
    present = np.isfinite(q)
    steps = np.diff(t[present])
    if not len(steps):
        return 0.0
    return float(np.abs(np.diff(q[present]) / steps).max())


def _advice(name: str, degrees: str, radians: str) -> str:
    """End of a message, which says how to state the unit of a column in the experiment file."""
    return (
        f'{name!r} is probably in {degrees}: state unit = "{degrees}" for it in '
        f'[recording.columns], or unit = "{radians}" if it is not'
    )
