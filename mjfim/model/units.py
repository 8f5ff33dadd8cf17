"""Units of joints, sensors, controls and model fields: every table of the units of a model.

The units of the ten inertial parameters of a body are defined in `mjfim.model.inertia`.
"""

from __future__ import annotations

from typing import Any, Literal

import mujoco

# Unit of the coordinate of a slide joint and of every other translation.
LENGTH = "m"

# Unit of the coordinate of a hinge joint and of every other rotation.
ANGLE = "rad"

# Unit of each part of a ball or free joint: of the translation, of the rotation vector and of the
# quaternion, which is dimensionless.
PART_UNITS = {
    **dict.fromkeys(("x", "y", "z"), LENGTH),
    **dict.fromkeys(("rx", "ry", "rz"), ANGLE),
    **dict.fromkeys(("qw", "qx", "qy", "qz"), ""),
}

# Unit of the generalised force at a coordinate, by the unit of the coordinate.
FORCE_UNITS = {LENGTH: "N", ANGLE: "N m"}

# Units of the fields of a joint, by the unit of its coordinate.
JOINT_FIELD_UNITS = {
    "damping": {LENGTH: "N s/m", ANGLE: "N m s/rad"},
    "frictionloss": FORCE_UNITS,
    "armature": {LENGTH: "kg", ANGLE: "kg m²"},
    "stiffness": {LENGTH: "N/m", ANGLE: "N m/rad"},
    "springref": {LENGTH: LENGTH, ANGLE: ANGLE},
}

# Units of the coefficients of higher order of forces that are polynomials, by the order above 1.
POLYNOMIAL_UNITS = {
    "damping": {
        LENGTH: ("N s²/m²", "N s³/m³"),
        ANGLE: ("N m s²/rad²", "N m s³/rad³"),
    },
    "stiffness": {LENGTH: ("N/m²", "N/m³"), ANGLE: ("N m/rad²", "N m/rad³")},
}

# Fields of a joint whose units those of the gains of a servo at the joint have.
FIELD_OF_GAIN = {"kp": "stiffness", "kv": "damping"}

# Units of the other fields that a parameter path can name. Fields that are absent here have no unit
# or one that depends on the model.
FIELD_UNITS = {
    "mass": "kg",
    "pos": "m",
    "ipos": "m",
    "inertia": "kg m²",
    "size": "m",
    "gravity": "m/s²",
    "wind": "m/s",
    "density": "kg/m³",
    "viscosity": "Pa s",
    "rot": "rad",
    "delay": "s",
}

# Units of sensors, by MuJoCo's names. Sensors that are absent here have no unit or one that depends
# on the model.
SENSOR_UNITS = {
    **dict.fromkeys(("TENDONPOS", "RANGEFINDER", "FRAMEPOS", "SUBTREECOM"), "m"),
    **dict.fromkeys(("VELOCIMETER", "TENDONVEL", "FRAMELINVEL", "SUBTREELINVEL"), "m/s"),
    **dict.fromkeys(("ACCELEROMETER", "FRAMELINACC"), "m/s²"),
    **dict.fromkeys(("GYRO", "FRAMEANGVEL", "BALLANGVEL"), "rad/s"),
    "FRAMEANGACC": "rad/s²",
    **dict.fromkeys(("FORCE", "TOUCH"), "N"),
    "TORQUE": "N m",
    "MAGNETOMETER": "T",
}


def per_second(unit: str) -> str:
    """Unit of the rate of change of a quantity with this unit."""
    return f"{unit}/s"


def joint_unit(model: Any, joint: int) -> str:
    """Unit of the first coordinate of a joint.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of the joint.

    Returns:
        Metres for slide and free joints, radians for hinge and ball joints.
    """
    translating = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_FREE)
    return LENGTH if int(model.jnt_type[joint]) in translating else ANGLE


def sensor_unit(model: Any, sensor: int) -> str:
    """Unit of a sensor.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        sensor: Number of the sensor.

    Returns:
        The unit; empty where the sensor is dimensionless or its unit depends on the model.
    """
    name = mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_")
    if name not in ("JOINTPOS", "JOINTLIMITPOS", "JOINTVEL", "JOINTLIMITVEL"):
        return SENSOR_UNITS.get(name, "")
    unit = joint_unit(model, model.sensor_objid[sensor])
    return per_second(unit) if name.endswith("VEL") else unit


def force_unit(model: Any, actuator: int) -> str:
    """Unit of the force of an actuator.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.

    Returns:
        The unit; empty where the actuator does not act on a joint.
    """
    if model.actuator_trntype[actuator] != mujoco.mjtTrn.mjTRN_JOINT:
        return ""
    return FORCE_UNITS[joint_unit(model, model.actuator_trnid[actuator, 0])]


