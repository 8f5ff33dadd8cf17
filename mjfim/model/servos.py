"""Servos among the actuators of a model: their kind, and the joint that a control commands."""

from __future__ import annotations

from typing import Any, Literal

import mujoco

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
    if mujoco.mjtBias(int(model.actuator_biastype[actuator])) not in AFFINE:
        return None

    gain = float(model.actuator_gainprm[actuator, 0])
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
    return int(model.actuator_dyntype[actuator]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)


def acts_at_joint(model: Any, actuator: int) -> bool:
    """Return whether an actuator acts on a single joint.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    return mujoco.mjtTrn(int(model.actuator_trntype[actuator])) in AT_JOINT


def commanded_joint(model: Any, actuator: int) -> int | None:
    """Slide or hinge whose position, times the gear, the control of an actuator commands.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.

    Returns:
        Number of the joint; None for all but position servos with one control at such a joint.
    """
    if not acts_at_joint(model, actuator) or int(model.actuator_ctrlnum[actuator]) != 1:
        return None
    if is_integrated(model, actuator) or servo_kind(model, actuator) != "position":
        return None

    joint = int(model.actuator_trnid[actuator, 0])
    is_scalar = mujoco.mjtJoint(int(model.jnt_type[joint])) in SCALAR_JOINTS
    has_gain = float(model.actuator_gainprm[actuator, 0]) != 0.0
    return joint if is_scalar and has_gain and actuator_gear(model, actuator) != 0.0 else None


def actuator_gear(model: Any, actuator: int) -> float:
    """First gear of an actuator: its length over the coordinate of a slide or hinge.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
    """
    return float(model.actuator_gear[int(model.actuator_outadr[actuator]), 0])
