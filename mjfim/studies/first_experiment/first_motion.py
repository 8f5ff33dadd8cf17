"""The first motion of an experiment: a chirp that stays within all ranges, or a release."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.coordinates import joint_dofs, tangent_components
from mjfim.model.elements import control_sizes, translations
from mjfim.model.units import actuator_gear, commanded_joint
from mjfim.studies.first_experiment.start import MARGIN, Start

# Share of the range of a control that the first trial uses to each side of the resting control.
RANGE_SHARE = 0.5

# Angle that a free rotation moves in the first trial [rad], and share of the robot's length that a
# free translation moves.
ANGLE = 0.5
LENGTH_SHARE = 0.5

# Factor between successive trials, and their number.
SHRINKING = 0.5
TRIALS = 16


def first_amplitudes(
    model: Any, start: Start, influence: Array, length: float, period: float
) -> Array:
    """Amplitudes of the controls with which the search begins.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: Initial state and resting control.
        influence: (nv, nu) derivatives of the accelerations by the controls.
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].

    Returns:
        (nu,) amplitudes: a share of the room within the control's range, or, without a range, what
        moves a joint by half a radian or by half of the robot's length. A control that rests at an
        end of its range gets 0.
    """
    distance = np.where(translations(model), LENGTH_SHARE * length, ANGLE)
    wanted = distance * (2.0 * np.pi / period) ** 2

    # A control that moves nothing in the start gets its natural size.
    amplitudes = control_sizes(model, period)
    for i in range(model.nu):
        if model.actuator_ctrllimited[i]:
            low, high = model.actuator_ctrlrange[i]
            room = min(start.control[i] - low, high - start.control[i])
            amplitudes[i] = RANGE_SHARE * max(room, 0.0)
        elif np.any(influence[:, i]):
            moved = np.abs(influence[:, i]) > 0.0
            amplitudes[i] = float((wanted[moved] / np.abs(influence[moved, i])).min())

    # The joint follows the control of a position servo.
    for actuator in range(model.nactuator):
        control = int(model.actuator_ctrladr[actuator])
        joint = commanded_joint(model, actuator)
        if joint is not None and not model.actuator_ctrllimited[control]:
            gear = abs(actuator_gear(model, actuator))
            amplitudes[control] = gear * float(distance[int(model.jnt_dofadr[joint])])

    return rounded(amplitudes)


def rounded(values: Array) -> Array:
    """Numbers with two significant digits."""
    return np.array([float(f"{value:.2g}") for value in values])


def largest_feasible(amplitudes: Array, feasible: Callable[[Array], bool]) -> Array | None:
    """Shrink amplitudes until a motion keeps all limits.

    Args:
        amplitudes: (nu,) amplitudes of the first trial.
        feasible: Whether the motion with some amplitudes keeps all limits.

    Returns:
        (nu,) amplitudes with two significant digits, or None where even tiny ones do not.
    """
    for trial in range(TRIALS):
        shrunk = rounded(amplitudes * SHRINKING**trial)
        if feasible(shrunk):
            return shrunk
    return None


# Angle by which a hinge or ball joint without a range may be released to each side of the start
# [rad].
RELEASE_ANGLE = 2.5

# Share of the way from the start to the farther end of a range at which the first release is.
FIRST_SHARE = 0.4

# Largest number of coordinates that a design chooses; more of them need too many simulations.
MOST_COORDINATES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class ProposedRelease:
    """Initial state from which a model without actuators is released at rest.

    Attributes:
        qpos: (nq,) positions of the release.
        free: Ranges of the coordinates that a design chooses, by name.
    """

    qpos: Array
    free: dict[str, tuple[float, float]]


def propose_release(
    model: Any, start: Array, length: float, share: float = FIRST_SHARE
) -> ProposedRelease:
    """Propose a release away from the start, inside the ranges of the joints.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: (nq,) positions of an equilibrium.
        length: Length of the robot [m].
        share: Share of the way from the start to the farther end of each range.

    Returns:
        The release; it has no coordinates where no joint with a name slides or turns.
    """
    components = {c.address: c for c in tangent_components(model)[: model.nv]}
    move = np.zeros(model.nv)
    free: dict[str, tuple[float, float]] = {}

    for j in range(model.njnt):
        if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE):
            continue
        first = int(model.jnt_dofadr[j])
        for dof in range(first, first + joint_dofs(model, j)):
            component = components[dof]
            if not component.path or len(free) == MOST_COORDINATES:
                continue
            at, low, high = _range_of(model, j, start, length)
            farther = high if high - at >= at - low else low
            move[dof] = share * (farther - at)
            free[component.name] = (low, high)

    qpos = np.array(start, dtype=np.float64)
    mujoco.mj_integratePos(model, qpos, move, 1.0)
    return ProposedRelease(qpos=_readable(model, qpos), free=free)


def _range_of(model: Any, joint: int, start: Array, length: float) -> tuple[float, float, float]:
    """Place at the start, and lower and upper end of the releases of a joint.

    The rotations of a ball joint are relative to the start.
    """
    kind = int(model.jnt_type[joint])
    if kind == int(mujoco.mjtJoint.mjJNT_BALL):
        return 0.0, -RELEASE_ANGLE, RELEASE_ANGLE

    at = float(start[int(model.jnt_qposadr[joint])])
    if model.jnt_limited[joint]:
        low, high = (float(end) for end in model.jnt_range[joint])
        gap = MARGIN * (high - low)
        return at, _rounded(low + gap), _rounded(high - gap)

    slides = kind == int(mujoco.mjtJoint.mjJNT_SLIDE)
    width = LENGTH_SHARE * length if slides else RELEASE_ANGLE
    return at, _rounded(at - width), _rounded(at + width)


def _readable(model: Any, qpos: Array) -> Array:
    """Positions whose slides and hinges have three significant digits."""
    found = np.array(qpos)
    for j in range(model.njnt):
        if joint_dofs(model, j) == 1:
            address = int(model.jnt_qposadr[j])
            found[address] = _rounded(float(qpos[address]))
    return found


def _rounded(value: float) -> float:
    """A number with three significant digits."""
    return float(f"{value:.3g}")
