"""Limits of an experiment: the MJCF's ranges and those that the file states, both hold where there are both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import ScalarJoint, actuator_names

Range = tuple[float, float]
JOINTS = (
    "position",
    "velocity",
    "acceleration",
    "joint_force",
)  # kinds by joint; the others are by actuator


@dataclass(frozen=True)
class Limit:
    """One scalar range.

    kind: position, velocity, acceleration, control, control_rate, force or joint_force
    index: place in qpos, qvel, qacc, ctrl, ctrl, actuator_force and qfrc_actuator, in this order
    """

    kind: str
    name: str
    index: int
    lower: float
    upper: float

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ExperimentError(
                f"limits.{self.kind}.{self.name}: [{self.lower:g}, {self.upper:g}] is inverted; needs lower < upper"
            )

    @property
    def scale(self) -> float:
        """Half of the range, what margins are compared with."""
        finite = [abs(b) for b in (self.lower, self.upper) if np.isfinite(b)]
        return 0.5 * (self.upper - self.lower) if len(finite) == 2 else max(*finite, 1.0)


def limits_of(
    model: Any, coordinates: tuple[ScalarJoint, ...], controls: tuple[str, ...], stated: Limits
) -> tuple[Limit, ...]:
    """All limits. Raises ExperimentError for unknown names, inverted ranges and ranges that exclude the MJCF's."""
    joints = {c.name: c for c in coordinates}
    scalar = {
        name: i
        for i, name in enumerate(actuator_names(model))
        if int(model.actuator_outnum[i]) == 1
    }
    tables = {
        "position": (
            stated.position,
            {c.name: c.q for c in coordinates},
            _position(model, coordinates),
        ),
        "velocity": (stated.velocity, {c.name: c.v for c in coordinates}, {}),
        "acceleration": (stated.acceleration, {c.name: c.v for c in coordinates}, {}),
        "control": (
            stated.control,
            {name: i for i, name in enumerate(controls)},
            _control(model, controls),
        ),
        "control_rate": (stated.control_rate, {name: i for i, name in enumerate(controls)}, {}),
        "force": (
            stated.force,
            {n: int(model.actuator_outadr[i]) for n, i in scalar.items()},
            _force(model, scalar),
        ),
        "joint_force": ({}, {c.name: c.v for c in coordinates}, _joint_force(model, joints)),
    }
    found: list[Limit] = []
    for kind, (wanted, index, given) in tables.items():
        found += _rows(kind, _ranges(kind, wanted, list(index)), index, given)
    return tuple(found)


def _ranges(
    kind: str, stated: float | Mapping[str, float | Range], names: list[str]
) -> dict[str, Range]:
    """Ranges by name from one number, or from a table of numbers and ranges."""
    table = stated if isinstance(stated, Mapping) else dict.fromkeys(names, stated)
    for name in table:
        if name not in names:
            raise ExperimentError(
                f"limits.{kind}: {unknown('joint' if kind in JOINTS else 'actuator', name, names)}"
            )
    return {name: v if isinstance(v, tuple) else (-v, v) for name, v in table.items()}


def _rows(
    kind: str, stated: Mapping[str, Range], index: Mapping[str, int], given: Mapping[str, Range]
) -> list[Limit]:
    rows = []
    for name, place in index.items():
        if name in stated:
            Limit(kind, name, place, *(float(b) for b in stated[name]))
        both = [table[name] for table in (stated, given) if name in table]
        if not both:
            continue
        lower, upper = float(max(low for low, _ in both)), float(min(high for _, high in both))
        if len(both) == 2 and not lower < upper:
            own, models = (f"[{low:g}, {high:g}]" for low, high in both)
            raise ExperimentError(
                f"limits.{kind}.{name}: {own} and the MJCF's range {models} exclude each other"
            )
        if np.isfinite(lower) or np.isfinite(upper):
            rows.append(Limit(kind, name, place, lower, upper))
    return rows


def _position(model: Any, coordinates: tuple[ScalarJoint, ...]) -> dict[str, Range]:
    return {
        c.name: tuple(model.jnt_range[c.joint]) for c in coordinates if model.jnt_limited[c.joint]
    }


def _control(model: Any, controls: tuple[str, ...]) -> dict[str, Range]:
    return {
        name: tuple(model.actuator_ctrlrange[i])
        for i, name in enumerate(controls)
        if model.actuator_ctrllimited[i]
    }


def _force(model: Any, scalar: Mapping[str, int]) -> dict[str, Range]:
    return {
        name: tuple(model.actuator_forcerange[i])
        for name, i in scalar.items()
        if model.actuator_forcelimited[i]
    }


def _joint_force(model: Any, joints: Mapping[str, ScalarJoint]) -> dict[str, Range]:
    limited = {name: c.joint for name, c in joints.items() if model.jnt_actfrclimited[c.joint]}
    return {name: tuple(model.jnt_actfrcrange[j]) for name, j in limited.items()}


def unsupported_ranges(model: Any) -> tuple[str, ...]:
    """What has a range in the MJCF that is not among the limits: ball joints, tendons, activations."""

    def named(kind: Any, rows: Any) -> list[str]:
        return [
            mujoco.mj_id2name(model, kind, i) or f"number {i}"
            for i in np.flatnonzero(rows).tolist()
        ]

    ball = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)) & (model.jnt_limited != 0)
    return (
        *(f"ball joint {name}" for name in named(mujoco.mjtObj.mjOBJ_JOINT, ball)),
        *(f"tendon {name}" for name in named(mujoco.mjtObj.mjOBJ_TENDON, model.tendon_limited)),
        *(
            f"the activation of {name}"
            for name in named(mujoco.mjtObj.mjOBJ_ACTUATOR, model.actuator_actlimited)
        ),
    )
