"""Contacts, joint limits and actuator clamps that are active along a trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from mjfim.model.coordinates import actuator_names, joint_names
from mjfim.records.trajectory import Trajectory

CLAMPED = 1e-12  # relative distance from its bound at which a force counts as clamped


def forwarded(
    model: Any, trajectory: Trajectory, samples: Iterable[int]
) -> Iterator[tuple[int, Any]]:
    """Each sample k with MjData at which everything is computed; one MjData serves them all."""
    data = mujoco.MjData(model)
    for k in samples:
        data.qpos[:], data.qvel[:], data.act[:] = (
            trajectory.qpos[k],
            trajectory.qvel[k],
            trajectory.act[k],
        )
        data.ctrl[:] = trajectory.ctrl[k]
        mujoco.mj_forward(model, data)
        yield k, data


def clamped(model: Any, data: Any) -> list[int]:
    """Ids of actuators whose force is clamped by forcerange at this moment."""
    return [
        i for i in np.flatnonzero(model.actuator_forcelimited).tolist() if _clamped(model, data, i)
    ]


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
    force, (low, high) = (
        data.actuator_force[first : first + count],
        model.actuator_forcerange[actuator],
    )
    if count == 1:
        return bool(force[0] <= low or force[0] >= high)
    return bool(np.linalg.norm(force) >= high * (1.0 - CLAMPED))


def first_active(model: Any, trajectory: Trajectory) -> tuple[int, tuple[str, ...]] | None:
    """First sample at which a contact, friction, limit or clamp acts, and what; None where none ever does."""
    for k, data in forwarded(model, trajectory, range(trajectory.samples)):
        causes = (*sorted(set(_at(model, data))), *_ranges(model, clamped(model, data)))
        if causes:
            return k, causes
    return None


def _active(model: Any, trajectory: Trajectory, samples: range) -> Iterator[str]:
    """Contacts, frictions, limits and clamps that act at these samples, each once."""
    told, hit = set[str](), set[int]()
    for _, data in forwarded(model, trajectory, samples):
        told.update(_at(model, data))
        hit.update(clamped(model, data))
    yield from sorted(told)
    yield from _ranges(model, hit)


def _ranges(model: Any, actuators: Iterable[int]) -> Iterator[str]:
    names = actuator_names(model)
    yield from (f"force range of {names[i]}" for i in sorted(actuators))


def _at(model: Any, data: Any) -> Iterator[str]:
    for contact in data.contact[: data.ncon]:
        names = (
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or f"geom{g}"
            for g in contact.geom
        )
        yield f"contact {' - '.join(names)}"
    joints = joint_names(model)
    for kind, ident in zip(data.efc_type, data.efc_id, strict=True):
        if kind == int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF):
            yield f"dry friction of {joints[model.dof_jntid[ident]]}"
        elif kind == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT):
            yield f"limit of {joints[ident]}"
        elif kind in (
            int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON),
            int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON),
        ):
            yield f"friction or limit of tendon {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, ident) or ident}"
