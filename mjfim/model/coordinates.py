"""Names and units of the coordinates of a model: joints, activations, controls, measurable outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco

from mjfim.model.paths import names_of

JOINT_DOFS = {
    mujoco.mjtJoint.mjJNT_SLIDE: (("", "m"),),
    mujoco.mjtJoint.mjJNT_HINGE: (("", "rad"),),
    mujoco.mjtJoint.mjJNT_BALL: ((".rx", "rad"), (".ry", "rad"), (".rz", "rad")),
    mujoco.mjtJoint.mjJNT_FREE: (
        *((f".{axis}", "m") for axis in "xyz"),
        *((f".r{axis}", "rad") for axis in "xyz"),
    ),
}


SENSOR_UNITS = {
    "m": ("JOINTLIMITPOS", "TENDONPOS", "RANGEFINDER", "FRAMEPOS", "SUBTREECOM"),
    "m/s": ("VELOCIMETER", "TENDONVEL", "FRAMELINVEL", "SUBTREELINVEL"),
    "m/s²": ("ACCELEROMETER", "FRAMELINACC"),
    "rad/s": ("GYRO", "FRAMEANGVEL", "BALLANGVEL"),
    "rad/s²": ("FRAMEANGACC",),
    "N": ("FORCE", "TOUCH"),
    "N m": ("TORQUE",),
    "T": ("MAGNETOMETER",),
}


QUATERNION = (".qw", ".qx", ".qy", ".qz")


@dataclass(frozen=True)
class ScalarJoint:
    """A scalar joint: its name, unit and place. joint: id;  q: qpos address;  v: dof address."""

    name: str
    unit: str
    joint: int
    q: int
    v: int


def scalar_joints(model: Any) -> tuple[ScalarJoint, ...]:
    """All slide and hinge joints, in order."""
    found, names = [], joint_names(model)
    for j in range(model.njnt):
        if int(model.jnt_type[j]) in (
            int(mujoco.mjtJoint.mjJNT_SLIDE),
            int(mujoco.mjtJoint.mjJNT_HINGE),
        ):
            unit = "m" if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            found.append(
                ScalarJoint(names[j], unit, j, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]))
            )
    return tuple(found)


def joint_names(model: Any) -> tuple[str, ...]:
    """njnt names; unnamed joints are called by their number."""
    return _names(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt, "joint")


def actuator_names(model: Any) -> tuple[str, ...]:
    """nactuator names; unnamed actuators are called by their number."""
    return _names(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nactuator, "actuator")


def _names(model: Any, kind: Any, count: int, fallback: str) -> tuple[str, ...]:
    """Names of all objects of a kind, no two alike: a number that another one is called by gets underscores."""
    given = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
    taken = {name for name in given if name}
    for i in range(count):
        if not given[i]:
            name = f"{fallback}{i}"
            while name in taken:
                name += "_"
            given[i] = name
    return tuple(given)


def control_names(model: Any) -> tuple[str, ...]:
    """nu names; an actuator with several controls gets one name per control."""
    names: list[str] = []
    for i, name in enumerate(actuator_names(model)):
        count = int(model.actuator_ctrlnum[i])
        names += [name] if count == 1 else [f"{name}[{c}]" for c in range(count)]
    return tuple(names)


def _coordinates(model: mujoco.MjModel) -> tuple[str, ...]:
    """One name per qpos of a model with quaternions."""
    names: list[str] = []
    for joint in range(model.njnt):
        name, kind = _joint_name(model, joint), mujoco.mjtJoint(int(model.jnt_type[joint]))
        if kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            names.append(f"{name} [{_joint_unit(model, joint)}]")
            continue
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            names += [f"{name}.{axis} [m]" for axis in "xyz"]
        names += [f"{name}{suffix} [1]" for suffix in QUATERNION]
    return tuple(names)


def _joint_name(model: mujoco.MjModel, joint: int) -> str:
    return joint_names(model)[joint]


def _joint_unit(model: mujoco.MjModel, joint: int) -> str:
    return JOINT_DOFS[mujoco.mjtJoint(int(model.jnt_type[joint]))][0][1]


def _control_labels(model: mujoco.MjModel, actuator: int) -> list[str]:
    """One label per control of an actuator, with the unit where it is plain: direct drives and position servos."""
    name, count = actuator_names(model)[actuator], int(model.actuator_ctrlnum[actuator])
    if count != 1:
        return [f"{name}[{c}] (control)" for c in range(count)]
    gear = model.actuator_gear[int(model.actuator_outadr[actuator]), 0]
    if int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT) or gear != 1:
        return [f"{name} (control)"]
    unit = _joint_unit(model, int(model.actuator_trnid[actuator, 0]))
    gain, bias = float(model.actuator_gainprm[actuator, 0]), model.actuator_biasprm[actuator]
    if int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE):
        return [f"{name} [{'N' if unit == 'm' else 'N m'}]" if gain == 1.0 else f"{name} (control)"]
    return [f"{name} [{unit}]" if bias[1] == -gain else f"{name} (control)"]


def output_label(model: mujoco.MjModel, output: str) -> str:
    """A measured column (`qpos:<joint>`, `qvel:<joint>` or a sensor) with its unit where that is known."""
    kind, _, joint = output.partition(":")
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    if kind in ("qpos", "qvel") and index >= 0:
        return f"{output} [{_joint_unit(model, index)}{'/s' if kind == 'qvel' else ''}]"
    sensor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, output.partition("[")[0])
    if sensor < 0:
        return output
    short = mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_")
    if short in ("JOINTPOS", "JOINTVEL"):
        unit = _joint_unit(model, int(model.sensor_objid[sensor]))
        return f"{output} [{unit}{'/s' if short == 'JOINTVEL' else ''}]"
    return next(
        (f"{output} [{unit}]" for unit, kinds in SENSOR_UNITS.items() if short in kinds), output
    )


def split_unit(label: str) -> tuple[str, str]:
    """Name and unit of a column called `name [unit]`."""
    plain, _, unit = label.partition(" [")
    return plain, unit.rstrip("]")


def activation_names(model: Any) -> tuple[str, ...]:
    """na columns `act:<actuator>`, with `[i]` where an actuator has several activations."""
    names = [""] * model.na
    for i, name in enumerate(actuator_names(model)):
        first, count = int(model.actuator_actadr[i]), int(model.actuator_actnum[i])
        for k in range(count):
            names[first + k] = f"act:{name}" if count == 1 else f"act:{name}[{k}]"
    return tuple(names)


def state_names(model: Any) -> tuple[str, ...]:
    """Columns of the state: `qpos:<joint>`, `qvel:<joint>` (with parts for ball and free joints), `act:<actuator>`."""
    return (*(c.name for c in state_components(model)), *activation_names(model))


def tangent_names(model: Any) -> tuple[str, ...]:
    """nx components of a deviation from the plan: as the state's columns, but `.rx`, `.ry`, `.rz` [rad] for rotations."""
    velocities = [c.name for c in state_components(model) if c.state >= model.nq]
    positions = [name.replace("qvel:", "qpos:", 1) for name in velocities]
    return (*positions, *velocities, *activation_names(model))


