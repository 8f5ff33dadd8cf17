"""The equation of motion of an engine step, evaluated along a given motion.

With the mean acceleration a of a step of length τ, MuJoCo solves

    (M(q) + τ B) a + c(q, v) = passive(q, v) + friction(v) + actuation(q, v, u),

where B is the damping that the integrator takes at the end of the step: of all forces with the
implicit integrators, of the joints' dampers with Euler's method, none with RK4. The engine computes
all terms but the dry friction, which follows the measured velocity: near rest the engine's friction
depends on the acceleration that the wrong parameters would give.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.plant.batch import BatchSimulator
from mjfim.plant.closed_form.affine_forces import MOMENT_FIELDS

# Integrators that take the damping of all forces at the end of the step.
IMPLICIT = (
    int(mujoco.mjtIntegrator.mjINT_IMPLICIT),
    int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
)

# Factor by which the inertia of the joints is larger where only activations are to move.
HELD_INERTIA = 1e9


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionPoints:
    """Points of a motion with their controls.

    Attributes:
        states: (n, ns) states.
        acceleration: (n, nv) mean accelerations of the steps that begin there.
        ctrl: (n, nu) controls.
    """

    states: Array
    acceleration: Array
    ctrl: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationTerms:
    """Terms of the equation of motion at n points.

    Attributes:
        needed: (n, nv) forces that the actuators have to give: `(M + τ B) a + c - passive -
            friction`.
        inertial: (n, nv) the term `(M + τ B) a` of them.
        actuation: (n, nv) forces of the actuators on the degrees of freedom.
        actuator_force: (n, nf) forces of the actuators, by their address.
    """

    needed: Array
    inertial: Array
    actuation: Array
    actuator_force: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationOfMotion:
    """The equation of motion of a plant's models without constraints (`Relaxation.constraints`).

    Attributes:
        simulator: Simulates samples of a single step.
        friction_speeds: (nv,) speeds below which dry friction of joints is viscous [m/s or rad/s].
    """

    simulator: BatchSimulator
    friction_speeds: Array

    def terms(self, model: Any, points: MotionPoints) -> EquationTerms:
        """The terms along a motion.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            The terms; they are not finite where the engine cannot compute them.
        """
        names = ["M", "qfrc_smooth", "qfrc_actuator", "actuator_force"]
        if model.opt.integrator in IMPLICIT:
            names.append("qDeriv")
        found = self.simulator.engine_steps(model, points.states, points.ctrl, names).fields
        fields = {name: values[:, 0] for name, values in found.items()}

        inertial = (_mass(model, fields["M"]) @ points.acceleration[..., None])[..., 0]
        inertial += self._implicit_damping(model, fields, points)
        actuation = fields["qfrc_actuator"]
        friction = self._friction(model, points)
        return EquationTerms(
            needed=inertial - (fields["qfrc_smooth"] - actuation) - friction,
            inertial=inertial,
            actuation=actuation,
            actuator_force=fields["actuator_force"],
        )

    def coupling(self, model: Any, points: MotionPoints) -> Array:
        """Root mean squares of the forces on each degree of freedom by each acceleration.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            (nv, nv) root mean squares of `M_ij a_j`.
        """
        steps = self.simulator.engine_steps(model, points.states, points.ctrl, ["M"])
        M = _mass(model, steps.fields["M"][:, 0])
        forces = M * points.acceleration[:, None, :]
        return np.asarray(np.sqrt(np.mean(forces**2, axis=0)))

    def moments(self, model: Any, points: MotionPoints, actuators: Sequence[int]) -> Array:
        """Forces on the degrees of freedom per force of some actuators.

        Args:
            model: A model at parameter values.
            points: The motion.
            actuators: Addresses of the forces of the actuators.

        Returns:
            (n, k, nv) moment arms.
        """
        found = self.simulator.engine_steps(model, points.states, points.ctrl, MOMENT_FIELDS)
        values, counts, starts, columns = (found.fields[name][:, 0] for name in MOMENT_FIELDS)
        moments = np.zeros((len(values), len(actuators), model.nv))
        for place, actuator in enumerate(actuators):
            for entry in range(int(counts[:, actuator].max(initial=0))):
                rows = np.flatnonzero(entry < counts[:, actuator])
                address = starts[rows, actuator] + entry
                moments[rows, place, columns[rows, address]] = values[rows, address]
        return moments

    def constrained(self, model: Any, points: MotionPoints) -> np.ndarray:
        """Where contacts, stops or equalities act, the forces of which no measurement shows.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            (n, nv) True where such a force acts on a degree of freedom.
        """
        if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT):
            return np.zeros(points.acceleration.shape, dtype=bool)

        frictionless = copy.copy(model)
        frictionless.dof_frictionloss[:] = 0.0
        frictionless.tendon_frictionloss[:] = 0.0
        names = ["qfrc_constraint"]
        found = self.simulator.engine_steps(frictionless, points.states, points.ctrl, names)
        return np.asarray(found.fields["qfrc_constraint"][:, 0] != 0.0)

    def _implicit_damping(
        self, model: Any, fields: dict[str, Array], points: MotionPoints
    ) -> Array:
        """(n, nv) forces `τ B a`."""
        timestep = float(model.opt.timestep)
        if "qDeriv" in fields:
            D = _dense(fields["qDeriv"], model.D_rowadr, model.D_rownnz, model.D_colind)
            return np.asarray(-timestep * (D @ points.acceleration[..., None])[..., 0])
        if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP):
            return np.zeros_like(points.acceleration)

        # The slope of a damper with a force that is a polynomial of the speed.
        speed = np.abs(self.simulator.space.split(points.states)[1])
        slope = np.broadcast_to(model.dof_damping, speed.shape).copy()
        polynomial = np.reshape(model.dof_dampingpoly, (model.nv, -1))
        for power in range(polynomial.shape[1]):
            slope += (power + 2) * polynomial[:, power] * speed ** (power + 1)
        return timestep * slope * points.acceleration

    def directions(self, speed: Array) -> Array:
        """Directions of dry friction along a motion.

        Args:
            speed: (n, nv) velocities [m/s or rad/s].

        Returns:
            (n, nv) the signs of the velocities, and numbers between -1 and 1 near rest.
        """
        share = speed / np.maximum(self.friction_speeds, np.finfo(float).tiny)
        return np.asarray(np.clip(share, -1.0, 1.0))

    def _friction(self, model: Any, points: MotionPoints) -> Array:
        """(n, nv) forces of dry friction of joints and tendons."""
        speed = self.simulator.space.split(points.states)[1]
        friction = -model.dof_frictionloss * self.directions(speed)
        if not model.tendon_frictionloss.any():
            return np.asarray(friction)

        # The speeds of a tendon below which its friction is viscous are those of its joints.
        names = ["ten_J"]
        values = self.simulator.engine_steps(model, points.states, points.ctrl, names)
        for tendon in np.flatnonzero(model.tendon_frictionloss).tolist():
            first, count = int(model.ten_J_rowadr[tendon]), int(model.ten_J_rownnz[tendon])
            arms = values.fields["ten_J"][:, 0].reshape(len(speed), -1)[:, first : first + count]
            dofs = np.reshape(model.ten_J_colind, -1)[first : first + count]
            slow = np.abs(arms) @ self.friction_speeds[dofs]
            rate = np.sum(arms * speed[:, dofs], axis=1)
            along = np.clip(rate / np.maximum(slow, np.finfo(float).tiny), -1.0, 1.0)
            force = float(model.tendon_frictionloss[tendon]) * along
            friction[:, dofs] -= arms * force[:, None]
        return np.asarray(friction)


def activations(
    simulator: BatchSimulator, models: Sequence[Any], start: Array, ctrl: Array
) -> Array:
    """Activations of actuators under a control, at joints that are held.

    Args:
        simulator: The simulator, with the samples of the control.
        models: m models with activations, without constraints.
        start: (ns,) initial state.
        ctrl: (N, nu) control.

    Returns:
        (m, N+1, na) activations at the samples.
    """
    held = []
    for model in models:
        other = copy.copy(model)
        other.opt.gravity[:] = 0.0
        other.dof_armature[:] += HELD_INERTIA * np.maximum(model.dof_M0, model.dof_M0.max())
        held.append(other)

    states = np.repeat(start[None], len(held), axis=0)
    states[:, simulator.space.nq : simulator.space.nq + simulator.space.nv] = 0.0
    controls = np.repeat(ctrl[None], len(held), axis=0)
    found = simulator.rollout(held, states, controls)
    return np.asarray(simulator.space.split(found.states)[2])


def _mass(model: Any, values: Array) -> Array:
    """(n, nv, nv) mass matrices from those that MuJoCo stores, which are lower triangles."""
    lower = _dense(values, model.M_rowadr, model.M_rownnz, model.M_colind)
    return np.asarray(lower + np.swapaxes(np.tril(lower, -1), 1, 2))


def _dense(values: Array, starts: Any, counts: Any, columns: Any) -> Array:
    """(n, nv, nv) matrices from values (n, entries) of sparse rows."""
    dense = np.zeros((len(values), len(starts), len(starts)))
    for row, (start, count) in enumerate(zip(starts, counts, strict=True)):
        entries = slice(start, start + count)
        dense[:, row, columns[entries]] = values[:, entries]
    return dense
