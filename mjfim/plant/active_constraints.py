"""Contacts, joint limits, dry friction and actuator clamps that are active along a trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from mjfim.model.coordinates import actuator_names, joint_names
from mjfim.model.variants import unconstrained
from mjfim.records.trajectory import Trajectory

# An actuator with several forces counts as clamped where the norm of its forces is at most this
# relative amount below its bound.
CLAMP_TOLERANCE = 1e-12


def forward_samples(
    model: Any, trajectory: Trajectory, samples: Iterable[int]
) -> Iterator[tuple[int, Any]]:
    """Evaluate the forward dynamics at samples of a trajectory.

    Args:
        model: Compiled MuJoCo model.
        trajectory: The trajectory.
        samples: Indices of the samples.

    Yields:
        The sample and its MjData after `mj_forward`; the next sample overwrites it.
    """
    data = mujoco.MjData(model)
    for k in samples:
        data.qpos[:] = trajectory.qpos[k]
        data.qvel[:] = trajectory.qvel[k]
        data.act[:] = trajectory.act[k]
        data.ctrl[:] = trajectory.ctrl[k]
        mujoco.mj_forward(model, data)
        yield k, data


def clamped_actuators(model: Any, data: Any) -> list[int]:
    """Actuators whose force is clamped by forcerange.

    Args:
        model: Compiled MuJoCo model.
        data: Its MjData after `mj_forward`.

    Returns:
        Ids of the actuators.
    """
    # Passive devices have a force range that does not bound their friction.
    driven = model.actuator_ctrlnum > 0
    limited = np.flatnonzero(driven & (model.actuator_forcelimited > 0)).tolist()
    return [actuator for actuator in limited if _is_clamped(model, data, actuator)]


def saturated_actuators(model: Any, trajectory: Trajectory) -> tuple[str, ...]:
    """Actuators whose force is clamped by forcerange at some sample.

    Args:
        model: Compiled MuJoCo model at the parameters of the design.
        trajectory: The trajectory.

    Returns:
        Names of the actuators.
    """
    if not model.actuator_forcelimited.any():
        return ()
    found = set[int]()
    for _, data in forward_samples(model, trajectory, range(trajectory.samples)):
        found.update(clamped_actuators(model, data))
    names = actuator_names(model)
    return tuple(names[actuator] for actuator in sorted(found))


def first_active_constraint(
    model: Any, trajectory: Trajectory
) -> tuple[int, tuple[str, ...]] | None:
    """First sample at which a contact, dry friction, a limit or a clamp acts.

    Args:
        model: Compiled MuJoCo model.
        trajectory: The trajectory.

    Returns:
        The sample and descriptions of everything that acts there, or None if nothing ever acts.
    """
    for k, data in forward_samples(model, trajectory, range(trajectory.samples)):
        if acting := _descriptions(model, [data]):
            return k, acting
    return None


def nothing_acts_along(model: Any, trajectory: Trajectory, substeps: int) -> bool:
    """Whether it is certain that nothing touches, rubs, stops or clamps along a trajectory.

    Args:
        model: Compiled MuJoCo model.
        trajectory: The trajectory.
        substeps: Number of engine steps of a sample.
    """
    # Clamps of joints and tendons are not observed.
    if model.jnt_actfrclimited.any() or model.tendon_actfrclimited.any():
        return False

    # Between two samples, a contact may open and close again, and a force be clamped.
    may_act = not unconstrained(model) or model.actuator_forcelimited.any()
    if may_act and substeps > 1:
        return False
    return first_active_constraint(model, trajectory) is None


def active_constraints(
    model: Any, trajectory: Trajectory, samples: Iterable[int]
) -> tuple[str, ...]:
    """Contacts, dry frictions, limits and clamps that act at given samples.

    Args:
        model: Compiled MuJoCo model.
        trajectory: The trajectory.
        samples: Indices of the samples.

    Returns:
        Descriptions, each once.
    """
    return _descriptions(model, (data for _, data in forward_samples(model, trajectory, samples)))


def _descriptions(model: Any, states: Iterable[Any]) -> tuple[str, ...]:
    """Constraints that act at some of these states, each once, then force ranges that clamp."""
    constraints, clamped = set[str](), set[int]()
    for data in states:
        constraints.update(acting_constraints(model, data))
        clamped.update(clamped_actuators(model, data))
    names = actuator_names(model) if clamped else ()
    ranges = [f"force range of {names[actuator]}" for actuator in sorted(clamped)]
    return (*sorted(constraints), *ranges)


def _is_clamped(model: Any, data: Any, actuator: int) -> bool:
    """Whether forcerange clamps an actuator.

    It limits the force of the actuator, or the norm of its forces where it has several.
    """
    first = model.actuator_outadr[actuator]
    count = model.actuator_outnum[actuator]
    force = data.actuator_force[first : first + count]
    low, high = model.actuator_forcerange[actuator]
    if count == 1:
        return bool(force[0] <= low or force[0] >= high)
    return bool(np.linalg.norm(force) >= high * (1.0 - CLAMP_TOLERANCE))


def acting_constraints(model: Any, data: Any) -> Iterator[str]:
    """Descriptions of all contacts and of the frictions and limits that act."""
    for contact in data.contact[: data.ncon]:
        names = [
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"geom{geom}"
            for geom in contact.geom
        ]
        yield f"contact {' - '.join(names)}"

    joints = joint_names(model)
    tendon_kinds = (
        int(mujoco.mjtConstraint.mjCNSTR_FRICTION_TENDON),
        int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON),
    )
    for kind, ident in zip(data.efc_type, data.efc_id, strict=True):
        if kind == mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF:
            yield f"dry friction of {joints[model.dof_jntid[ident]]}"
        elif kind == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT:
            yield f"limit of {joints[ident]}"
        elif kind in tendon_kinds:
            tendon = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_TENDON, ident) or ident
            yield f"friction or limit of tendon {tendon}"
