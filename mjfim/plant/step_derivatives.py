"""First derivatives of F and h at single samples, by differences of MuJoCo steps.

All samples and all perturbations are stepped in one call.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.closed_form_derivatives import ClosedFormDerivatives
from mjfim.records.trajectory import Linearization, Trajectory

# Relative step of the differences that give A, B, C, D, E and H.
FIRST_DERIVATIVE_STEP = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class MovedSamples:
    """Samples of a trajectory that are moved along each coordinate of (x, u).

    There are n samples, c = nx+nu coordinates and m moves: c forward moves, then c backward moves
    or a single zero move.

    Attributes:
        trajectory_states: (n, ns) states that are not moved.
        states: (m*n, ns) moved states.
        ctrl: (m*n, nu) moved controls.
        batch_shape: (m, n).
        widths: (c, 1, 1) distance between the forward move and the backward or zero one [x-unit,
            u-unit].
    """

    trajectory_states: Array
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
        return np.asarray(difference / self.widths)

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


class StepDerivatives(ClosedFormDerivatives):
    """First derivatives of F and h by state, control and parameters."""

    def linearize(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> Linearization:
        """First derivatives A, B, C, D, E and H along a trajectory, by two-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            step: Difference step relative to `difference_sizes` and `parameter_scale`.

        Returns:
            The first derivatives.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        outputs = self.plant.outputs
        states, ctrl = all_samples(trajectory)
        A, B, C, D = self.jacobians(theta, trajectory, step)

        by_theta, sensors_by_theta = self._one_step_by_theta(theta, states, ctrl, step)
        E = np.moveaxis(_require_finite(by_theta[:, :-1]), 0, 2)
        no_move = np.zeros((len(theta), len(states), self.plant.space.nx))
        H = np.moveaxis(outputs.tangent(states, no_move, sensors_by_theta), 0, 2)
        # Scale errors need the outputs themselves.
        calibration, sensors = self.plant.calibration, None
        if calibration.scales and outputs.needs_sensors:
            model = self.plant.model(theta)
            sensors = self.plant.simulator.step([model], states, ctrl).sensors
        H = calibration.by_theta(outputs(states, sensors), H, theta)
        return Linearization(A=A, B=B, E=E, C=C, D=D, H=H)

    def jacobians(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> tuple[Array, Array, Array, Array]:
        """Derivatives of F and h by state and control along a trajectory, by two-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            step: Difference step relative to `difference_sizes`.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), C: (N+1, ny, nx) and D: (N+1, ny, nu), see
            `Linearization`.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        plant, nx = self.plant, self.plant.space.nx
        moved = self._move_samples(
            *all_samples(trajectory), step * self.difference_sizes(trajectory), True
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
        step: float = FIRST_DERIVATIVE_STEP,
    ) -> tuple[Array, Array, Array]:
        """Derivatives of F and of observations by state and control.

        They have a closed form, or are one-sided differences where the plant has none.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            observations: The w observed quantities.
            step: Difference step relative to `difference_sizes`.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), and (N, S, w, nx+nu) derivative of the
            observations.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        closed = self.closed_form_observations(theta, trajectory, observations)
        if closed is not None:
            return closed[0].A, closed[0].B, closed[1]

        plant, nx = self.plant, self.plant.space.nx
        sizes = self.difference_sizes(trajectory)
        moved = self._move_samples(trajectory.state[:-1], trajectory.ctrl, step * sizes, False)
        stepped = plant.simulator.step([plant.model(theta)], moved.states, moved.ctrl, observations)
        if stepped.observed is None:
            raise ValueError("the simulator returned no observations")

        # The last of the moves is the zero one.
        states = moved.unflatten(stepped.states)[0]
        by_z = plant.space.minus(states[:-1], states[-1:]) / moved.widths
        AB = np.moveaxis(_require_finite(by_z), 0, 2)

        observed = moved.unflatten(stepped.observed)[0]
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
        stepped = self.plant.simulator.step(models, states, ctrl)
        pair = stepped.states.reshape(2, len(widths), -1, states.shape[1])
        dx = self.plant.space.minus(pair[0], pair[1]) / widths
        if stepped.sensors is None:
            return dx, None

        sensors = stepped.sensors.reshape(2, len(widths), -1, stepped.sensors.shape[1])
        return dx, (sensors[0] - sensors[1]) / widths

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
        moved_states = plant.space.plus(states[None], moves[:, None, :nx])
        moved_ctrl = ctrl[None] + moves[:, None, nx:]
        return MovedSamples(
            trajectory_states=states,
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


def all_samples(trajectory: Trajectory) -> tuple[Array, Array]:
    """States (N+1, ns) and controls (N+1, nu) of all samples.

    The last control is held for the outputs of the last sample.
    """
    return trajectory.state, np.concatenate([trajectory.ctrl, trajectory.ctrl[-1:]])


def tiled(curve: Array, count: int) -> Array:
    """(count*n, k) copies of a curve: (n, k), one after the other; k may be 0."""
    return np.tile(curve, (count, 1))


def _require_finite(derivative: Array) -> Array:
    """Return a derivative after a check.

    Raises:
        SimulationDivergedError: A number of the derivative is not finite.
    """
    if not np.isfinite(derivative).all():
        raise SimulationDivergedError("a perturbed step diverged during linearization")
    return derivative
