"""Angles that are probably in degrees although nobody says so."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.model.coordinates import joint_names
from mjfim.recordings.plausibility import ways

DEGREES = 180.0 / np.pi
NEAR = 0.2  # relative distance from the factor that is still the factor
ALIKE = 0.5  # correlation from which two columns are one motion
STRETCH = (
    0.05  # [s] over which positions are differenced, so that resolution and noise do not count
)
BEYOND = 3.0  # ranges of a joint that nothing goes beyond


FAR, FAST = 50.0, 200.0  # [rad, rad/s] that hardly any joint reaches, where no range is known


def check_angles(
    where: str, model: Any, t: Array, columns: Mapping[str, Array], stated: Collection[str]
) -> None:
    """Raise RecordingError where a hinge's column looks like degrees. stated: columns whose unit the user gave"""
    for j, joint in enumerate(joint_names(model)):
        if int(model.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_HINGE):
            continue
        qpos, qvel = f"qpos:{joint}", f"qvel:{joint}"
        q, v = columns.get(qpos), columns.get(qvel)
        if q is not None and v is not None:
            _check_pair(where, t, (qpos, q), (qvel, v), stated)
        if q is None or qpos in stated:
            continue
        largest = float(np.nanmax(np.abs(q)))
        if model.jnt_limited[j]:
            _check_range(where, qpos, q, model.jnt_range[j])
        if largest > FAR and _fastest(t, q) > FAST:
            raise RecordingError(
                f"{where}: column {qpos!r} reaches {largest:g} rad at {_fastest(t, q):.3g} rad/s; {_advice(qpos, 'deg', 'rad')}"
            )


def _check_pair(
    where: str,
    t: Array,
    position: tuple[str, Array],
    velocity: tuple[str, Array],
    stated: Collection[str],
) -> None:
    """The slope of a position is its velocity."""
    ratio = _ratio(t, position[1], velocity[1])
    for name, factor, degrees, radians in (
        (position[0], DEGREES, "deg", "rad"),
        (velocity[0], 1.0 / DEGREES, "deg/s", "rad/s"),
    ):
        if name not in stated and abs(ratio / factor - 1.0) < NEAR:
            raise RecordingError(
                f"{where}: the slope of {position[0]!r} is {ratio:.3g} times {velocity[0]!r}; {_advice(name, degrees, radians)}"
            )


def _advice(name: str, degrees: str, radians: str) -> str:
    return (
        f'{name!r} is probably in {degrees}: state unit = "{degrees}" for it in [recording.columns], '
        f'or unit = "{radians}" if it is not'
    )


def _ratio(t: Array, q: Array, v: Array) -> float:
    """Least-squares ratio of the slope of q to v, NaN where they are not one motion. All (M,)."""
    both = np.isfinite(q) & np.isfinite(v)
    t, q, v = t[both], q[both], v[both]
    if len(t) < 3:
        return float("nan")
    dq, dv, _ = ways(t, q, v, STRETCH, max(1, len(t) // 10))
    square = float(dv @ dv)
    together = float(dq @ dv)
    if square <= 0.0 or together < ALIKE * np.sqrt(square * float(dq @ dq)):
        return float("nan")
    return together / square


def _check_range(where: str, name: str, q: Array, limits: Array) -> None:
    """Beyond the joint's range by far, and inside of it as degrees."""
    low, high = (float(x) for x in limits)
    largest, smallest = float(np.nanmax(q)), float(np.nanmin(q))
    slack = NEAR * (high - low)
    inside = low - slack <= smallest / DEGREES and largest / DEGREES <= high + slack
    if max(abs(largest), abs(smallest)) > BEYOND * max(abs(low), abs(high)) and inside:
        raise RecordingError(
            f"{where}: column {name!r} goes from {smallest:g} to {largest:g}, its joint from {low:g} to {high:g} rad; "
            f"{_advice(name, 'deg', 'rad')}"
        )


def _fastest(t: Array, q: Array) -> float:
    """Largest slope [per s] between rows that have a value."""
    there = np.isfinite(q)
    steps = np.diff(t[there])
    return float(np.abs(np.diff(q[there]) / steps).max()) if len(steps) else 0.0
