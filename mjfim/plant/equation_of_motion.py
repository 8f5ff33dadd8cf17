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

        inertial = _mass_times(model, fields["M"], points.acceleration)
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
        M = _dense_mass(model, steps.fields["M"][:, 0])
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
            return -timestep * _derivative_times(model, fields["qDeriv"], points.acceleration)
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


def _mass_times(model: Any, values: Array, acceleration: Array) -> Array:
    """(n, nv) products of mass matrices, as MuJoCo stores them, and accelerations: (n, nv)."""
    total = np.zeros_like(acceleration)
    for row in range(model.nv):
        start, count = int(model.M_rowadr[row]), int(model.M_rownnz[row])
        entries = values[:, start : start + count]
        columns = model.M_colind[start : start + count]
        total[:, row] += np.sum(entries * acceleration[:, columns], axis=1)

        # The matrix holds the lower triangle; the last entry of a row is the diagonal.
        total[:, columns[:-1]] += entries[:, :-1] * acceleration[:, row : row + 1]
    return total


def _derivative_times(model: Any, values: Array, acceleration: Array) -> Array:
    """(n, nv) products of derivatives by the velocity and accelerations: (n, nv)."""
    total = np.empty_like(acceleration)
    for row in range(model.nv):
        start, count = int(model.D_rowadr[row]), int(model.D_rownnz[row])
        columns = model.D_colind[start : start + count]
        total[:, row] = np.sum(values[:, start : start + count] * acceleration[:, columns], axis=1)
    return total


def _dense_mass(model: Any, values: Array) -> Array:
    """(n, nv, nv) mass matrices from those that MuJoCo stores."""
    M = np.zeros((len(values), model.nv, model.nv))
    for row in range(model.nv):
        start, count = int(model.M_rowadr[row]), int(model.M_rownnz[row])
        columns = model.M_colind[start : start + count]
        M[:, row, columns] = values[:, start : start + count]
        M[:, columns, row] = values[:, start : start + count]
    return M
