"""Rotation of ball and free joints: linear functions of the quaternion whose norm is a half sine.

A unit quaternion q that turns by an angle a about an axis has a vector part of length sin(a/2). Its
two components perpendicular to a direction e have the length sin(t/2), where t is the tilt: the
angle between e and e turned by q. Unlike the angles, these components are smooth everywhere.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array

# Kinds of joints whose position holds a quaternion, with the place of the quaternion in it.
QUATERNION_PLACE = {
    int(mujoco.mjtJoint.mjJNT_BALL): 0,
    int(mujoco.mjtJoint.mjJNT_FREE): 3,
}


def upward(model: Any) -> Array:
    """Direction against gravity in the world; the z axis without gravity.

    Args:
        model: The compiled model (`mujoco.MjModel`).

    Returns:
        (3,) unit vector.
    """
    gravity = np.array(model.opt.gravity)
    size = float(np.linalg.norm(gravity))
    return -gravity / size if size > 0.0 else np.array([0.0, 0.0, 1.0])


def turn_weights(model: Any, joint: int) -> Array:
    """Weights of the rotation of a joint from its reference position.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of a ball joint or of a free joint.

    Returns:
        (3, 4) matrix that makes of the quaternion of the joint the vector part of its rotation from
        `qpos0`, in the frame of the body.
    """
    reference = _reference(model, joint)
    reference[1:] *= -1.0

    weights = np.zeros((4, 4))
    product = np.zeros(4)
    for i, unit in enumerate(np.eye(4)):
        mujoco.mju_mulQuat(product, reference, unit)
        weights[:, i] = product
    return weights[1:]


def tilt_weights(model: Any, joint: int) -> Array:
    """Weights of the tilt of a joint.

    The tilt is the angle between the upward direction and the direction in the body that is upward
    in the reference position `qpos0`. For a ball joint it is measured in the parent.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of a ball joint or of a free joint.

    Returns:
        (2, 4) matrix that makes of the quaternion of the joint two numbers, whose norm is the sine
        of half the tilt.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)

    # The upward direction in the frame of the body, and two directions perpendicular to it.
    rotation = data.xmat[int(model.jnt_bodyid[joint])].reshape(3, 3)
    up = rotation.T @ upward(model)
    _, _, directions = np.linalg.svd(up[None])
    return np.asarray(directions[1:] @ turn_weights(model, joint))


def quaternion_joints(model: Any) -> list[int]:
    """Numbers of the ball joints and of the free joints.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    return [j for j, kind in enumerate(model.jnt_type.tolist()) if kind in QUATERNION_PLACE]


def quaternion_address(model: Any, joint: int) -> int:
    """Address in qpos of the quaternion of a ball joint or of a free joint.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of the joint.
    """
    place = QUATERNION_PLACE[int(model.jnt_type[joint])]
    return int(model.jnt_qposadr[joint]) + place


def _reference(model: Any, joint: int) -> Array:
    """(4,) quaternion of a joint in the reference position."""
    address = quaternion_address(model, joint)
    return np.array(model.qpos0[address : address + 4])
