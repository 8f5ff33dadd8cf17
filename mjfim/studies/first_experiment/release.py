"""The release of a model without actuators, and the ranges within which a design chooses it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.coordinates import joint_dofs, tangent_components
from mjfim.studies.first_experiment.start import MARGIN

# Angle by which a hinge or ball joint without a range may be released to each side of the start
# [rad], and share of the robot's length for a slide without a range.
ANGLE = 2.5
LENGTH_SHARE = 0.5

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
        return 0.0, -ANGLE, ANGLE

    at = float(start[int(model.jnt_qposadr[joint])])
    if model.jnt_limited[joint]:
        low, high = (float(end) for end in model.jnt_range[joint])
        gap = MARGIN * (high - low)
        return at, _rounded(low + gap), _rounded(high - gap)

    slides = kind == int(mujoco.mjtJoint.mjJNT_SLIDE)
    width = LENGTH_SHARE * length if slides else ANGLE
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