def gain_names(model: Any, controls: Sequence[str]) -> tuple[str, ...]:
    """Columns of K, row by row: `gain:<actuator>:<component>`."""
    return tuple(f"gain:{control}:{name}" for control in controls for name in tangent_names(model))


@dataclass(frozen=True)
class StateComponent:
    """One number of qpos or qvel that can be measured and recorded.

    name: its column, `qpos:<joint>` or `qpos:<joint>.<part>`;  keys: names of wholes that it belongs to
    state: address in the state vector (qpos, qvel, act)
    share: its sigma over the stated one; 1/2 for quaternions, whose four components then hold exactly the information of a
    rotation vector of the stated sigma [rad]
    """

    name: str
    keys: tuple[str, ...]
    state: int
    unit: str
    share: float = 1.0


def state_components(model: Any) -> tuple[StateComponent, ...]:
    """All of qpos, then all of qvel."""
    positions, velocities = [], []
    for j, name in enumerate(joint_names(model)):
        q, v, kind = (
            int(model.jnt_qposadr[j]),
            model.nq + int(model.jnt_dofadr[j]),
            int(model.jnt_type[j]),
        )
        qpos, qvel = f"qpos:{name}", f"qvel:{name}"
        if kind in (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)):
            unit = "m" if kind == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            positions.append(StateComponent(qpos, (), q, unit))
            velocities.append(StateComponent(qvel, (), v, f"{unit}/s"))
            continue
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            for i, axis in enumerate("xyz"):
                positions.append(
                    StateComponent(f"{qpos}.{axis}", (f"{qpos}.pos", qpos), q + i, "m")
                )
                velocities.append(
                    StateComponent(f"{qvel}.{axis}", (f"{qvel}.pos", qvel), v + i, "m/s")
                )
            q, v = q + 3, v + 3
        for i, axis in enumerate("wxyz"):
            positions.append(
                StateComponent(f"{qpos}.q{axis}", (f"{qpos}.rot", qpos), q + i, "", 0.5)
            )
        for i, axis in enumerate("xyz"):
            velocities.append(
                StateComponent(f"{qvel}.r{axis}", (f"{qvel}.rot", qvel), v + i, "rad/s")
            )
    return (*positions, *velocities)


def measurable_columns(model: Any) -> tuple[str, ...]:
    """Everything that a recording may hold column by column: state components and sensors."""
    return (
        *(c.name for c in state_components(model)),
        *(label for s in names_of(model, "sensor") for label in sensor_columns(model, s)),
    )


def sensor_columns(model: Any, sensor: str) -> list[str]:
    width = int(model.sensor(sensor).dim[0])
    return [sensor] if width == 1 else [f"{sensor}[{i}]" for i in range(width)]
