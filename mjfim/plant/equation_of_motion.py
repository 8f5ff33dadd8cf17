"""The equation of motion of an engine step, evaluated along a given motion, and its affine forces.

With the mean acceleration a of a step of length τ, MuJoCo solves

    (M(q) + τ B) a + c(q, v) = passive(q, v) + friction(v) + actuation(q, v, u),

where B is the damping that the integrator takes at the end of the step: of all forces with the
implicit integrators, of the joints' dampers with Euler's method, none with RK4. The engine computes
all terms but the dry friction, which follows the measured velocity: near rest the engine's friction
depends on the acceleration that the wrong parameters would give. Forces of actuators and springs
on the joints are affine in state and control, between limits (`AffineForces`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.model.parameters import Parameter
from mjfim.model.targets import InertiaField, ModelField
from mjfim.plant.batch import BatchSimulator

# MjData fields whose sum are these forces.
FORCE_FIELDS = ("qfrc_passive", "qfrc_actuator")

# MjData fields with the moment arms of the actuators, a sparse matrix by rows.
MOMENT_FIELDS = ("actuator_moment", "moment_rownnz", "moment_rowadr", "moment_colind")

# Move of every coordinate from which the slopes are computed, relative to its size. Affine forces
# allow long moves, which have little round-off.
RELATIVE_MOVE = 1e-2

# Largest deviation of a force from this function, relative to the terms of the function.
LARGEST_DEVIATION = 1e-9

# Arrays of MjModel that hold the inertia of bodies.
INERTIA_ARRAYS = ("body_mass", "body_ipos", "body_inertia")

# Arrays of MjModel that hold what springs, dampers and actuators do, and the inertia of the joints
# themselves.
FORCE_ARRAYS = (
    "dof_damping",
    "dof_armature",
    "jnt_stiffness",
    "qpos_spring",
    "actuator_gainprm",
    "actuator_biasprm",
)

# Integrators that take the damping of all forces at the end of the step.
IMPLICIT = (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)

# Factor by which the inertia of the joints is larger where only activations are to move.
HELD_INERTIA = 1e9


@record
class AffineForces:
    """Springs, dampers and actuators whose forces are affine in (q, v, u), with clamped forces.

    Attributes:
        model: The model, whose limits clamp controls and forces.
        springs: (nv, 1 + 2 nv + nu) forces of springs and dampers at zero, and their slopes.
        actuators: (actuators, 1 + 2 nv + nu) forces of actuators at zero, and their slopes.
        moments: (actuators, nv) joint forces per unit of an actuator's force.
    """

    model: Any
    springs: Array
    actuators: Array
    moments: Array

    @staticmethod
    def measured(
        simulator: BatchSimulator, model: Any, state: Array, ctrl: Array, sizes: Array
    ) -> AffineForces:
        """Slopes by differences of the engine's forces, without their limits.

        Args:
            simulator: Steps the model.
            model: A model with hinges and slides only.
            state: (2 nv,) state about which coordinates are moved.
            ctrl: (nu,) control about which it is moved.
            sizes: (2 nv + nu,) sizes of the coordinates.
        """
        unlimited = _without_limits(model)
        moves = RELATIVE_MOVE * sizes
        about = np.concatenate([state, ctrl])
        points = about + np.concatenate([np.zeros((1, len(moves))), np.diag(moves)])
        n = len(state)
        names = ("qfrc_passive", "actuator_force", *MOMENT_FIELDS)
        fields = simulator.engine_steps(unlimited, points[:, :n], points[:, n:], names)[1]
        values, counts, starts, columns = (fields[name][0, 0] for name in MOMENT_FIELDS)

        return AffineForces(
            model=model,
            springs=_affine(fields["qfrc_passive"][:, 0], about, moves),
            actuators=_affine(fields["actuator_force"][:, 0], about, moves),
            moments=_dense(values[None], starts, counts, columns, n // 2)[0],
        )

    def at(
        self, states: Array, ctrl: Array, fields: dict[str, Array]
    ) -> tuple[Array, Array, np.ndarray]:
        """Derivatives of the forces at n states.

        Args:
            states: (n, 2 nv) states.
            ctrl: (n, nu) controls.
            fields: The `FORCE_FIELDS` of the engine, each (n, nv).

        Returns:
            (n, nv, 2 nv + nu) derivatives by positions, speeds and controls; (n, nv, nv) damping D
            of an engine step, which solves `(M + timestep D) a = forces` for the mean acceleration
            a of the step; and (n,) True where the forces are those of the engine.
        """
        points = self._points(states, ctrl)
        clamped, acts = self._clamped(points)

        # The largest terms of the function show the round-off that its sum may have.
        total = points @ self.springs.T + clamped @ self.moments
        terms = (
            np.abs(points)
            @ (np.abs(self.springs) + np.abs(self.moments.T) @ np.abs(self.actuators)).T
        )
        deviation = np.abs(total - sum(fields[name] for name in FORCE_FIELDS))
        agree = (deviation <= LARGEST_DEVIATION * terms.max(axis=0)).all(axis=1)

        # Passive forces do not depend on the controls.
        slopes = self.springs[:, 1:] + self.moments.T @ self._actuator_slopes(acts, ctrl)
        return slopes, self._damping(slopes), agree

    def change(self, states: Array, ctrl: Array, acceleration: Array, by: ParameterChange) -> Array:
        """Derivatives of the right-hand side of an engine step, `forces - timestep D a`.

        Args:
            states: (n, 2 nv) states before the step.
            ctrl: (n, nu) controls.
            acceleration: (n, nv) mean accelerations a.
            by: Change of the model by m parameters.

        Returns:
            (n, nv, m) derivatives at fixed accelerations.
        """
        points = self._points(states, ctrl)
        acts = self._clamped(points)[1]

        # Where the integrator takes all forces at the end of the step, the step moves the speeds.
        model, nv = self.model, acceleration.shape[1]
        if self._is_implicit:
            speeds = slice(1 + nv, 1 + 2 * nv)
            points = np.array(points)
            points[:, speeds] += model.opt.timestep * acceleration

        total = np.zeros((len(points), nv, by.count))
        for joint, k in np.argwhere(by.springs.any(axis=1)).tolist():
            total[:, joint, k] += points @ by.springs[joint, :, k]
        for actuator, k in np.argwhere(by.actuators.any(axis=1)).tolist():
            force = acts[:, actuator] * (points @ by.actuators[actuator, :, k])
            total[:, :, k] += force[:, None] * self.moments[actuator]

        if self._damps_implicitly:
            total -= model.opt.timestep * acceleration[..., None] * by.damping
        return total

    def actuator_slopes(self, states: Array, ctrl: Array) -> Array:
        """(n, actuators, 2 nv + nu) derivatives of the actuators' forces at n states.

        Args:
            states: (n, 2 nv) states.
            ctrl: (n, nu) controls.
        """
        return self._actuator_slopes(self._clamped(self._points(states, ctrl))[1], ctrl)

    def _actuator_slopes(self, acts: np.ndarray, ctrl: Array) -> Array:
        """The same where the forces of actuators act: (n, actuators), and are not clamped."""
        is_free = self._applied(ctrl)[1]
        slopes = acts[..., None] * self.actuators[:, 1:]
        slopes[..., slopes.shape[2] - is_free.shape[1] :] *= is_free[:, None]
        return slopes

    def clamped(self, states: Array, ctrl: Array) -> np.ndarray:
        """(n, actuators) True where the force of an actuator is clamped.

        Args:
            states: (n, 2 nv) states.
            ctrl: (n, nu) controls.
        """
        return ~self._clamped(self._points(states, ctrl))[1]

    def _points(self, states: Array, ctrl: Array) -> Array:
        """(n, 1 + 2 nv + nu) ones, states and controls within their limits."""
        applied, _ = self._applied(ctrl)
        return np.concatenate([np.ones((len(states), 1)), states, applied], axis=1)

    def _clamped(self, points: Array) -> tuple[Array, np.ndarray]:
        """(n, actuators) forces within their limits, and True where they are not clamped.

        Args:
            points: (n, 1 + 2 nv + nu) ones, states and controls.
        """
        model = self.model
        force = points @ self.actuators.T
        return _within(force, model.actuator_forcelimited, model.actuator_forcerange)

    def _damping(self, slopes: Array) -> Array:
        """(n, nv, nv) damping that the integrator takes at the end of an engine step."""
        nv = slopes.shape[1]
        if self._is_implicit:
            return -slopes[..., nv : 2 * nv]
        if not self._damps_implicitly:
            return np.zeros((len(slopes), nv, nv))
        return np.broadcast_to(np.diag(self.model.dof_damping), (len(slopes), nv, nv))

    @property
    def _is_implicit(self) -> bool:
        """Whether the integrator takes all forces at the end of an engine step."""
        return bool(self.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST)

    @property
    def _damps_implicitly(self) -> bool:
        """Whether it takes those of the joints' dampers, and no others, at the end of the step."""
        is_explicit = self.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        return not (self._is_implicit or is_explicit)

    def _applied(self, ctrl: Array) -> tuple[Array, np.ndarray]:
        """(n, nu) controls within their limits, and (n, nu) True where they are not clamped."""
        model = self.model
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
            return ctrl, np.ones(ctrl.shape, dtype=bool)

        return _within(ctrl, model.actuator_ctrllimited, model.actuator_ctrlrange)


