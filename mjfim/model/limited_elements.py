"""Which joints, actuators and tendons of a model can have which limits."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from typing import Any, Literal

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.model.coordinates import ROTATION_VECTOR, TRANSLATION, actuator_names, joint_names
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    actuator_force_sizes,
    control_sizes,
    force_sizes,
    model_length,
    position_sizes,
    unique_names,
)
from mjfim.model.units import (
    ANGLE,
    FORCE_UNITS,
    LENGTH,
    control_units,
    force_unit,
    joint_unit,
    per_second,
)

Range = tuple[float, float]

# What each kind limits: the element that has a name, and its elements in words.
OWNERS: dict[str, tuple[Literal["joint", "actuator", "tendon"], str]] = {
    "position": ("joint", "slides, hinges, ball joints and free joints"),
    "tilt": ("joint", "ball joints and free joints"),
    "velocity": ("joint", "slides, hinges, ball joints and free joints"),
    "angular_velocity": ("joint", "ball joints and free joints"),
    "acceleration": ("joint", "slides, hinges, ball joints and free joints"),
    "control": ("actuator", "controls"),
    "control_rate": ("actuator", "controls"),
    "force": ("actuator", "actuators"),
    "joint_force": ("joint", "slides and hinges"),
    "tendon_force": ("tendon", "tendons with an actuator"),
    "tendon_length": ("tendon", "tendons"),
}

# Kinds of limits, in the order in which they are listed.
KINDS = tuple(OWNERS)

BALL = int(mujoco.mjtJoint.mjJNT_BALL)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)

# Joints in words.
JOINT_WORDS = {
    int(mujoco.mjtJoint.mjJNT_SLIDE): "a slide",
    int(mujoco.mjtJoint.mjJNT_HINGE): "a hinge",
    BALL: "a ball joint",
    FREE: "a free joint",
}

# Number of numbers that describe the tilt: both components of a rotation that tilt the body.
TILT_COMPONENTS = 2


@record
class LimitedElement:
    """One element that can have a limit of some kind.

    Attributes:
        index: Address of the limited number, or of the first of them: in qpos, qvel, ctrl,
            actuator_force or qfrc_actuator. For a tilt it is the quaternion in qpos, for a tendon
            its number.
        count: Number of numbers; with several of them, their norm is limited, which is a speed, a
            force or the sine of half an angle.
        unit: Unit of the quantity; empty where the model does not determine it.
        size: Natural size of the quantity [unit of the kind].
        stated: Range of the MJCF, or None.
        is_part: True for one coordinate of a ball or free joint, for one force of an actuator and
            for joints of physical terms. A number without a table does not hold for it.
    """

    index: int
    count: int = 1
    unit: str = ""
    size: float = 1.0
    stated: Range | None = None
    is_part: bool = False


@record
class LimitedElements:
    """All elements of a model that can have limits.

    Attributes:
        by_kind: Elements by kind and name; the kinds have the order of `KINDS`.
        joints: What each joint is, in words by name.
    """

    by_kind: dict[str, dict[str, LimitedElement]] = field(
        default_factory=lambda: {kind: {} for kind in KINDS}
    )
    joints: Mapping[str, str]

    def kinds_of(self, name: str) -> tuple[str, ...]:
        """Kinds of limits that a joint can have, by its name."""
        return tuple(
            kind
            for kind, elements in self.by_kind.items()
            if OWNERS[kind][0] == "joint" and (name in elements or f"{name}.x" in elements)
        )


def limited_elements(
    model: Any, controls: tuple[str, ...], period: float, added: Collection[int] = ()
) -> LimitedElements:
    """Look up all elements of a model that can have limits.

    Args:
        model: MjModel.
        controls: Names of its nu controls.
        period: Sample period, from which the natural sizes of rates follow [s].
        added: Addresses in qpos of joints that physical terms have added.
    """
    words = [JOINT_WORDS[kind] for kind in model.jnt_type.tolist()]
    names = joint_names(model)
    found = LimitedElements(joints=dict(zip(names, words, strict=True)))
    time = period / LEAST_MOVE_PER_SAMPLE

    sizes = position_sizes(model)
    forces = force_sizes(model, time)
    for joint, name in enumerate(names):
        is_part = int(model.jnt_qposadr[joint]) in added
        _add_joint(found, model, joint, name, sizes, time, is_part=is_part)
        if model.jnt_type[joint] not in (BALL, FREE):
            dof = int(model.jnt_dofadr[joint])
            found.by_kind["joint_force"][name] = LimitedElement(
                index=dof,
                unit=FORCE_UNITS[joint_unit(model, joint)],
                size=float(forces[dof]),
                stated=_range(model.jnt_actfrclimited, model.jnt_actfrcrange, joint),
                is_part=is_part,
            )

    widths = control_sizes(model, time)
    for i, (name, unit) in enumerate(zip(controls, control_units(model), strict=True)):
        size = float(widths[i])
        found.by_kind["control"][name] = LimitedElement(
            index=i,
            unit=unit,
            size=size,
            stated=_range(model.actuator_ctrllimited, model.actuator_ctrlrange, i),
        )
        found.by_kind["control_rate"][name] = LimitedElement(
            index=i, unit=per_second(unit) if unit else "", size=size / time
        )
    _add_actuators(found, model, time)
    _add_tendons(found, model, time)
    return found


def actuators_of_tendons(model: Any) -> list[tuple[int, ...]]:
    """Addresses in actuator_force of the actuators that pull at each tendon of a model."""
    pulls = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    found: list[tuple[int, ...]] = [()] * model.ntendon
    for i in np.flatnonzero(pulls):
        found[model.actuator_trnid[i, 0]] += (int(model.actuator_outadr[i]),)
    return found


def _add_joint(
    found: LimitedElements,
    model: Any,
    joint: int,
    name: str,
    sizes: Array,
    time: float,
    *,
    is_part: bool,
) -> None:
    """Enter the motion of one joint.

    Args:
        found: The elements, changed in place.
        model: MjModel.
        joint: Number of the joint.
        name: Its name.
        sizes: (nv,) natural sizes of the degrees of freedom [m or rad].
        time: Natural time of a motion [s].
        is_part: Whether a physical term has added it.
    """
    kinds = found.by_kind
    kind = model.jnt_type[joint]
    q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    stated = _range(model.jnt_limited, model.jnt_range, joint)
    size = float(sizes[v])
    count = 3 if kind in (BALL, FREE) else 1

    # The range of a ball joint in the MJCF is its largest angle of rotation. It is no limit where
    # it is half a turn or more.
    if kind == BALL and stated is not None and stated[1] >= np.pi:
        stated = None
    unit = joint_unit(model, joint)
    rate = per_second(unit)
    # The velocity of a free joint is that of its translation.
    whole = LimitedElement(index=q, count=count, unit=unit, size=size, is_part=is_part)
    speed = replace(whole, index=v, unit=rate, size=size / time)
    motion = {
        "position": replace(whole, stated=stated),
        "velocity": speed,
        "acceleration": replace(speed, unit=f"{rate}²", size=size / time**2),
    }
    for limited, whole in motion.items():
        # The coordinates of a free joint have ranges, its position as a whole has none.
        if kind != FREE or limited != "position":
            kinds[limited][name] = whole
        if kind == FREE:
            kinds[limited] |= _parts(whole, name, TRANSLATION)

    if kind not in (BALL, FREE):
        return
    first = v + QUATERNION_PLACE[kind]
    turn = LimitedElement(index=first, count=3, unit=per_second(ANGLE), size=1.0 / time)
    kinds["angular_velocity"][name] = turn
    kinds["angular_velocity"] |= _parts(turn, name, ROTATION_VECTOR)
    address = quaternion_address(model, joint)
    kinds["tilt"][name] = LimitedElement(index=address, count=TILT_COMPONENTS, unit=ANGLE)


def _parts(whole: LimitedElement, name: str, parts: Sequence[str]) -> dict[str, LimitedElement]:
    """The single coordinates of a vector of a joint, by `<joint>.<part>`."""
    return {
        f"{name}.{part}": replace(whole, index=whole.index + i, count=1, is_part=True)
        for i, part in enumerate(parts)
    }


def _add_actuators(found: LimitedElements, model: Any, time: float) -> None:
    """Enter the forces of the actuators that have a control.

    The range of an actuator with several forces limits their norm.
    """
    sizes = actuator_force_sizes(model, time)
    forces = found.by_kind["force"]
    for i, name in enumerate(actuator_names(model)):
        if not model.actuator_ctrlnum[i]:
            continue
        first, count = int(model.actuator_outadr[i]), int(model.actuator_outnum[i])
        unit = force_unit(model, i)
        # The forces on a ball or free joint have several units.
        if unit and model.jnt_type[model.actuator_trnid[i, 0]] in (BALL, FREE):
            unit = ""
        forces[name] = LimitedElement(
            index=first,
            count=count,
            unit=unit,
            size=float(sizes[first]),
            stated=_range(model.actuator_forcelimited, model.actuator_forcerange, i),
        )
        if count > 1:
            for part in range(count):
                address = first + part
                each = LimitedElement(index=address, size=float(sizes[address]), is_part=True)
                forces[f"{name}[{part}]"] = each


def _add_tendons(found: LimitedElements, model: Any, time: float) -> None:
    """Enter the lengths of the tendons, and the sums of the forces of their actuators."""
    sizes, length = actuator_force_sizes(model, time), model_length(model)
    names = unique_names(model, "tendon")
    for i, (name, pulling) in enumerate(zip(names, actuators_of_tendons(model), strict=True)):
        # A tendon is a path in space, or a sum of joint coordinates.
        is_spatial = model.wrap_type[model.tendon_adr[i]] != mujoco.mjtWrap.mjWRAP_JOINT
        found.by_kind["tendon_length"][name] = LimitedElement(
            index=i,
            unit=LENGTH if is_spatial else "",
            size=float(abs(model.tendon_length0[i])) or length,
            stated=_range(model.tendon_limited, model.tendon_range, i),
        )
        if pulling:
            found.by_kind["tendon_force"][name] = LimitedElement(
                index=i,
                unit=FORCE_UNITS[LENGTH] if is_spatial else "",
                size=float(sizes[list(pulling)].max()),
                stated=_range(model.tendon_actfrclimited, model.tendon_actfrcrange, i),
            )


def _range(limited: Any, ranges: Any, index: int) -> Range | None:
    """Range of an element in the MJCF, or None.

    Args:
        limited: (n,) nonzero where the model limits an element.
        ranges: (n, 2) ranges of all elements.
        index: Number of the element.
    """
    if not limited[index]:
        return None
    lower, upper = ranges[index].tolist()
    return lower, upper


# Kinds of joints whose position holds a quaternion, with the place of the quaternion in it.
QUATERNION_PLACE = {BALL: 0, FREE: 3}


def turn_weights(model: Any, joint: int) -> Array:
    """Weights of the rotation of a joint from its reference position.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of a ball joint or of a free joint.

    Returns:
        (3, 4) matrix that makes of the quaternion of the joint the vector part of its rotation from
        `qpos0`, in the frame of the body.
    """
    address = quaternion_address(model, joint)
    reference = np.array(model.qpos0[address : address + 4])
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
    rotation = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
    up = -model.opt.gravity if model.opt.gravity.any() else np.array([0.0, 0.0, 1.0])
    _, _, directions = np.linalg.svd((rotation.T @ up / np.linalg.norm(up))[None])
    return directions[1:] @ turn_weights(model, joint)


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
    place = QUATERNION_PLACE[model.jnt_type[joint]]
    return int(model.jnt_qposadr[joint]) + place
