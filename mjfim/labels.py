"""Names with units for axes and panels, such as `slide [m]`, made from a model and an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco

from mjfim.errors import MjfimError
from mjfim.models import actuator_names, joint_names
from mjfim.setup import Setup

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
class Labels:
    """What each column is called, unit included.

    qpos: nq, one per coordinate;  positions, velocities: nv, one per degree of freedom;  controls: nu
    parameters: p names without unit;  parameter_units: p units, empty where dimensionless
    outputs: `name [unit]` by output column (`qpos:<joint>`, sensor name);  missing ones show the column name
    """

    qpos: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    controls: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    parameter_units: tuple[str, ...] = ()
    outputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names, units = len(self.parameters), len(self.parameter_units)
        if names != units:
            raise MjfimError(f"labels name {names} parameters but {units} units; give one unit (or '') per parameter")

    @classmethod
    def of_model(cls, model: mujoco.MjModel) -> Labels:
        """Names of joints and actuators; rotations of ball and free joints are rotation vectors."""
        dofs = [
            (_joint_name(model, joint) + suffix, unit)
            for joint in range(model.njnt)
            for suffix, unit in JOINT_DOFS[mujoco.mjtJoint(int(model.jnt_type[joint]))]
        ]
        positions = tuple(f"{name} [{unit}]" for name, unit in dofs)
        return cls(
            qpos=positions if model.nq == model.nv else _coordinates(model),
            positions=positions,
            velocities=tuple(f"{name} velocity [{unit}/s]" for name, unit in dofs),
            controls=tuple(label for actuator in range(model.nactuator) for label in _control_labels(model, actuator)),
        )

    @classmethod
    def of(cls, setup: Setup) -> Labels:
        """Names of an experiment: its model's, its parameters' and its outputs'."""
        base = cls.of_model(setup.model)
        outputs = {name: output_label(setup.model, name) for name in setup.outputs.names}
        return cls(
            base.qpos, base.positions, base.velocities, base.controls, setup.parameters.names, setup.units, outputs
        )

    def parameter(self, j: int) -> str:
        """`name [unit]` of parameter j."""
        return f"{self.parameters[j]} [{self.parameter_units[j] or 'model unit'}]"

    def output(self, column: str) -> str:
        """`name [unit]` of an output column."""
        return self.outputs.get(column, f"{column} [model unit]")

    def check(self, **sizes: int) -> None:
        """Raise unless each named field has the given length."""
        for name, size in sizes.items():
            have = len(getattr(self, name))
            if have != size:
                raise MjfimError(f"labels.{name} has {have} entries, the data has {size}; give exactly {size}")


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
    return next((f"{output} [{unit}]" for unit, kinds in SENSOR_UNITS.items() if short in kinds), output)


def split_unit(label: str) -> tuple[str, str]:
    """Name and unit of a column called `name [unit]`."""
    plain, _, unit = label.partition(" [")
    return plain, unit.rstrip("]")
