"""MJCF models as the package sees them: loading, names, and the private copy that is stepped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ModelError


def load_spec(path: Path) -> Any:
    """MjSpec of an MJCF (or URDF) file. Raises ModelError with MuJoCo's message."""
    if not path.is_file():
        raise ModelError(f"{path}: no such model file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot read the model: {str(error).strip()}") from None


def compile_spec(spec: Any, path: Path) -> Any:
    """MjModel of a spec. Raises ModelError with MuJoCo's message."""
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{path}: MuJoCo cannot compile the model: {str(error).strip()}") from None


@dataclass(frozen=True)
class Coordinate:
    """A scalar joint: its name, unit and place. joint: id;  q: qpos address;  v: dof address."""

    name: str
    unit: str
    joint: int
    q: int
    v: int


def coordinates(model: Any) -> tuple[Coordinate, ...]:
    """All slide and hinge joints, in order."""
    found = []
    for j in range(model.njnt):
        if int(model.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)):
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint{j}"
            unit = "m" if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            found.append(Coordinate(name, unit, j, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])))
    return tuple(found)


def control_names(model: Any) -> tuple[str, ...]:
    """nu names; an actuator with several controls gets one name per control."""
    names: list[str] = []
    for i in range(model.nactuator):
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) or f"actuator{i}"
        count = int(model.actuator_ctrlnum[i])
        names += [name] if count == 1 else [f"{name}[{c}]" for c in range(count)]
    return tuple(names)


def private_model(spec: Any, path: Path, moved: Iterable[str], sensors: bool, friction: bool) -> Any:
    """A compiled copy for stepping: work that cannot matter is off, bodies that move inside are not 'simple'.

    moved: bodies whose inertial frame parameters change;  sensors: whether sensor data is wanted
    friction: whether a parameter is a frictionloss (the constraint solver must then stay on)
    """
    own = spec.copy()
    for name in moved:
        own.body(name).simple = 0
    model = compile_spec(own, path)
    if not sensors:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    if not friction and unconstrained(model):
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model


def unconstrained(model: Any) -> bool:
    """True where no constraint can ever be active, so that switching the solver off changes nothing."""
    no_contact = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)) or (
        model.npair == 0 and not (np.any(model.geom_contype) and np.any(model.geom_conaffinity))
    )
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    dry = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    return bool(no_contact and model.neq == 0 and model.nflex == 0 and not limited and not dry)