def gain_unit(model: Any, actuator: int, field: str) -> str:
    """Unit of the gain `kp` or `kv` of a servo.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
        field: Name of the gain.

    Returns:
        The unit; empty where the servo does not act with a gear of 1 on a slide or hinge.
    """
    if not acts_at_joint(model, actuator) or actuator_gear(model, actuator) != 1:
        return ""

    joint = int(model.actuator_trnid[actuator, 0])
    if int(model.jnt_type[joint]) not in SCALAR_JOINTS:
        return ""
    return JOINT_FIELD_UNITS[FIELD_OF_GAIN[field]][joint_unit(model, joint)]


def joint_field_unit(field: str, coordinate: str, order: int) -> str:
    """Unit of a field of a joint.

    Args:
        field: Field of a path, such as `damping`.
        coordinate: Unit of the joint's coordinate.
        order: Index of the coefficient of a force that is a polynomial, from 0.

    Returns:
        The unit; empty where the field has none.
    """
    if order == 0:
        return JOINT_FIELD_UNITS.get(field, {}).get(coordinate, "")
    units = POLYNOMIAL_UNITS.get(field, {}).get(coordinate, ())
    return units[order - 1] if order <= len(units) else ""


def control_unit(model: Any, actuator: int) -> str:
    """Unit of the control of an actuator; the units of several controls are not evident.

    It is evident for actuators that act on one joint with a gear of 1: a direct drive (gain 1, no
    bias) takes a force, a position servo the joint's coordinate, and a velocity servo its rate. The
    control of an actuator that integrates it has the unit of the rate.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.

    Returns:
        The unit; empty where it is not evident from the model.
    """
    gear = actuator_gear(model, actuator)
    at_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    if not at_joint or gear != 1 or model.actuator_ctrlnum[actuator] != 1:
        return ""

    joint = int(model.actuator_trnid[actuator, 0])
    coordinate = joint_unit(model, joint)
    gain = model.actuator_gainprm[actuator, 0]
    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE:
        unit = FORCE_UNITS[coordinate] if gain == 1.0 else ""
    else:
        units = {"position": coordinate, "velocity": per_second(coordinate)}
        unit = units.get(servo_kind(model, actuator) or "", "")
    return per_second(unit) if unit and is_integrated(model, actuator) else unit


def control_units(model: Any) -> list[str]:
    """Units of the nu controls, see `control_unit`."""
    counts = model.actuator_ctrlnum.tolist()
    return [unit for i, n in enumerate(counts) for unit in n * [control_unit(model, i)]]


Servo = Literal["position", "velocity"]

# Types of bias whose entries 1 and 2 multiply the position and the velocity.
AFFINE = (mujoco.mjtBias.mjBIAS_AFFINE, mujoco.mjtBias.mjBIAS_SO3)

# Joints with one coordinate, and transmissions to a joint.
SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
AT_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


def servo_kind(model: Any, actuator: int) -> Servo | None:
    """Kind of a servo, by its gain and its bias; None for other actuators.

    A position servo has `biasprm[1] = -gain`; a velocity servo has `biasprm[2] = -gain` and no
    other bias. An actuator without gain and bias counts as a position servo.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    if int(model.actuator_biastype[actuator]) not in AFFINE:
        return None

    gain = model.actuator_gainprm[actuator, 0]
    bias = model.actuator_biasprm[actuator]
    if bias[1] == -gain:
        return "position"
    if gain != 0.0 and bias[1] == 0.0 and bias[2] == -gain:
        return "velocity"
    return None


def is_integrated(model: Any, actuator: int) -> bool:
    """Whether the control of an actuator is the rate of its activation.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    return bool(model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_INTEGRATOR)


def acts_at_joint(model: Any, actuator: int) -> bool:
    """Return whether an actuator acts on a single joint.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    return int(model.actuator_trntype[actuator]) in AT_JOINT


def commanded_joint(model: Any, actuator: int) -> int | None:
    """Slide or hinge whose position, times the gear, the control of an actuator commands.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.

    Returns:
        Number of the joint; None for all but position servos with one control at such a joint.
    """
    if not acts_at_joint(model, actuator) or model.actuator_ctrlnum[actuator] != 1:
        return None
    if is_integrated(model, actuator) or servo_kind(model, actuator) != "position":
        return None

    joint = int(model.actuator_trnid[actuator, 0])
    is_scalar = int(model.jnt_type[joint]) in SCALAR_JOINTS
    has_gain = model.actuator_gainprm[actuator, 0] != 0.0
    return joint if is_scalar and has_gain and actuator_gear(model, actuator) != 0.0 else None


def actuator_gear(model: Any, actuator: int) -> float:
    """First gear of an actuator: its length over the coordinate of a slide or hinge.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    return float(model.actuator_gear[model.actuator_outadr[actuator], 0])
