"""Limits of an experiment: the MJCF's ranges unless the file states others, and how closely a trajectory keeps them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment import Limits
from mjfim.models import Coordinate, actuator_names
from mjfim.trajectory import Trajectory

Range = tuple[float, float]
CLAMPED = 1e-12  # relative distance from its bound at which a force counts as clamped


@dataclass(frozen=True)
class Limit:
    """One scalar range. kind: position, velocity or control;  index: column of the trajectory's array of that kind."""

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


def limits_of(
    model: Any, coordinates: tuple[Coordinate, ...], controls: tuple[str, ...], stated: Limits
) -> tuple[Limit, ...]:
    """All limits. Raises ExperimentError for unknown names and inverted ranges."""
    joints = {c.name: c for c in coordinates}
    for kind, table, valid in (
        ("position", stated.position, list(joints)),
        ("velocity", stated.velocity, list(joints)),
        ("control", stated.control, list(controls)),
    ):
        for name in table:
            if name not in valid:
                what = "actuator" if kind == "control" else "joint"
                raise ExperimentError(f"limits.{kind}: {unknown(what, name, valid)}")
    position: dict[str, Range] = {
        c.name: tuple(model.jnt_range[c.joint]) for c in coordinates if model.jnt_limited[c.joint]
    }
    control: dict[str, Range] = {
        name: tuple(model.actuator_ctrlrange[i]) for i, name in enumerate(controls) if model.actuator_ctrllimited[i]
    }
    velocity = {name: v if isinstance(v, tuple) else (-v, v) for name, v in stated.velocity.items()}
    return (
        *_rows("position", {**position, **stated.position}, {c.name: c.q for c in coordinates}),
        *_rows("velocity", velocity, {c.name: c.v for c in coordinates}),
        *_rows("control", {**control, **stated.control}, {name: i for i, name in enumerate(controls)}),
    )


def _rows(kind: str, table: Mapping[str, Range], index: Mapping[str, int]) -> list[Limit]:
    return [Limit(kind, name, index[name], float(low), float(high)) for name, (low, high) in table.items()]


def forwarded(model: Any, trajectory: Trajectory, samples: Iterable[int]) -> Iterator[tuple[int, Any]]:
    """Each sample k with MjData at which everything is computed; one MjData serves them all."""
    data = mujoco.MjData(model)
    for k in samples:
        data.qpos[:], data.qvel[:], data.act[:] = trajectory.qpos[k], trajectory.qvel[k], trajectory.act[k]
        data.ctrl[:] = trajectory.ctrl[k]
        mujoco.mj_forward(model, data)
        yield k, data


def clamped(model: Any, data: Any) -> list[int]:
    """Ids of actuators whose force is clamped by forcerange at this moment."""
    return [i for i in np.flatnonzero(model.actuator_forcelimited).tolist() if _clamped(model, data, i)]


def saturated(model: Any, trajectory: Trajectory) -> tuple[str, ...]:
    """Names of actuators whose force is clamped by forcerange at some sample. model: at the design's theta."""
    if not model.actuator_forcelimited.any():
        return ()
    names, every = actuator_names(model), range(trajectory.samples)
    hit = {i for _, data in forwarded(model, trajectory, every) for i in clamped(model, data)}
    return tuple(names[i] for i in sorted(hit))


def _clamped(model: Any, data: Any, actuator: int) -> bool:
    """True where forcerange acts: on the force, or on the norm of an actuator's several forces."""
    first, count = int(model.actuator_outadr[actuator]), int(model.actuator_outnum[actuator])
    force, (low, high) = data.actuator_force[first : first + count], model.actuator_forcerange[actuator]
    if count == 1:
        return bool(force[0] <= low or force[0] >= high)
    return bool(np.linalg.norm(force) >= high * (1.0 - CLAMPED))


def margins(limits: tuple[Limit, ...], trajectory: Trajectory) -> dict[str, float]:
    """Worst distance to each kind of limit over the samples, negative outside."""
    series = {"position": trajectory.qpos, "velocity": trajectory.qvel, "control": trajectory.ctrl}
    worst: dict[str, float] = {}
    for limit in limits:
        data = series[limit.kind][:, limit.index]
        margin = float(min((data - limit.lower).min(), (limit.upper - data).min()))
        worst[limit.kind] = min(margin, worst.get(limit.kind, margin))
    return worst
