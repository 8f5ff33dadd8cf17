"""Activations of physical terms at the begin of a segment, which the recording shows.

The lag of an actuator follows from the recorded control, and the bristle of a friction from the
measured velocity. They are no unknowns of a segment: what remains of their error dies out within
a few samples and acts like a small kick, which the free initial velocity contains.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.model.elements import BRISTLE_STIFFNESS_COLUMN, bristle_actuators
from mjfim.model.terms.term import FILTERS
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


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownActivations:
    """Activations that physical terms have added to a model.

    Attributes:
        model: The model at the guess (`mujoco.MjModel`).
        actuators: Actuators with such an activation, and its address among the activations.
        columns: Columns of a recording that hold controls, by the address of the control.
    """

    model: Any
    actuators: tuple[tuple[int, int], ...]
    columns: dict[int, int]

    @staticmethod
    def of(system: System) -> KnownActivations:
        """Activations of the terms of a system."""
        layout = system.source.layout
        if layout is None:
            return KnownActivations(model=system.model, actuators=(), columns={})

        model = system.plant.model(system.parameters.guess)
        columns = {i: i for i in range(model.nu)}
        if system.laws is not None:
            inputs, controls = system.laws.direct
            columns = dict(zip(controls.tolist(), inputs.tolist(), strict=True))

        # No recording shows the control that a law computes, so that its lag is an unknown.
        def is_shown(actuator: int) -> bool:
            """Whether the recording shows what moves the activation of an actuator."""
            is_lag = int(model.actuator_dyntype[actuator]) in FILTERS
            return not is_lag or int(model.actuator_ctrladr[actuator]) in columns

        stated = set(layout.act.tolist())
        found = [
            (actuator, int(model.actuator_actadr[actuator]))
            for actuator in np.flatnonzero(model.actuator_actnum).tolist()
            if int(model.actuator_actadr[actuator]) not in stated and is_shown(actuator)
        ]
        return KnownActivations(model=model, actuators=tuple(found), columns=columns)

    @property
    def addresses(self) -> list[int]:
        """Their addresses among the activations."""
        return [address for _, address in self.actuators]

    def at(self, recording: AlignedRecording, begins: np.ndarray, qvel: Array) -> Array:
        """The activations at some samples of a recording.

        Args:
            recording: The recording.
            begins: (n,) samples.
            qvel: (n, nv) velocities at these samples [m/s or rad/s].

        Returns:
            (n, k) activations in the order of `addresses`.
        """
        columns = [
            self._filtered(actuator, recording, begins)
            if int(self.model.actuator_dyntype[actuator]) in FILTERS
            else self._bent(actuator, qvel)
            for actuator, _ in self.actuators
        ]
        return np.stack(columns, axis=1) if columns else np.zeros((len(begins), 0))

    def _filtered(self, actuator: int, recording: AlignedRecording, begins: np.ndarray) -> Array:
        """(n,) controls after the lag of an actuator, which is at rest at the first row."""
        control = int(self.model.actuator_ctrladr[actuator])
        u = recording.ctrl[:, self.columns[control]]
        if self.model.actuator_ctrllimited[control]:
            u = np.clip(u, *self.model.actuator_ctrlrange[control])

        # a_{k+1} = a_k + s (u_k - a_k), with a_0 = u_0.
        time_constant = max(float(self.model.actuator_dynprm[actuator, 0]), mujoco.mjMINVAL)
        share = -np.expm1(-recording.dt / time_constant)
        held = np.array([(1.0 - share) * u[0]])
        after, _ = scipy.signal.lfilter([share], [1.0, share - 1.0], u, zi=held)
        return np.asarray(np.concatenate([u[:1], after])[begins])

    def _bent(self, actuator: int, qvel: Array) -> Array:
        """(n,) deflections of a bristle in steady sliding at velocities qvel: (n, nv)."""
        bristle = next(each for each in bristles_of(self.model) if each.actuator == actuator)
        speed = bristle.speed(self.model, qvel)
        return bristle.deflection(self.model, speed, np.sign(speed))
