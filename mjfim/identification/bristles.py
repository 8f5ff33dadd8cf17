"""Deflections of the bristles of friction in steady sliding, which the measured velocity shows.

The bristle of a `dcmotor` without control bends within a few steps until its force is that of
steady sliding (Canudas de Wit et al., A new model for control of systems with friction, IEEE TAC
1995): `stiffness z = sgn(v) (coulomb + (static - coulomb) exp(-(v/speed)²))`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.sizes import BRISTLE_STIFFNESS_COLUMN, bristle_actuators
from mjfim.model.units import actuator_gear

# Columns of the friction of a `dcmotor` in its bias: Coulomb, static, Stribeck speed.
FRICTION_COLUMNS = slice(3, 6)


@dataclass(frozen=True, kw_only=True)
class Bristle:
    """The bristle of one passive device at a slide or hinge.

    Attributes:
        actuator: Number of the device among the actuators.
        address: Address of its deflection among the activations.
        dof: Degree of freedom of its joint.
    """

    actuator: int
    address: int
    dof: int

    def speed(self, model: Any, qvel: Array) -> Array:
        """(n,) speeds of the device.

        Args:
            model: The compiled model (`mujoco.MjModel`).
            qvel: (n, nv) velocities [m/s or rad/s].
        """
        return np.asarray(actuator_gear(model, self.actuator) * qvel[:, self.dof])

    def friction(self, model: Any) -> tuple[float, ...]:
        """Stiffness, Coulomb friction, static friction and Stribeck speed in a model."""
        stiffness = model.actuator_dynprm[self.actuator, BRISTLE_STIFFNESS_COLUMN]
        return (float(stiffness), *model.actuator_biasprm[self.actuator, FRICTION_COLUMNS].tolist())

    def deflection(self, model: Any, speed: Array, direction: Array) -> Array:
        """(n,) deflections in steady sliding.

        Args:
            model: The compiled model (`mujoco.MjModel`).
            speed: (n,) speeds of the device.
            direction: (n,) the signs of the speeds, or numbers between -1 and 1 near rest.
        """
        stiffness, coulomb, static, stribeck = self.friction(model)
        ratio = speed / max(stribeck, mujoco.mjMINVAL)
        force = coulomb + (static - coulomb) * np.exp(-(ratio**2))
        return np.asarray(direction * force / stiffness)


def bristles_of(model: Any) -> tuple[Bristle, ...]:
    """Bristles of the passive devices of a model at slides and hinges.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    scalar = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
    found = []
    for actuator in bristle_actuators(model):
        if int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            continue
        joint = int(model.actuator_trnid[actuator, 0])
        if int(model.jnt_type[joint]) in scalar:
            found.append(
                Bristle(
                    actuator=actuator,
                    address=int(model.actuator_actadr[actuator]),
                    dof=int(model.jnt_dofadr[joint]),
                )
            )
    return tuple(found)
