"""First derivatives of F and h at single samples, in closed form or by differences of MuJoCo steps.

The closed form needs a plant that allows it. All samples and all perturbations are stepped in one
call.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.closed_form import (
    MODEL_STEP,
    ClosedForm,
    SampleJacobians,
    observation_jacobian,
)
from mjfim.plant.dynamics import Dynamics
from mjfim.plant.equation_of_motion import ParameterChange, is_inertial
from mjfim.records.trajectory import Linearization, Trajectory

# Largest number of parameter values for which the change of the model is kept.
MAX_KEPT_CHANGES = 64

# Step along (psi w, w) between two derivatives in closed form. It can be short, because they have
# little round-off.
CLOSED_FORM_STEP = 1e-6

# Smallest divisor; it prevents a division by zero.
TINY = 1e-300

# Relative step of the differences that give A, B, C, D, E and H.
FIRST_DERIVATIVE_STEP = 1e-6


@record
class MovedSamples:
    """Samples of a trajectory that are moved along each coordinate of (x, u).

    There are n samples, c = nx+nu coordinates and m moves: c forward moves, then c backward moves
    or a single zero move.

    Attributes:
        states: (m*n, ns) moved states.
        ctrl: (m*n, nu) moved controls.
        batch_shape: (m, n).
        widths: (c, 1, 1) distance between the forward move and the backward or zero one [x-unit,
            u-unit].
    """

    states: Array
    ctrl: Array
    batch_shape: tuple[int, int]
    widths: Array

    def unflatten(self, values: Array) -> Array:
        """(b, m, n, ...) values of b batches of the moved samples from (b * m * n, ...)."""
        moves, samples = self.batch_shape

        # `reshape` cannot find this number itself where there are no values per sample.
        batches = len(values) // (moves * samples)
        return values.reshape(batches, moves, samples, *values.shape[1:])

    def quotient(self, values: Array) -> Array:
        """(c, n, k) derivative by (x, u) from (m, n, k) values of the moved samples."""
        count = len(self.widths)
        difference = values[:count] - values[count:]
        return difference / self.widths

    def observation_jacobian(self, change: Array) -> Array:
        """Derivative of observations by (x, u).

        Args:
            change: (c, n, S, w) differences of the observations at S rows between the
                forward moves and the backward or zero ones.

        Returns:
            (n, S, w, c) derivative.
        """
        quotient = change / self.widths[..., None]
        return np.moveaxis(quotient, 0, 3)


class FirstDerivatives:
    """First derivatives of F and h by state, control and parameters.

    Those in closed form are None wherever the plant has no closed form.

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
        return self.plant.parameters.magnitude * self._step_factors

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
        return among, np.moveaxis(_propagated(found.A, found.E), 2, 0)

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
        found = self._origin_jacobians(theta, trajectory)
        if found is None:
            return None

        closed, origin = found
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

    def _closed_form(self, trajectory: Trajectory) -> ClosedForm | None:
        """The closed form with the sizes of a trajectory; None where there is none."""
        plant = self.plant
        tree = plant.closed_form_memory.tree
        if tree is None or plant.smooth is not plant:
            return None

        sizes = self.difference_sizes(trajectory)
        return ClosedForm(simulator=plant.simulator, tree=tree, sizes=sizes)

    def _origin_jacobians(
        self, theta: Array, trajectory: Trajectory
    ) -> tuple[ClosedForm, SampleJacobians] | None:
        """The closed form and derivatives along a trajectory: those computed last, or new ones."""
        closed = self._closed_form(trajectory)
        if closed is None:
            return None

        latest = self.plant.closed_form_memory.latest
        if latest is not None:
            known_theta, known_trajectory, known = latest
            if (
                known_trajectory is trajectory
                and known.accelerations.shape[1] == self.plant.simulator.substeps
                and np.array_equal(known_theta, theta)
            ):
                return closed, known

        model = self.plant.model(theta)
        found = closed.jacobians(model, trajectory.state[:-1], trajectory.ctrl)
        if found is None:
            return None
        self._remember(theta, trajectory, found)
        return closed, found

    def _remember(self, theta: Array, trajectory: Trajectory, found: SampleJacobians) -> None:
        """Keep the first derivatives of a trajectory for its mixed ones."""
        without_theta = replace(found, E=np.zeros((*found.E.shape[:2], 0)))
        self.plant.closed_form_memory.latest = np.array(theta), trajectory, without_theta

    def _change_by(
        self, i: int, closed: ClosedForm, theta: Array, trajectory: Trajectory
    ) -> ParameterChange | None:
        """Change of the model by parameter i; None where MuJoCo cannot compile it."""
        step = MODEL_STEP * self.plant.parameters.magnitude[i]
        move = np.zeros(len(theta))
        move[i] = step
        pair, compiled = self.plant.try_models(np.stack([theta + move, theta - move]))
        if not compiled.all():
            return None
        begin, parameter = trajectory.state[0], self.plant.parameters.parameters[i]
        return closed.change_between(
            pair, begin, trajectory.ctrl[0], 2.0 * step, is_inertial=is_inertial(parameter)
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

        changes = []
        for i in np.flatnonzero(memory.covered):
            change = self._change_by(int(i), closed, theta, trajectory)
            if change is None:
                return None
            changes.append(change)

        if len(memory.changes) >= MAX_KEPT_CHANGES:
            memory.changes.clear()
        memory.changes[key] = ParameterChange.joined(changes)
        return memory.changes[key]

    def linearize(self, theta: Array, trajectory: Trajectory) -> Linearization:
        """First derivatives A, B, C, D, E and H along a trajectory, by two-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.

        Returns:
            The first derivatives.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        outputs = self.plant.outputs
        states, ctrl = all_samples(trajectory)
        A, B, C, D = self.jacobians(theta, trajectory)

        by_theta, sensors_by_theta = self._one_step_by_theta(
            theta, states, ctrl, FIRST_DERIVATIVE_STEP
        )
        E = np.moveaxis(_require_finite(by_theta[:, :-1]), 0, 2)
        no_move = np.zeros((len(theta), len(states), self.plant.space.nx))
        H = np.moveaxis(outputs.tangent(states, no_move, sensors_by_theta), 0, 2)
        # Scale errors need the outputs themselves.
        calibration, sensors = self.plant.calibration, None
        if calibration.scales and outputs.needs_sensors:
            model = self.plant.model(theta)
            _, sensors, _ = self.plant.simulator.step([model], states, ctrl)
        H = calibration.by_theta(outputs(states, sensors), H, theta)
        return Linearization(A=A, B=B, E=E, C=C, D=D, H=H)

    def jacobians(self, theta: Array, trajectory: Trajectory) -> tuple[Array, Array, Array, Array]:
        """Derivatives of F and h by state and control along a trajectory, by two-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), C: (N+1, ny, nx) and D: (N+1, ny, nu), see
            `Linearization`.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        plant, nx = self.plant, self.plant.space.nx
        moved = self._move_samples(
            *all_samples(trajectory),
            FIRST_DERIVATIVE_STEP * self.difference_sizes(trajectory),
            True,
        )
        models = [plant.model(theta)]
        by_z, sensors_by_z = self._central_quotients(models, moved.states, moved.ctrl, moved.widths)

        AB = np.moveaxis(_require_finite(by_z[:, :-1]), 0, 2)
        dy = plant.outputs.tangent(trajectory.state, self._unit_moves(by_z.shape[1]), sensors_by_z)
        CD = plant.calibration.scaled(np.moveaxis(dy, 0, 2), theta)
        return AB[..., :nx], AB[..., nx:], CD[..., :nx], CD[..., nx:]

    def observation_jacobians(
        self,
        theta: Array,
        trajectory: Trajectory,
        observations: SubstepObservations,
    ) -> tuple[Array, Array, Array]:
        """Derivatives of F and of observations by state and control.

        They have a closed form, or are one-sided differences where the plant has none.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            observations: The w observed quantities.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), and (N, S, w, nx+nu) derivative of the
            observations.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        found = self._origin_jacobians(theta, trajectory)
        if found is not None:
            origin = found[1]
            observed = observation_jacobian(origin, trajectory.ctrl, observations)
            if observed is not None:
                return origin.A, origin.B, observed
        return self._differences(theta, trajectory, observations)

    def _differences(
        self, theta: Array, trajectory: Trajectory, observations: SubstepObservations
    ) -> tuple[Array, Array, Array]:
        """One-sided differences of F and of observations by state and control."""
        plant, nx = self.plant, self.plant.space.nx
        steps = FIRST_DERIVATIVE_STEP * self.difference_sizes(trajectory)
        moved = self._move_samples(trajectory.state[:-1], trajectory.ctrl, steps, False)
        model = plant.model(theta)
        after, _, seen = plant.simulator.step([model], moved.states, moved.ctrl, observations)
        assert seen is not None

        # The last of the moves is the zero one.
        states = moved.unflatten(after)[0]
        by_z = plant.space.minus(states[:-1], states[-1:]) / moved.widths
        AB = np.moveaxis(_require_finite(by_z), 0, 2)

        observed = moved.unflatten(seen)[0]
        jacobian = moved.observation_jacobian(observed[:-1] - observed[-1:])
        return AB[..., :nx], AB[..., nx:], jacobian

    def one_step(
        self,
        theta: Array,
        trajectory: Trajectory,
        samples: np.ndarray,
        step: float,
    ) -> Array:
        """Effect of each parameter on the next state and on the sensors at given samples.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            samples: Indices of the samples.
            step: Difference step relative to `parameter_scale`.

        Returns:
            (n, p) effects. A row is relative to the size of a state component [1/s], or to the
            largest effect on an output, each parameter changed by its size.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        plant = self.plant
        states = trajectory.state[samples]
        dx, ds = self._one_step_by_theta(theta, states, trajectory.ctrl[samples], step)
        state_sizes = self.difference_sizes(trajectory)[: plant.space.nx]
        effects = [_require_finite(dx) / (plant.dt * state_sizes)]

        if ds is not None:
            dy = plant.outputs.tangent(states, np.zeros_like(dx), ds)
            magnitudes = plant.parameters.magnitude[:, None, None]
            largest = np.abs(dy * magnitudes).max(axis=(0, 1))
            effects.append(dy / np.where(largest > 0.0, largest, 1.0))
        return np.concatenate([effect.reshape(len(theta), -1) for effect in effects], axis=1).T

    def _one_step_by_theta(
        self, theta: Array, states: Array, ctrl: Array, step: float
    ) -> tuple[Array, Array | None]:
        """Derivatives of single steps by theta, by two-sided differences.

        Args:
            theta: (p,) parameters [theta-unit].
            states: (n, ns) states.
            ctrl: (n, nu) controls.
            step: Difference step relative to `parameter_scale`.

        Returns:
            (p, n, nx) derivative of the next state, and (p, n, nsensordata) of the sensors, or None
            without sensors.
        """
        h = step * self.parameter_scale
        moves = np.diag(h)
        models = self.plant.models(np.concatenate([theta + moves, theta - moves]))
        every_state = tiled(states, len(models))
        every_ctrl = tiled(ctrl, len(models))
        return self._central_quotients(models, every_state, every_ctrl, 2.0 * h[:, None, None])

    def _central_quotients(
        self, models: list[Any], states: Array, ctrl: Array, widths: Array
    ) -> tuple[Array, Array | None]:
        """Two-sided difference quotients of the next state and of the sensors.

        Args:
            models: One model, or one for each of the 2*count moves.
            states: (2*count*n, ns) states; the first half is moved forward, the second backward.
            ctrl: (2*count*n, nu) controls, in the order of the states.
            widths: (count, 1, 1) distances between the forward and the backward move.

        Returns:
            (count, n, nx) quotients of the next state, and (count, n, nsensordata) of the sensors,
            or None without sensors.
        """
        after, sensors, _ = self.plant.simulator.step(models, states, ctrl)
        moves = 2 * len(widths)
        if sensors is not None:
            sensors = sensors.reshape(moves, -1, sensors.shape[1])
        return self.quotients(after.reshape(moves, -1, after.shape[1]), sensors, widths)

    def quotients(
        self,
        states: Array,
        sensors: Array | None,
        widths: Array,
        origin: tuple[Array, Any] | None = None,
    ) -> tuple[Array, Array | None]:
        """Difference quotients of states and of sensor data.

        Args:
            states: (q, ..., ns) states of forward moves, or (2 q, ..., ns) with backward ones.
            sensors: Their sensor data, or None.
            widths: q distances of the moves that are compared.
            origin: States and sensor data without a move; None where there are backward moves.

        Returns:
            (q, ..., nx) quotients of the states, and (q, ..., nsensordata) of the sensors, or None
            without sensors.
        """
        q = len(widths)
        width = widths.reshape(-1, *[1] * (states.ndim - 1))
        other: tuple[Array, Any] = origin or (states[q:], None if sensors is None else sensors[q:])
        dx = self.plant.space.minus(states[:q], other[0]) / width
        return dx, None if sensors is None else (sensors[:q] - other[1]) / width

    def _move_samples(
        self, states: Array, ctrl: Array, steps: Array, central: bool
    ) -> MovedSamples:
        """Move samples along each coordinate of (x, u).

        Args:
            states: (n, ns) states.
            ctrl: (n, nu) controls.
            steps: (nx+nu,) step along each coordinate [x-unit, u-unit].
            central: True for two-sided differences.
        """
        plant, nx = self.plant, self.plant.space.nx
        backward = -np.diag(steps) if central else np.zeros((1, len(steps)))
        moves = np.concatenate([np.diag(steps), backward])
        moves[:, :nx] *= plant.moves_freely
        moved_states = plant.space.plus(states[None], moves[:, None, :nx])
        moved_ctrl = ctrl[None] + moves[:, None, nx:]
        return MovedSamples(
            states=moved_states.reshape(-1, states.shape[1]),
            ctrl=moved_ctrl.reshape(len(moves) * len(states), plant.nu),
            batch_shape=(len(moves), len(states)),
            widths=(2.0 if central else 1.0) * steps[:, None, None],
        )

    def _unit_moves(self, samples: int) -> Array:
        """(nx+nu, samples, nx) tangent move of the state per unit of each coordinate of (x, u)."""
        nx = self.plant.space.nx
        moves = np.zeros((nx + self.plant.nu, samples, nx))
        moves[:nx] = np.eye(nx)[:, None, :]
        return moves


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


def all_samples(trajectory: Trajectory) -> tuple[Array, Array]:
    """States (N+1, ns) and controls (N+1, nu) of all samples.

    The last control is held for the outputs of the last sample.
    """
    return trajectory.state, np.concatenate([trajectory.ctrl, trajectory.ctrl[-1:]])


def tiled(curve: Array, count: int) -> Array:
    """(count*n, k) copies of a curve: (n, k), one after the other; k may be 0."""
    return np.tile(curve, (count, 1))


def _propagated(A: Array, E: Array) -> Array:
    """(N+1, nx, c) sensitivities `psi_{k+1} = A_k psi_k + E_k` that begin at zero."""
    psi = np.zeros((len(A) + 1, *E.shape[1:]))
    for k, (A_k, E_k) in enumerate(zip(A, E, strict=True)):
        psi[k + 1] = A_k @ psi[k] + E_k
    return psi


def _require_finite(derivative: Array) -> Array:
    """Return a derivative after a check.

    Raises:
        SimulationDivergedError: A number of the derivative is not finite.
    """
    if not np.isfinite(derivative).all():
        raise SimulationDivergedError("a perturbed step diverged during linearization")
    return derivative