def _within(values: Array, limited: Array, ranges: Array) -> tuple[Array, np.ndarray]:
    """(n, k) values clipped to those of k ranges: (k, 2) that limit them, and True where inside."""
    if not limited.any():
        return values, np.ones(values.shape, dtype=bool)
    low = np.where(limited, ranges[:, 0], -np.inf)
    high = np.where(limited, ranges[:, 1], np.inf)
    clipped = np.clip(values, low, high)
    return clipped, clipped == values


def _affine(forces: Array, about: Array, moves: Array) -> Array:
    """(w, 1 + c) values at zero and slopes, from (1 + c, w) forces: unmoved, then moved each."""
    slopes = ((forces[1:] - forces[0]) / moves[:, None]).T
    offset = forces[0] - slopes @ about
    return np.concatenate([offset[:, None], slopes], axis=1)


def is_inertial(parameter: Parameter) -> bool:
    """Whether a parameter changes nothing but the inertia of bodies."""
    fields = [target.field for target in parameter.targets]
    return bool(fields) and all(
        isinstance(field, InertiaField)
        or (isinstance(field, ModelField) and field.array in INERTIA_ARRAYS)
        for field in fields
    )


def acts_on_joints(parameter: Parameter) -> bool:
    """Whether a parameter changes nothing but springs, dampers, gains and armatures."""
    fields = [target.field for target in parameter.targets]
    return bool(fields) and all(
        isinstance(field, ModelField) and {name for name, _, _ in field.numbers} <= {*FORCE_ARRAYS}
        for field in fields
    )


