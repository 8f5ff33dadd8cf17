"""Derivatives along a trajectory in closed form, where the plant allows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.closed_form.affine_forces import ParameterChange, is_inertial
from mjfim.plant.closed_form.samples import (
    MODEL_STEP,
    ClosedForm,
    KnownJacobians,
    SampleJacobians,
    observation_jacobian,
)
from mjfim.plant.dynamics import Dynamics
from mjfim.records.trajectory import Trajectory

# Largest number of parameter values for which the change of the model is kept.
MAX_KEPT_CHANGES = 64

# Step along (psi w, w) between two derivatives in closed form. It can be short, because they have
# little round-off.
CLOSED_FORM_STEP = 1e-6


# Smallest divisor; it prevents a division by zero.
TINY = 1e-300


class ClosedFormDerivatives:
    """Derivatives in closed form; None wherever the plant has no closed form.

    Attributes:
        plant: The plant.
    """

    def __init__(self, plant: Dynamics, step_factors: Array | None = None) -> None:
        """Set the plant and the factors of its difference steps.

        Args:
            plant: The plant.
            step_factors: (p,) factors by which the difference steps of the parameters are
                lengthened; None takes 1.
        """
        self.plant = plant
        self._step_factors = (
            np.ones(len(plant.parameters)) if step_factors is None else step_factors
        )

    @property
    def parameter_scale(self) -> Array:
        """(p,) magnitude of each parameter, to which its steps are relative [theta-unit]."""
        return np.asarray(self.plant.parameters.magnitude * self._step_factors)

    def difference_sizes(self, trajectory: Trajectory) -> Array:
        """Magnitudes of state and control along a trajectory, to which steps are relative.

        They are the largest values along the trajectory, or the natural sizes of the model where it
        hardly moves. A rotation has the magnitude 1.

        Args:
            trajectory: The trajectory.

        Returns:
            (nx+nu,) magnitudes [x-unit, u-unit].
        """
        return self.plant.sizes.along(trajectory)

    def direction_step(self, relative_step: float, relative_direction: Array, w: Array) -> float:
        """Step along (psi w, w).

        It is relative to the larger of the two parts.

        Args:
            relative_step: The step where the larger part is 1.
            relative_direction: (..., nx) direction psi w, divided by the sizes of the state.
            w: (p,) direction of the parameters [theta-unit].
        """
        in_model = self.plant.parameters.changes_model
        relative = np.where(in_model, np.abs(w / self.parameter_scale), 0.0).max(initial=0.0)
        largest = max(np.abs(relative_direction).max(initial=0.0), relative, TINY)
        return float(relative_step / largest)

    def closed_form_sensitivity(
        self, theta: Array, trajectory: Trajectory, directions: Array
    ) -> tuple[np.ndarray, Array] | None:
        """Sensitivities of the states along directions of the covered parameters.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            directions: (n, p) directions of theta [theta-unit].

        Returns:
            (n,) True for the c directions of the covered parameters, and (c, N+1, nx) sensitivities
            along these [x-unit]; None where there is no closed form or no such direction.
        """
        memory = self.plant.closed_form_memory
        among = np.asarray(~directions[:, ~memory.covered].any(axis=1))
        closed = self._closed_form(trajectory)
        if closed is None or not among.any():
            return None

        change = self._change(closed, theta, trajectory)
        if change is None:
            return None

        found = closed.jacobians(
            self.plant.model(theta),
            trajectory.state[:-1],
            trajectory.ctrl,
            change.along(directions[np.ix_(among, memory.covered)]),
        )
        if found is None:
            return None

        self._remember(theta, trajectory, found)
        psi = np.zeros((len(found.A) + 1, *found.E.shape[1:]))
        for k, (A, E) in enumerate(zip(found.A, found.E, strict=True)):
            psi[k + 1] = A @ psi[k] + E
        return among, np.moveaxis(psi, 2, 0)

    def closed_form_mixed(
        self, theta: Array, trajectory: Trajectory, psi: Array, directions: Array
    ) -> tuple[SampleJacobians, Array] | None:
        """First derivatives of F, and mixed second ones along directions (psi w, w).

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            psi: (N+1, nx, p) sensitivity [x-unit / theta-unit].
            directions: (r, p) directions w [theta-unit].

        Returns:
            The first derivatives, and (r, N, nx+nu, nx) derivatives of `DF[psi w, w]` by (x, u);
            None where there is no closed form.
        """
        closed = self._closed_form(trajectory)
        origin = None if closed is None else self._origin_jacobians(closed, theta, trajectory)
        if closed is None or origin is None:
            return None

        nx = self.plant.space.nx
        sizes = self.difference_sizes(trajectory)[:nx]
        mixed = np.zeros((len(directions), *origin.A.shape[:1], nx + self.plant.nu, nx))
        for r, w in enumerate(directions):
            along = psi[:-1] @ w
            epsilon = self.direction_step(CLOSED_FORM_STEP, along / sizes, w)
            states = self.plant.space.plus(trajectory.state[:-1], epsilon * along)
            model = self.plant.models((theta + epsilon * w)[None])[0]
            moved = closed.jacobians(model, states, trajectory.ctrl)
            if moved is None:
                return None

            by_both = np.concatenate([moved.A - origin.A, moved.B - origin.B], axis=2)
            mixed[r] = np.swapaxes(by_both, 1, 2) / epsilon

            # A force that reaches its limit between the two is a jump and has no derivative.
            mixed[r][~_has_same_clamps(origin, moved, trajectory.ctrl)] = 0.0
        return origin, mixed

    def closed_form_observations(
        self, theta: Array, trajectory: Trajectory, observations: SubstepObservations
    ) -> tuple[SampleJacobians, Array] | None:
        """First derivatives of F and of observations.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            observations: The w observed quantities.

        Returns:
            The first derivatives, and (N, S, w, nx+nu) derivatives of the observations by (x, u);
            None where there is no closed form.
        """
        closed = self._closed_form(trajectory)
        origin = None if closed is None else self._origin_jacobians(closed, theta, trajectory)
        if origin is None:
            return None

        observed = observation_jacobian(origin, trajectory.ctrl, observations)
        return None if observed is None else (origin, observed)

    def _closed_form(self, trajectory: Trajectory) -> ClosedForm | None:
        """The closed form with the sizes of a trajectory; None where there is none."""
        plant = self.plant
        tree = plant.closed_form_memory.tree
        if tree is None or plant.smooth is not plant:
            return None

        sizes = self.difference_sizes(trajectory)
        return ClosedForm(simulator=plant.simulator, tree=tree, sizes=sizes)

    def _origin_jacobians(
        self, closed: ClosedForm, theta: Array, trajectory: Trajectory
    ) -> SampleJacobians | None:
        """Derivatives along a trajectory: those that were computed last, or new ones."""
        known = self.plant.closed_form_memory.latest
        if (
            known is not None
            and known.trajectory is trajectory
            and known.substeps == self.plant.simulator.substeps
            and np.array_equal(known.theta, theta)
        ):
            return known.jacobians

        model = self.plant.model(theta)
        found = closed.jacobians(model, trajectory.state[:-1], trajectory.ctrl)
        if found is not None:
            self._remember(theta, trajectory, found)
        return found

    def _remember(self, theta: Array, trajectory: Trajectory, found: SampleJacobians) -> None:
        """Keep the first derivatives of a trajectory for its mixed ones."""
        self.plant.closed_form_memory.latest = KnownJacobians(
            theta=np.array(theta),
            trajectory=trajectory,
            substeps=self.plant.simulator.substeps,
            jacobians=replace(found, E=np.zeros((*found.E.shape[:2], 0))),
        )

    def _change(
        self, closed: ClosedForm, theta: Array, trajectory: Trajectory
    ) -> ParameterChange | None:
        """Change of the model by the covered parameters; None where MuJoCo cannot compile it."""
        memory = self.plant.closed_form_memory
        key = np.asarray(theta, dtype=np.float64).tobytes()
        known = memory.changes.get(key)
        if known is not None:
            return known

        steps = MODEL_STEP * self.plant.parameters.magnitude
        changes = []
        for i in np.flatnonzero(memory.covered):
            move = np.zeros(len(theta))
            move[i] = steps[i]
            pair, compiled = self.plant.try_models(np.stack([theta + move, theta - move]))
            if not compiled.all():
                return None
            begin = trajectory.state[0], trajectory.ctrl[0]
            parameter = self.plant.parameters.parameters[i]
            change = closed.change_between(
                pair, *begin, 2.0 * steps[i], is_inertial=is_inertial(parameter)
            )
            changes.append(change)

        if len(memory.changes) >= MAX_KEPT_CHANGES:
            memory.changes.clear()
        memory.changes[key] = ParameterChange.joined(changes)
        return memory.changes[key]


def _has_same_clamps(origin: SampleJacobians, moved: SampleJacobians, ctrl: Array) -> np.ndarray:
    """(N,) True for samples in which the same actuators' forces are clamped in both motions.

    Args:
        origin: Derivatives along a motion.
        moved: Derivatives along the motion beside it.
        ctrl: (N, nu) controls of both.
    """
    N, points, nx = origin.states.shape
    held = np.repeat(ctrl, points - 1, axis=0)
    own, other = (
        each.forces.clamped(each.states[:, :-1].reshape(-1, nx), held) for each in (origin, moved)
    )
    return np.asarray((own == other).reshape(N, -1).all(axis=1))
