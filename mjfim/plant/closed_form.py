"""Derivatives of samples in closed form, for arms and other rigid bodies on hinges and slides.

An engine step of such a plant solves

    M(q) a + c(q, v) = tau - timestep D a,      tau = offset + slopes (q, v, u)

for the mean acceleration a, and sets `v+ = v + timestep a` and `q+ = q + timestep v+`. Derivatives
of the left-hand side at fixed a have a closed form (`RigidBodyMotion`), which is linear in the
inertial parameters, and the right-hand side is affine in damping, stiffness and gains
(`AffineForces`). So one engine step at each state takes the place of a step for every coordinate
and every parameter. Whether the equation holds is checked at every engine step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.model.parameters import ParameterSet
from mjfim.plant.batch import BatchSimulator, SubstepObservations
from mjfim.plant.equation_of_motion import (
    FORCE_FIELDS,
    AffineForces,
    ParameterChange,
    acts_on_joints,
    is_inertial,
)
from mjfim.plant.rigid_body_motion import (
    MOTION_FIELDS,
    JointTree,
    RigidBodyMotion,
    barycentric_inertias,
)
from mjfim.records.trajectory import Trajectory

# Smallest number of joints for which derivatives have a closed form. With four hinges, a gradient
# takes half of the time that steps of the engine take, with seven a third.
LEAST_JOINTS = 4

# Largest error of the equation of motion, relative to the terms of the forces.
LARGEST_ERROR = 1e-9

# MjData fields that are recorded at every engine step.
RECORDED_FIELDS = (*MOTION_FIELDS, *FORCE_FIELDS, "xpos", "xmat")

# Engine steps whose derivatives are computed at once, so that they stay in the processor's cache.
STEPS_AT_ONCE = 500

# Difference step of the model by the parameters, relative to the size of a parameter.
MODEL_STEP = 1e-5


# Fields of MjModel that are zero where no spring and no damper has a force of higher order.
POLYNOMIAL_FORCES = (
    "jnt_stiffnesspoly",
    "tendon_stiffnesspoly",
    "dof_dampingpoly",
    "tendon_dampingpoly",
    "actuator_dampingpoly",
)

# Fields of MjModel that are zero where no other force makes the equation of motion another one.
OTHER_FORCES = (
    *POLYNOMIAL_FORCES,
    "na",
    "neq",
    "nflex",
    "nhistory",
    "nplugin",
    "nplastic",
    "dof_frictionloss",
    "tendon_frictionloss",
    "tendon_actfrclimited",
    "tendon_armature",
    "body_gravcomp",
    "actuator_armature",
    "actuator_damping",
)


@record
class SampleJacobians:
    """First derivatives of N samples.

    Attributes:
        A: (N, nx, nx) by the state.
        B: (N, nx, nu) by the control.
        E: (N, nx, m) by the parameters, or along m directions of them.
        states: (N, s+1, nx) states before and after each of the s engine steps of a sample.
        accelerations: (N, s, nv, nx+nu) derivatives of the mean accelerations of the engine steps
            by the state before the step and by the control.
        forces: Forces of springs and actuators.
    """

    A: Array
    B: Array
    E: Array
    states: Array
    accelerations: Array
    forces: AffineForces


def closed_form_tree(model: Any, least_joints: int = LEAST_JOINTS) -> JointTree | None:
    """Joints of a model whose samples may have derivatives in closed form.

    Args:
        model: The model that is stepped.
        least_joints: Smallest number of joints.

    Returns:
        The joints; None where the equation of motion is certainly another one, or where too few
        joints make steps of the engine quicker.
    """
    integrators = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    direct = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON)
    biases = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    # Moment arms have to be constant, and forces affine in (q, v, u), in all states. The check of
    # each engine step compares forces, not their slopes: a force that stays zero, or a robot that
    # stays at rest, shows nothing.
    is_affine = (
        np.isin(model.actuator_trntype, direct).all()
        and (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
        and np.isin(model.actuator_biastype, biases).all()
        and model.nu == model.nactuator == model.nout
        and (model.actuator_ctrlnum == 1).all()
        # A tendon of joints has constant moment arms; one over sites has not.
        and (model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT).all()
        and not _any(model, OTHER_FORCES)
        and not _any(model.opt, ("density", "viscosity"))
    )
    if not is_affine or model.nv < least_joints or model.opt.integrator not in integrators:
        return None
    return JointTree.of(model)


def _any(holder: Any, names: Sequence[str]) -> bool:
    """Whether a number of these fields of MjModel or of its options is not zero."""
    return any(np.any(getattr(holder, name)) for name in names)


@record
class ClosedForm:
    """Derivatives of samples in closed form.

    Attributes:
        simulator: Steps the model.
        tree: Joints of the model.
        sizes: (2 nv + nu,) sizes of the coordinates of state and control.
    """

    simulator: BatchSimulator
    tree: JointTree
    sizes: Array

    def jacobians(
        self, model: Any, states: Array, ctrl: Array, change: ParameterChange | None = None
    ) -> SampleJacobians | None:
        """First derivatives of samples.

        Args:
            model: The model at the parameter values.
            states: (N, 2 nv) states before the samples.
            ctrl: (N, nu) controls, held over the samples.
            change: Change of the model by m parameters; None for none.

        Returns:
            The derivatives; None where the samples have another equation of motion.
        """
        # Parameters may give a polynomial force to a model that has none at its nominal values.
        if _any(model, POLYNOMIAL_FORCES):
            return None

        forces = AffineForces.measured(self.simulator, model, states[0], ctrl[0], self.sizes)
        parts = []
        samples = max(1, STEPS_AT_ONCE // self.simulator.substeps)
        for first in range(0, len(states), samples):
            rows = slice(first, first + samples)

            # Numbers may overflow where a simulation diverges; the check then fails.
            with np.errstate(over="ignore", invalid="ignore"):
                part = self._part(model, states[rows], ctrl[rows], forces, change)
            if part is None:
                return None
            parts.append(part)

        names = ("A", "B", "E", "states", "accelerations")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return SampleJacobians(**joined, forces=forces)

    def _part(
        self,
        model: Any,
        states: Array,
        ctrl: Array,
        forces: AffineForces,
        change: ParameterChange | None,
    ) -> SampleJacobians | None:
        """First derivatives of some samples, see `jacobians`."""
        N, substeps, nv = len(states), self.simulator.substeps, self.tree.count
        stepped, recorded = self.simulator.engine_steps(model, states, ctrl, RECORDED_FIELDS)
        fields = {name: _flat(values) for name, values in recorded.items()}
        timestep = model.opt.timestep

        speed = stepped[..., nv:]
        accelerations = _flat(np.diff(speed, axis=1)) / timestep
        motion = RigidBodyMotion.of(self.tree, model, fields, _flat(speed[:, :-1]), accelerations)
        points = _flat(stepped[:, :-1]), np.repeat(ctrl, substeps, axis=0)
        by_point, implicit_damping, agree = forces.at(*points, fields)

        # Whether the motion of the engine solves the equation of motion.
        damping = implicit_damping @ motion.acceleration[..., None]
        force = sum(fields[name] for name in FORCE_FIELDS)
        error = np.abs(motion.force + timestep * damping[..., 0] - force)
        solves = (error <= LARGEST_ERROR * motion.largest_force).all()
        if not (agree.all() and solves):
            return None

        by_position, by_speed = motion.force_derivatives()
        by_point[..., :nv] -= by_position
        by_point[..., nv : 2 * nv] -= by_speed

        # One small inverse for all right-hand sides takes a third of the time of solving for them,
        # and A and B do not depend on whether parameters are asked for.
        inverse = np.linalg.inv(motion.mass_matrix + timestep * implicit_damping)
        by_point = (inverse @ by_point).reshape(N, substeps, nv, -1)

        count = 0 if change is None else change.count
        by_theta: Array = np.zeros((N * substeps, nv, count))
        if change is not None:
            # Less the derivatives of the forces that the motion needs.
            bodies = self.tree.bodies
            axes = fields["xmat"].reshape(len(motion.speed), -1, 3, 3)
            needed = motion.regressor(fields["xpos"][:, bodies], axes[:, bodies], change.inertia)
            needed = needed + motion.acceleration[..., None] * change.armature
            by_theta = inverse @ (forces.change(*points, motion.acceleration, change) - needed)
        by_theta = by_theta.reshape(N, substeps, nv, count)

        # From the accelerations of the engine steps to the samples.
        nx = 2 * nv
        E = np.zeros((N, nx, count))
        AB = unmoved(by_point)
        for i in range(substeps):
            advance(AB, by_state_and_control(by_point[:, i], AB), timestep)
            by_state = np.ascontiguousarray(by_point[:, i, :, :nx])
            advance(E, by_state @ E + by_theta[:, i], timestep)
        A, B = (np.ascontiguousarray(each) for each in np.split(AB, [nx], axis=2))
        return SampleJacobians(A=A, B=B, E=E, states=stepped, accelerations=by_point, forces=forces)

    def change_between(
        self,
        pair: Sequence[Any],
        state: Array,
        ctrl: Array,
        distance: float,
        *,
        is_inertial: bool,
    ) -> ParameterChange:
        """Change of the model by one parameter, by two-sided differences.

        Coordinates in which the model is not linear need no other treatment.

        Args:
            pair: The model at a larger and at a smaller value of the parameter.
            state: (2 nv,) state about which forces are measured.
            ctrl: (nu,) control about which they are measured.
            distance: Distance of the two values.
            is_inertial: Whether the parameter changes nothing but inertias.
        """
        more, less = pair

        # Inertias change no forces of springs and actuators.
        measured = [
            AffineForces.measured(self.simulator, model, state, ctrl, self.sizes)
            for model in (pair[:1] if is_inertial else pair)
        ]
        forces = 2 * measured if is_inertial else measured
        inertias = [barycentric_inertias(model, self.tree.bodies) for model in pair]

        def quotient(larger: Array, smaller: Array) -> Array:
            """Quotient by one parameter."""
            return (larger - smaller)[..., None] / distance

        return ParameterChange(
            inertia=quotient(*inertias),
            springs=quotient(forces[0].springs, forces[1].springs),
            actuators=quotient(forces[0].actuators, forces[1].actuators),
            damping=quotient(more.dof_damping, less.dof_damping),
            armature=quotient(more.dof_armature, less.dof_armature),
        )


def unmoved(by_point: Array) -> Array:
    """(N, 2 nv, 2 nv + nu) derivatives of the state at the beginning of samples.

    Args:
        by_point: (N, s, nv, 2 nv + nu) derivatives of the accelerations.
    """
    N, _, nv, count = by_point.shape
    AB = np.zeros((N, 2 * nv, count))
    AB[..., : 2 * nv] = np.eye(2 * nv)
    return AB


def by_state_and_control(slopes: Array, AB: Array) -> Array:
    """Derivatives within a sample of what depends on the present state and the control.

    Args:
        slopes: (N, w, nx + nu) derivatives by the present state and by the control.
        AB: (N, nx, nx + nu) derivatives of the present state.

    Returns:
        (N, w, nx + nu) derivatives by the state at the beginning of the sample and the control.
    """
    nx = AB.shape[1]
    total = np.ascontiguousarray(slopes[..., :nx]) @ AB
    total[..., nx:] += slopes[..., nx:]
    return total


def advance(derivative: Array, acceleration: Array, timestep: float) -> None:
    """Take derivatives of the state over an engine step, in place.

    The engine adds the acceleration to the speed, then the new speed to the position.

    Args:
        derivative: (N, 2 nv, k) derivatives of the state.
        acceleration: (N, nv, k) derivatives of the mean acceleration.
        timestep: Engine timestep [s].
    """
    nv = acceleration.shape[1]
    derivative[:, nv:] += timestep * acceleration
    derivative[:, :nv] += timestep * derivative[:, nv:]


def _flat(values: Array) -> Array:
    """(N * s, ...) values of all engine steps from (N, s, ...)."""
    return values.reshape(-1, *values.shape[2:])


def observation_jacobian(
    found: SampleJacobians, ctrl: Array, observations: SubstepObservations
) -> Array | None:
    """Derivatives of observations by state and control.

    Args:
        found: Derivatives of N samples.
        ctrl: (N, nu) controls of the samples.
        observations: The w observed quantities.

    Returns:
        (N, S, w, nx+nu) derivatives at the S rows of `SubstepObservations.derivative_rows`; None
        for quantities that have none here.
    """
    if observations.has_stages or len(observations.turns) or len(observations.tendon_lengths):
        return None

    def forces_before(step: int) -> Array:
        """(N, f, nx+nu) derivatives of the forces of the state before an engine step, from 0."""
        if not observations.fields:
            return np.zeros((len(AB), 0, AB.shape[2]))
        slopes = found.forces.actuator_slopes(found.states[:, step], ctrl)
        actuators = by_state_and_control(slopes, AB)
        joints = found.forces.moments.T @ actuators
        tendons = [actuators[:, list(each)].sum(axis=1) for each in observations.tendon_forces]
        parts = [actuators[:, observations.actuator_forces], joints[:, observations.joint_forces]]
        if tendons:
            parts.append(np.stack(tendons, axis=1))
        return np.concatenate(parts, axis=1)

    AB = unmoved(found.accelerations)
    substeps, nv = found.accelerations.shape[1:3]
    rows = []
    for i in range(substeps):
        acceleration = by_state_and_control(found.accelerations[:, i], AB)
        forces = forces_before(i)
        advance(AB, acceleration, observations.timestep)
        if i + 1 in observations.derivative_substeps:
            motion = [AB[:, observations.positions], AB[:, nv + observations.velocities]]
            motion.append(acceleration[:, observations.accelerations])
            rows.append(np.concatenate([*motion, forces], axis=1))

    # The further row has the forces at the end of the sample.
    if observations.force_rows:
        forces = forces_before(substeps)
        before = rows[-1][:, : rows[-1].shape[1] - forces.shape[1]]
        rows.append(np.concatenate([before, forces], axis=1))
    return np.stack(rows, axis=1)


class ClosedFormMemory:
    """Joints and latest derivatives, shared by the closed forms of a plant and of its variants.

    Attributes:
        tree: Joints of the model; None where there is no closed form.
        covered: (p,) True for parameters by which derivatives have a closed form: those that change
            nothing but inertias, or nothing but springs, dampers, gains and armatures.
        latest: Derivatives that were computed last, without those by parameters, after their theta:
            (p,) and their trajectory. The gradient of a design needs those of the trajectory whose
            sensitivities were computed before.
        changes: Change of the model by the covered parameters, by the bytes of theta.
    """

    def __init__(self, simulator: BatchSimulator, parameters: ParameterSet) -> None:
        """Begin with nothing computed."""
        has_form = simulator.is_open_loop and not simulator.sensors
        self.tree = closed_form_tree(simulator.model) if has_form else None
        self.covered = np.array(
            [is_inertial(p) or acts_on_joints(p) for p in parameters.parameters], dtype=bool
        )
        self.latest: tuple[Array, Trajectory, SampleJacobians] | None = None
        self.changes: dict[bytes, ParameterChange] = {}