@record
class ParameterChange:
    """Derivatives of a model by m parameters, or along m directions of them.

    Attributes:
        inertia: (b, 10, m) of the moved bodies' barycentric inertias.
        springs: (nv, 1 + 2 nv + nu, m) of the affine forces of springs and dampers.
        actuators: (actuators, 1 + 2 nv + nu, m) of the affine forces of actuators.
        damping: (nv, m) of the damping of the joints.
        armature: (nv, m) of the inertia that is added to each joint.
    """

    inertia: Array
    springs: Array
    actuators: Array
    damping: Array
    armature: Array

    @property
    def count(self) -> int:
        """Number m of parameters or directions."""
        return int(self.inertia.shape[-1])

    def along(self, directions: Array) -> ParameterChange:
        """Change along directions of the m parameters: (n, m)."""
        names = [field.name for field in fields(self)]
        return ParameterChange(**{name: getattr(self, name) @ directions.T for name in names})

    @staticmethod
    def joined(changes: Sequence[ParameterChange]) -> ParameterChange:
        """Changes by several parameters side by side."""
        names = [field.name for field in fields(ParameterChange)]
        return ParameterChange(
            **{
                name: np.concatenate([getattr(change, name) for change in changes], axis=-1)
                for name in names
            }
        )


# Points of a motion: (n, ns) states, (n, nv) mean accelerations of the steps that begin there, and
# (n, nu) controls.
MotionPoints = tuple[Array, Array, Array]


@record
class EquationOfMotion:
    """The equation of motion of a plant's models without constraints (`Relaxation.constraints`).

    Attributes:
        simulator: Simulates samples of a single step.
        friction_speeds: (nv,) speeds below which dry friction of joints is viscous [m/s or rad/s].
    """

    simulator: BatchSimulator
    friction_speeds: Array

    def terms(self, model: Any, points: MotionPoints) -> tuple[Array, Array, Array]:
        """The terms of the equation of motion at n points.

        They are not finite where the engine cannot compute them.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            (n, nv) forces that the actuators have to give: `(M + τ B) a + c - passive - friction`;
            (n, nv) the term `(M + τ B) a` of them; (n, nv+nf) forces of the actuators on the
            degrees of freedom, then each of them by its address.
        """
        names = ["M", "qfrc_smooth", "qfrc_actuator", "actuator_force"]
        if model.opt.integrator in IMPLICIT:
            names.append("qDeriv")
        fields = self._fields(model, points, names)

        _, acceleration, _ = points
        inertial = (_mass(model, fields["M"]) @ acceleration[..., None])[..., 0]
        inertial += self._implicit_damping(model, fields, points)
        actuation = fields["qfrc_actuator"]
        friction = self._friction(model, points)
        needed = inertial - (fields["qfrc_smooth"] - actuation) - friction
        return needed, inertial, np.hstack([actuation, fields["actuator_force"]])

    def coupling(self, model: Any, points: MotionPoints) -> Array:
        """Root mean squares of the forces on each degree of freedom by each acceleration.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            (nv, nv) root mean squares of `M_ij a_j`.
        """
        M = _mass(model, self._fields(model, points, ["M"])["M"])
        _, acceleration, _ = points
        forces = M * acceleration[:, None, :]
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
        values, counts, starts, columns = self._fields(model, points, MOMENT_FIELDS).values()
        moments = np.zeros((len(values), len(actuators), model.nv))
        for place, actuator in enumerate(actuators):
            for entry in range(int(counts[:, actuator].max(initial=0))):
                rows = np.flatnonzero(entry < counts[:, actuator])
                address = starts[rows, actuator] + entry
                moments[rows, place, columns[rows, address]] = values[rows, address]
        return moments

    def constrained(self, model: Any, points: MotionPoints) -> np.ndarray:
        """Points at which contacts, stops or equalities act, whose forces no measurement shows.

        Args:
            model: A model at parameter values.
            points: The motion.

        Returns:
            (n, nv) True where such a force acts on a degree of freedom.
        """
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT:
            return np.zeros(points[1].shape, dtype=bool)

        frictionless = copy.copy(model)
        frictionless.dof_frictionloss[:] = 0.0
        frictionless.tendon_frictionloss[:] = 0.0
        fields = self._fields(frictionless, points, ["qfrc_constraint"])
        return np.asarray(fields["qfrc_constraint"] != 0.0)

    def _fields(self, model: Any, points: MotionPoints, names: Sequence[str]) -> dict[str, Array]:
        """MjData fields at the n points, each (n, ...)."""
        states, _, ctrl = points
        _, found = self.simulator.engine_steps(model, states, ctrl, names)
        return {name: values[:, 0] for name, values in found.items()}

    def _implicit_damping(
        self, model: Any, fields: dict[str, Array], points: MotionPoints
    ) -> Array:
        """(n, nv) forces `τ B a`."""
        states, acceleration, _ = points
        timestep = float(model.opt.timestep)
        if "qDeriv" in fields:
            D = _dense(fields["qDeriv"], model.D_rowadr, model.D_rownnz, model.D_colind, model.nv)
            return -timestep * (D @ acceleration[..., None])[..., 0]
        if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP:
            return np.zeros_like(acceleration)

        # The slope of a damper with a force that is a polynomial of the speed.
        speed = np.abs(self.simulator.space.split(states)[1])
        slope = np.broadcast_to(model.dof_damping, speed.shape).copy()
        polynomial = np.reshape(model.dof_dampingpoly, (model.nv, -1))
        for power in range(polynomial.shape[1]):
            slope += (power + 2) * polynomial[:, power] * speed ** (power + 1)
        return timestep * slope * acceleration

    def directions(self, speed: Array) -> Array:
        """Directions of dry friction along a motion.

        Args:
            speed: (n, nv) velocities [m/s or rad/s].

        Returns:
            (n, nv) the signs of the velocities, and numbers between -1 and 1 near rest.
        """
        share = speed / np.maximum(self.friction_speeds, np.finfo(float).tiny)
        return np.clip(share, -1.0, 1.0)

    def _friction(self, model: Any, points: MotionPoints) -> Array:
        """(n, nv) forces of dry friction of joints and tendons."""
        speed = self.simulator.space.split(points[0])[1]
        friction = -model.dof_frictionloss * self.directions(speed)
        if model.tendon_frictionloss.any():
            friction += self._tendon_friction(model, points, speed)
        return np.asarray(friction)

    def _tendon_friction(self, model: Any, points: MotionPoints, speed: Array) -> Array:
        """(n, nv) forces of dry friction of tendons at speeds of the joints: (n, nv)."""
        friction = np.zeros_like(speed)
        # The speeds of a tendon below which its friction is viscous are those of its joints.
        values = self._fields(model, points, ["ten_J"])["ten_J"]
        for tendon in np.flatnonzero(model.tendon_frictionloss).tolist():
            first, count = model.ten_J_rowadr[tendon], model.ten_J_rownnz[tendon]
            arms = values.reshape(len(speed), -1)[:, first : first + count]
            dofs = np.reshape(model.ten_J_colind, -1)[first : first + count]
            slow = np.abs(arms) @ self.friction_speeds[dofs]
            rate = np.sum(arms * speed[:, dofs], axis=1)
            along = np.clip(rate / np.maximum(slow, np.finfo(float).tiny), -1.0, 1.0)
            force = model.tendon_frictionloss[tendon] * along
            friction[:, dofs] -= arms * force[:, None]
        return friction


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
    return simulator.space.split(found.states)[2]


def _mass(model: Any, values: Array) -> Array:
    """(n, nv, nv) mass matrices from those that MuJoCo stores, which are lower triangles."""
    lower = _dense(values, model.M_rowadr, model.M_rownnz, model.M_colind, model.nv)
    return lower + np.swapaxes(np.tril(lower, -1), 1, 2)


def _dense(values: Array, starts: Any, counts: Any, columns: Any, width: int) -> Array:
    """(n, rows, width) matrices from values (n, entries) of sparse rows."""
    dense = np.zeros((len(values), len(starts), width))
    for row, (start, count) in enumerate(zip(starts, counts, strict=True)):
        entries = slice(start, start + count)
        dense[:, row, columns[entries]] = values[:, entries]
    return dense


def _without_limits(model: Any) -> Any:
    """The model without limits of controls and of forces of actuators."""
    # A copy of a model with many meshes takes time.
    if not (model.actuator_forcelimited.any() or model.actuator_ctrllimited.any()):
        return model
    unlimited = copy.copy(model)
    unlimited.actuator_forcelimited[:] = 0
    unlimited.actuator_ctrllimited[:] = 0
    return unlimited
