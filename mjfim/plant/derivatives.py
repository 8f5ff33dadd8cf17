"""Derivatives of the plant.

These are first and mixed second derivatives of F and h, and sensitivities of whole rollouts. Every
derivative is a difference of MuJoCo steps in tangent-space coordinates (`StateSpace`). All samples
and all perturbations are stepped in one call.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.plant.batch import Rollouts, SubstepObservations
from mjfim.plant.delay import OutputDelay
from mjfim.records.trajectory import Linearization, Sensitivity, Trajectory

if TYPE_CHECKING:
    from mjfim.plant.plant import Plant


@dataclass(frozen=True, kw_only=True)
class DifferenceAccuracy:
    """Kind and steps of the differences for mixed second derivatives.

    Attributes:
        central: True for two-sided differences in state and control, False for one-sided ones.
        coordinate_step: Step in state and control, relative to the size of the perturbed number.
        direction_step: Step along (psi w, w), relative to the larger of its two parts.
        shared_origin: True for differences that are one-sided along (psi w, w) as well, so that
            all directions share the steps at the origin.
    """

    central: bool
    coordinate_step: float
    direction_step: float
    shared_origin: bool = False


# One-sided in state and control, two-sided along (psi w, w): a relative error of about 1e-5.
FORWARD_DIFFERENCES = DifferenceAccuracy(central=False, coordinate_step=1e-6, direction_step=3e-3)

# One-sided in everything: the quickest differences, for a plant whose derivatives do not jump.
SHARED_ORIGIN = DifferenceAccuracy(
    central=False, coordinate_step=1e-6, direction_step=1e-3, shared_origin=True
)

# One-sided in everything with a short step, for a plant with smoothed dry friction, whose
# derivatives change quickly.
SHARED_ORIGIN_SHORT = DifferenceAccuracy(
    central=False, coordinate_step=1e-6, direction_step=1e-5, shared_origin=True
)

# Two-sided in everything: the most accurate differences.
CENTRAL_DIFFERENCES = DifferenceAccuracy(central=True, coordinate_step=1e-4, direction_step=1e-3)

# Relative step of the differences that give A, B, C, D, E and H.
FIRST_DERIVATIVE_STEP = 1e-6

# Relative step of the differences between whole rollouts.
SENSITIVITY_STEP = 1e-5

# Relative effect of a parameter on the trajectory below which its steps are lengthened.
MIN_PARAMETER_EFFECT = 1e-2

# Largest factor by which the difference step of a parameter is lengthened.
MAX_STEP_FACTOR = 100.0

# Largest number of state values that are in memory at once.
MAX_NUMBERS_AT_ONCE = 8_000_000

# Magnitude of a control [u-unit] below which its difference step is absolute instead of relative.
MIN_CONTROL_SIZE = 1e-3

# Smallest divisor; it prevents a division by zero.
TINY = 1e-300


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """Outputs of S curves over an interval of samples, and their derivatives.

    Delays of the outputs are left out.

    Attributes:
        first: Sample of the curves at which the arrays begin.
        y: (S, n+1, ny) outputs [y-unit].
        common: (S, n+1, ny, p) derivative by theta [y-unit / theta-unit], or None if not requested.
        private: (S, n+1, ny, k) derivative by directions of the initial state [y-unit / x-unit], or
            None if not requested.
    """

    first: int
    y: Array
    common: Array | None
    private: Array | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Bilinear:
    """First derivatives of F and h, and mixed second derivatives along r directions (psi w, w).

    Attributes:
        A: (N, nx, nx) F_x [x-unit / x-unit].
        B: (N, nx, nu) F_u [x-unit / u-unit].
        C: (N+1, ny, nx) h_x [y-unit / x-unit].
        D: (N+1, ny, nu) h_u [y-unit / u-unit].
        F_mixed: (r, N, nx+nu, nx) derivative of `DF[psi w, w]` by (x, u).
        h_mixed: (r, N+1, nx+nu, ny) derivative of `Dh[psi w, w]` by (x, u), or None where it is
            zero.
        output_delay: Time delay of the outputs, or None.
        delay_derivative: (p,) derivative of the delay by theta [s / theta-unit].
        observation_jacobian: (N, derivative substeps, w, nx+nu) derivative of the observations by
            (x, u), or None if nothing was observed.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    F_mixed: Array
    h_mixed: Array | None
    output_delay: OutputDelay | None = None
    delay_derivative: Array | None = None
    observation_jacobian: Array | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class _MovedSamples:
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
            change: (c, n, derivative substeps, w) differences of the observations between the
                forward moves and the backward or zero ones.

        Returns:
            (n, derivative substeps, w, c) derivative.
        """
        quotient = change / self.widths[..., None]
        return np.moveaxis(quotient, 0, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class _PairDerivatives:
    """Differences by the c coordinates of (x, u) of two steps at +-epsilon along (psi w, w).

    Attributes:
        first: (c, n, nx) first differences of F.
        mixed: (c, n, nx) mixed differences of F.
        sensor_first: (c, n, nsensordata) first differences of the sensors, or None without sensors.
        sensor_mixed: (c, n, nsensordata) mixed differences of the sensors, or None without sensors.
        observation_jacobian: (N, derivative substeps, w, c) first differences of the observations,
            or None.
    """

    first: Array
    mixed: Array
    sensor_first: Array | None
    sensor_mixed: Array | None
    observation_jacobian: Array | None


@dataclass(frozen=True, kw_only=True, eq=False)
class _ResponseMoves:
    """Moves whose rollouts give the derivatives of a response along q directions.

    Attributes:
        theta: (J, p) moves of theta [theta-unit]: a zero move, q forward moves, and q backward
            moves for two-sided differences.
        initial_state: (J, nx) moves of the initial state, in the order of `theta` [x-unit].
        moving: Indices of the parameters among the q directions, which come first.
        widths: (q,) distance between the two moves of a quotient.
        central: True for two-sided differences.
    """

    theta: Array
    initial_state: Array
    moving: np.ndarray
    widths: Array
    central: bool


class Derivatives:
    """Derivatives of a plant by differences of MuJoCo steps.

    Attributes:
        plant: The plant.
    """

    def __init__(self, plant: Plant, step_factors: Array | None = None) -> None:
        """Build the derivatives of a plant.

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
    def quickest_accuracy(self) -> DifferenceAccuracy:
        """The quickest differences for mixed second derivatives of this plant."""
        return SHARED_ORIGIN_SHORT if self.plant.smooth.source.smoothing_speeds else SHARED_ORIGIN

    @property
    def parameter_scale(self) -> Array:
        """(p,) magnitude of each parameter, to which its steps are relative [theta-unit]."""
        return np.asarray(self.plant.parameters.magnitude * self._step_factors)

    def difference_sizes(self, trajectory: Trajectory) -> Array:
        """Magnitudes of state and control along a trajectory, to which steps are relative.

        Args:
            trajectory: The trajectory.

        Returns:
            (nx+nu,) magnitudes, 1 for positions and at least 1 for velocities and activations
            [x-unit, u-unit].
        """
        position = np.ones(self.plant.space.nv)
        velocity = np.maximum(1.0, np.abs(trajectory.qvel).max(axis=0, initial=0.0))
        activation = np.maximum(1.0, np.abs(trajectory.act).max(axis=0, initial=0.0))
        largest = np.abs(trajectory.ctrl).max(axis=0)
        control = np.where(largest > MIN_CONTROL_SIZE, largest, 1.0)
        return np.concatenate([position, velocity, activation, control])

    def calibrated_step_factors(self, theta: Array, trajectory: Trajectory) -> Array | None:
        """Factors of the parameters' difference steps with which their effect exceeds round-off.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Trajectory on which the effect of every parameter is measured.

        Returns:
            (p,) factors of at least 1, or None if a perturbed rollout diverges.
        """
        found = self.sensitivity(theta, trajectory)
        if found is None:
            return None

        state_sizes = self.difference_sizes(trajectory)[: self.plant.space.nx]
        sizes = np.concatenate([state_sizes, np.ones(len(self.plant.outputs))])
        moves = np.concatenate([found.psi, found.G], axis=1) * self.plant.parameters.magnitude
        effect = (np.abs(moves).max(axis=0) / sizes[:, None]).max(axis=0)
        factors = MIN_PARAMETER_EFFECT / np.maximum(effect, TINY)
        return np.asarray(np.clip(factors, 1.0, MAX_STEP_FACTOR))

    # ---- whole rollouts

    def predict(
        self, theta: Array, ctrl: Array, step: float = SENSITIVITY_STEP
    ) -> tuple[Array, Array] | None:
        """Outputs of an open-loop simulation and their sensitivity, by two-sided differences.

        Args:
            theta: (p,) parameters [theta-unit].
            ctrl: (N, nu) controls.
            step: Difference step relative to `parameter_scale`.

        Returns:
            y: (N+1, ny) outputs [y-unit] and G: (N+1, ny, p) [y-unit / theta-unit], or None if a
            simulation diverges.
        """
        found = self._rollout_differences(theta, self.plant.initial_state(theta), ctrl, step)
        return None if found is None else (found[0], found[1].G)

    def sensitivity(
        self,
        theta: Array,
        trajectory: Trajectory,
        step: float | Array = SENSITIVITY_STEP,
        central: bool = True,
    ) -> Sensitivity | None:
        """Sensitivities psi and G of a trajectory at fixed control, by differences of rollouts.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Open-loop or closed-loop trajectory; its control is kept.
            step: Difference step relative to `parameter_scale`, one number or (p,).
            central: True for two-sided differences. False is honoured only if no sensor is an
                output.

        Returns:
            The sensitivities, or None if a perturbed rollout diverges.
        """
        found = self._rollout_differences(
            theta,
            trajectory.state[0],
            trajectory.ctrl,
            step,
            states=trajectory.state,
            central=central or self.plant.outputs.needs_sensors,
        )
        return None if found is None else found[1]

    def _rollout_differences(
        self,
        theta: Array,
        initial_state: Array,
        ctrl: Array,
        step: float | Array,
        *,
        states: Array | None = None,
        central: bool = True,
    ) -> tuple[Array, Sensitivity] | None:
        """Outputs and sensitivities from rollouts at theta +- h.

        There is one pair of rollouts for every parameter that changes the motion. Without `states`,
        and where sensors are delayed, one more rollout gives the states and sensors at theta.

        Args:
            theta: (p,) parameters [theta-unit].
            initial_state: (ns,) initial state at theta.
            ctrl: (N, nu) controls.
            step: Difference step relative to `parameter_scale`, one number or (p,).
            states: (N+1, ns) states at theta, or None where they are not known.
            central: True for two-sided differences.

        Returns:
            y: (N+1, ny) outputs [y-unit] and the sensitivities, or None if a rollout diverges. The
            outputs of sensors are NaN where the rollout at theta was not simulated.
        """
        plant = self.plant
        delay = plant.output_delay(theta, len(ctrl) + 1)
        needs_origin = states is None or (delay is not None and plant.outputs.needs_sensors)

        moving = np.flatnonzero(plant.parameters.changes_motion)
        h = (step * self.parameter_scale)[moving]
        moves = _theta_moves(len(theta), moving, h, central, needs_origin)

        sensors = None
        origin = np.zeros((len(ctrl) + 1, 0)) if states is None else states
        psi = np.zeros((len(origin), plant.space.nx, len(theta)))
        G = np.zeros((len(origin), len(plant.outputs), len(theta)))
        if len(moves):
            out = self._moved_rollouts(theta, initial_state, ctrl, moves)
            if out is None:
                return None
            if needs_origin:
                origin = out.states[-1]
                sensors = None if out.sensors is None else out.sensors[-1]
            dx, dy = self._rollout_quotients(out, origin, h, central)
            psi[..., moving] = np.moveaxis(dx, 0, 2)
            G[..., moving] = np.moveaxis(dy, 0, 2)

        # Biases and the delay act on the outputs of the simulation.
        G += plant.bias_derivative
        y = plant.outputs(origin, sensors) + plant.bias_derivative @ theta
        if delay is not None:
            by_delay = delay.derivative(y)[..., None] * plant.parameters.delay_derivative
            G = delay.apply(G) + by_delay
            y = delay.apply(y)
        return y, Sensitivity(psi=psi, G=G)

    def _rollout_quotients(
        self, out: Rollouts, origin: Array, h: Array, central: bool
    ) -> tuple[Array, Array]:
        """Difference quotients of states and outputs.

        Args:
            out: Rollouts at the moves of `_theta_moves`.
            origin: (N+1, ns) states at theta.
            h: (n,) difference steps of the n parameters that are moved [theta-unit].
            central: True for two-sided differences.

        Returns:
            (n, N+1, nx) quotients of the states [x-unit / theta-unit], and (n, N+1, ny) of the
            outputs [y-unit / theta-unit].
        """
        plant, count = self.plant, len(h)
        width = (2.0 if central else 1.0) * h[:, None, None]

        other = out.states[count : 2 * count] if central else origin
        dx = plant.space.minus(out.states[:count], other) / width

        # Differences are two-sided wherever sensors are simulated.
        ds = None
        if out.sensors is not None:
            ds = (out.sensors[:count] - out.sensors[count : 2 * count]) / width
        return dx, plant.outputs.tangent(origin, dx, ds)

    def _moved_rollouts(
        self, theta: Array, initial_state: Array, ctrl: Array, moves: Array
    ) -> Rollouts | None:
        """Rollouts at theta plus each row of moves: (m, p), all under one control.

        The parameters move the initial state as well.

        Returns:
            The rollouts, or None if one of them diverges or its model cannot be compiled.
        """
        plant = self.plant
        state_moves = moves @ plant.initial_state_derivative.T
        initial_states = plant.space.plus(initial_state, state_moves)

        held = np.broadcast_to(ctrl, (len(moves), *ctrl.shape))
        models, compiled = plant.try_models(theta + moves)
        out = plant.simulator.rollout(models, initial_states, held)
        return out if (out.finite & compiled).all() else None

    def responses(
        self,
        theta: Array,
        initial_states: Array,
        ctrl: Array,
        *,
        start_directions: Array | None = None,
        central: bool = True,
        step: float = SENSITIVITY_STEP,
        wanted: np.ndarray | None = None,
        max_numbers: int = MAX_NUMBERS_AT_ONCE,
    ) -> Iterator[Response | None]:
        """Simulate S curves, with derivatives by theta and by the initial state.

        The samples are divided into intervals, which are simulated one after the other, so that the
        memory is bounded.

        Args:
            theta: (p,) parameters [theta-unit].
            initial_states: (S, ns) initial states.
            ctrl: (S, N, nu) controls.
            start_directions: (nx, k) directions of the initial state by which to differentiate;
                None for no derivatives, neither by the initial state nor by theta.
            central: True for two-sided differences.
            step: Difference step relative to `parameter_scale`.
            wanted: (p,) True for parameters by which to differentiate; None for all. Biases are
                always included, because they need no simulation.
            max_numbers: Largest number of state values of one interval.

        Yields:
            The response over each interval; None, and nothing after it, if a simulation diverges.
        """
        plant = self.plant
        moves = self._response_moves(theta, start_directions, central, step, wanted)
        models, compiled = plant.try_models(theta + moves.theta)

        # States at the beginning of the interval: those of each of the J moves for all S curves.
        current = plant.space.plus(initial_states, moves.initial_state[:, None])
        J, S, state_size = current.shape
        if J > 1:
            models = [model for model in models for _ in range(S)]

        numbers_per_sample = J * S * plant.simulator.substeps * (1 + state_size)
        interval = int(np.clip(max_numbers / numbers_per_sample, 1, ctrl.shape[1]))
        for first in range(0, ctrl.shape[1], interval):
            held = ctrl[:, first : first + interval]
            every = np.broadcast_to(held, (J, *held.shape)).reshape(J * S, *held.shape[1:])
            out = plant.simulator.rollout(models, current.reshape(J * S, -1), every)
            if not (out.finite.all() and compiled.all()):
                yield None
                return

            samples = held.shape[1] + 1
            states = out.states.reshape(J, S, samples, -1)
            sensors = None if out.sensors is None else out.sensors.reshape(J, S, samples, -1)
            yield self._response(theta, first, states, sensors, moves, start_directions is not None)
            current = states[:, :, -1]

    def _response_moves(
        self,
        theta: Array,
        start_directions: Array | None,
        central: bool,
        step: float,
        wanted: np.ndarray | None,
    ) -> _ResponseMoves:
        """Moves along parameters, then along k directions of the initial state.

        Parameters are moved if they are wanted and change the motion. The arguments are those of
        `responses`.
        """
        plant, p = self.plant, len(theta)
        if start_directions is None:
            start_directions = np.zeros((plant.space.nx, 0))
            moving = np.zeros(0, dtype=np.intp)
        else:
            chosen = plant.parameters.changes_motion
            moving = np.flatnonzero(chosen if wanted is None else chosen & wanted)

        h = (step * self.parameter_scale)[moving]
        k = start_directions.shape[1]
        theta_moves = np.zeros((len(moving) + k, p))
        theta_moves[np.arange(len(moving)), moving] = h

        # A parameter that is a deviation of the initial state moves theta and the initial state.
        state_moves = theta_moves @ plant.initial_state_derivative.T
        state_moves[len(moving) :] = step * start_directions.T

        return _ResponseMoves(
            theta=_with_origin(theta_moves, central),
            initial_state=_with_origin(state_moves, central),
            moving=moving,
            widths=np.concatenate([h, np.full(k, step)]) * (2.0 if central else 1.0),
            central=central,
        )

    def _response(
        self,
        theta: Array,
        first: int,
        states: Array,
        sensors: Array | None,
        moves: _ResponseMoves,
        differentiate: bool,
    ) -> Response:
        """Response over one interval.

        Args:
            theta: (p,) parameters [theta-unit].
            first: Sample at which the interval begins.
            states: (J, S, n+1, ns) states of all moves.
            sensors: (J, S, n+1, nsensordata) sensor data of all moves, or None.
            moves: The J moves.
            differentiate: Whether derivatives are requested.
        """
        outputs, bias = self.plant.outputs, self.plant.bias_derivative
        y = outputs(states[0], None if sensors is None else sensors[0]) + bias @ theta
        if not differentiate:
            return Response(first=first, y=y, common=None, private=None)

        q = len(moves.widths)
        width = moves.widths.reshape(-1, 1, 1, 1)
        other = states[q + 1 :] if moves.central else states[0]
        dx = self.plant.space.minus(states[1 : q + 1], other) / width
        ds = None
        if sensors is not None:
            other_sensors = sensors[q + 1 :] if moves.central else sensors[0]
            ds = (sensors[1 : q + 1] - other_sensors) / width
        G = np.moveaxis(outputs.tangent(states[0], dx, ds), 0, 3)

        # Directions along parameters come first, then those of the initial state.
        count = len(moves.moving)
        common = np.zeros((*y.shape, len(theta)))
        common[..., moves.moving] = G[..., :count]
        return Response(first=first, y=y, common=common + bias, private=G[..., count:])

    # ---- single samples, first derivatives

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
        states, ctrl = _all_samples(trajectory)
        A, B, C, D = self.jacobians(theta, trajectory, step)

        by_theta, sensors_by_theta = self._one_step_by_theta(theta, states, ctrl, step)
        E = np.moveaxis(_require_finite(by_theta[:, :-1]), 0, 2)
        no_move = np.zeros((len(theta), len(states), self.plant.space.nx))
        H = np.moveaxis(outputs.tangent(states, no_move, sensors_by_theta), 0, 2)
        return Linearization(A=A, B=B, E=E, C=C, D=D, H=H + self.plant.bias_derivative)

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
            *_all_samples(trajectory), step * self.difference_sizes(trajectory), True
        )
        models = [plant.model(theta)]
        by_z, sensors_by_z = self._central_quotients(models, moved.states, moved.ctrl, moved.widths)

        AB = np.moveaxis(_require_finite(by_z[:, :-1]), 0, 2)
        dy = plant.outputs.tangent(trajectory.state, self._unit_moves(by_z.shape[1]), sensors_by_z)
        CD = np.moveaxis(dy, 0, 2)
        return AB[..., :nx], AB[..., nx:], CD[..., :nx], CD[..., nx:]

    def observation_jacobians(
        self,
        theta: Array,
        trajectory: Trajectory,
        observations: SubstepObservations,
        step: float = FIRST_DERIVATIVE_STEP,
    ) -> tuple[Array, Array, Array]:
        """Derivatives of F and of observations by state and control, by one-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            observations: The w observed quantities.
            step: Difference step relative to `difference_sizes`.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), and (N, derivative substeps, w, nx+nu) derivative of the
            observations.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
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
        self, theta: Array, trajectory: Trajectory, samples: np.ndarray, step: float
    ) -> Array:
        """Effect of each parameter on the next state and on the sensors at given samples.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            samples: Indices of the samples.
            step: Difference step relative to `parameter_scale`.

        Returns:
            (n, p) effects per theta-unit. A row is relative to the size of a state component [1/s],
            or to the largest effect on a sensor.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        plant, p = self.plant, len(theta)
        states = trajectory.state[samples]
        dx, ds = self._one_step_by_theta(theta, states, trajectory.ctrl[samples], step)
        state_sizes = self.difference_sizes(trajectory)[: plant.space.nx]
        effects = [_require_finite(dx) / (plant.dt * state_sizes)]

        if ds is not None:
            dy = plant.outputs.tangent(states, np.zeros_like(dx), ds)
            largest = np.abs(dy * plant.parameters.magnitude[:, None, None]).max(axis=(0, 1))
            effects.append(dy / np.where(largest > 0.0, largest, 1.0))
        return np.concatenate([effect.reshape(p, -1) for effect in effects], axis=1).T

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
        forward = theta + np.diag(h)
        backward = theta - np.diag(h)
        models = self.plant.models(np.concatenate([forward, backward]))

        every_state = _tiled(states, len(models))
        every_ctrl = _tiled(ctrl, len(models))
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
    ) -> _MovedSamples:
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
        return _MovedSamples(
            trajectory_states=states,
            states=moved_states.reshape(-1, states.shape[1]),
            ctrl=moved_ctrl.reshape(-1, plant.nu),
            batch_shape=(len(moves), len(states)),
            widths=(2.0 if central else 1.0) * steps[:, None, None],
        )

    def _unit_moves(self, samples: int) -> Array:
        """(nx+nu, samples, nx) tangent move of the state per unit of each coordinate of (x, u)."""
        nx = self.plant.space.nx
        moves = np.zeros((nx + self.plant.nu, samples, nx))
        moves[:nx] = np.eye(nx)[:, None, :]
        return moves

    # ---- single samples, mixed second derivatives

    def bilinear(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None = None,
    ) -> Bilinear:
        """First derivatives and mixed second derivatives along a trajectory.

        The latter are derivatives of `DF[psi w, w]` and `Dh[psi w, w]` by (x, u), for each
        direction w. They are taken on the smooth plant, all others on this plant.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            psi: (N+1, nx, p) sensitivity [x-unit / theta-unit].
            directions: (r, p) directions w [theta-unit].
            accuracy: Kind and steps of the differences.
            observations: Quantities observed within the samples, or None.

        Returns:
            The derivatives.

        Raises:
            SimulationDivergedError: MuJoCo cannot compile a perturbed model.
        """
        given = (theta, trajectory, psi, directions, accuracy)

        # Derivatives of sensors need the mean of both sides, so one-sided differences are used only
        # without sensors.
        if accuracy.shared_origin and not self.plant.simulator.sensors:
            return self._shared_origin(*given, observations)

        found = self._symmetric_pairs(*given, observations)
        if self.plant.smooth is self.plant:
            return found
        smooth = self.plant.smooth.derivatives._symmetric_pairs(*given, None)
        return replace(found, F_mixed=smooth.F_mixed, h_mixed=smooth.h_mixed)

    def _symmetric_pairs(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None,
    ) -> Bilinear:
        """`bilinear` by pairs of steps at +-epsilon along (psi w, w), at every moved (x, u).

        Means over the pairs give A and B.
        """
        steps = accuracy.coordinate_step * self.difference_sizes(trajectory)
        moved = self._move_samples(*_all_samples(trajectory), steps, accuracy.central)
        pairs = []
        for number, w in enumerate(directions):
            # First derivatives of the observations do not depend on w, so the first pair gives
            # them.
            wanted = observations if number == 0 else None
            state_direction = psi @ w
            epsilon = self._direction_step(accuracy, state_direction, w)
            pairs.append(self._pair(theta, moved, state_direction, w, epsilon, wanted))

        sensor_firsts = [pair.sensor_first for pair in pairs if pair.sensor_first is not None]
        return self._bilinear_from(
            theta,
            moved.trajectory_states,
            psi,
            directions,
            first=np.mean([pair.first for pair in pairs], axis=0),
            mixed=[pair.mixed for pair in pairs],
            sensor_first=np.mean(sensor_firsts, axis=0) if sensor_firsts else None,
            sensor_mixed=[pair.sensor_mixed for pair in pairs if pair.sensor_mixed is not None],
            observation_jacobian=pairs[0].observation_jacobian,
        )

    def _pair(
        self,
        theta: Array,
        moved: _MovedSamples,
        state_direction: Array,
        w: Array,
        epsilon: float,
        observations: SubstepObservations | None,
    ) -> _PairDerivatives:
        """Differences by (x, u) of two steps at +-epsilon along (psi w, w).

        The mean of the two steps gives first differences, their quotient gives mixed ones.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            moved: The n moved samples.
            state_direction: (n, nx) direction psi w of the states.
            w: (p,) direction of the parameters [theta-unit].
            epsilon: Step along (psi w, w).
            observations: Quantities observed within the samples, or None.
        """
        plant, count = self.plant, len(moved.widths)
        shift = _tiled(epsilon * state_direction, moved.batch_shape[0])
        forward = plant.space.plus(moved.states, shift)
        backward = plant.space.plus(moved.states, -shift)
        stepped = plant.simulator.step(
            plant.models(np.stack([theta + epsilon * w, theta - epsilon * w])),
            np.concatenate([forward, backward]),
            np.concatenate([moved.ctrl, moved.ctrl]),
            observations,
        )

        states = moved.unflatten(stepped.states)
        by_z = np.mean(plant.space.minus(states[:, :count], states[:, count:]), axis=0)
        by_direction = plant.space.minus(states[0], states[1]) / (2.0 * epsilon)

        sensor_first = sensor_mixed = None
        if stepped.sensors is not None:
            sensor_first, sensor_mixed = _sensor_differences(moved, stepped.sensors, epsilon)

        # The state after the last sample is no state of the trajectory.
        jacobian = None
        if stepped.observed is not None:
            observed = moved.unflatten(stepped.observed)
            change = np.mean(observed[:, :count] - observed[:, count:], axis=0)
            jacobian = moved.observation_jacobian(change)[:-1]
        return _PairDerivatives(
            first=by_z / moved.widths,
            mixed=moved.quotient(by_direction),
            sensor_first=sensor_first,
            sensor_mixed=sensor_mixed,
            observation_jacobian=jacobian,
        )

    def _shared_origin(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None,
    ) -> Bilinear:
        """`bilinear` by one-sided differences, for outputs without sensors.

        The steps at the origin, from the moved samples at theta, serve all directions.
        """
        plant, smooth = self.plant, self.plant.smooth
        steps = accuracy.coordinate_step * self.difference_sizes(trajectory)
        moved = self._move_samples(*_all_samples(trajectory), steps, False)
        count = len(moved.widths)

        stepped = plant.simulator.step([plant.model(theta)], moved.states, moved.ctrl, observations)
        origin = moved.unflatten(stepped.states)[0]
        first = plant.space.minus(origin[:count], origin[count:]) / moved.widths

        # The state after the last sample is no state of the trajectory.
        jacobian = None
        if stepped.observed is not None:
            observed = moved.unflatten(stepped.observed)[0]
            jacobian = moved.observation_jacobian(observed[:count, :-1] - observed[count:, :-1])

        # Mixed differences are taken on the smooth plant, relative to its steps at the origin.
        if smooth is not plant:
            smooth_step = smooth.simulator.step([smooth.model(theta)], moved.states, moved.ctrl)
            origin = moved.unflatten(smooth_step.states)[0]
        mixed = []
        for w in directions:
            state_direction = psi @ w
            epsilon = self._direction_step(accuracy, state_direction, w)
            mixed.append(
                self._one_sided_difference(theta, moved, origin, state_direction, w, epsilon)
            )

        return self._bilinear_from(
            theta,
            moved.trajectory_states,
            psi,
            directions,
            first=first,
            mixed=mixed,
            sensor_first=None,
            sensor_mixed=[],
            observation_jacobian=jacobian,
        )

    def _one_sided_difference(
        self,
        theta: Array,
        moved: _MovedSamples,
        origin: Array,
        state_direction: Array,
        w: Array,
        epsilon: float,
    ) -> Array:
        """(c, n, nx) mixed differences of F on the smooth plant, by (x, u) and along (psi w, w).

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            moved: The n moved samples.
            origin: (m, n, ns) states of the smooth plant after the moved samples, at theta.
            state_direction: (n, nx) direction psi w of the states.
            w: (p,) direction of the parameters [theta-unit].
            epsilon: Step along (psi w, w).
        """
        space, smooth = self.plant.space, self.plant.smooth
        shift = _tiled(epsilon * state_direction, moved.batch_shape[0])
        models = smooth.models((theta + epsilon * w)[None])
        stepped = smooth.simulator.step(models, space.plus(moved.states, shift), moved.ctrl)

        states = moved.unflatten(stepped.states)[0]
        return moved.quotient(space.minus(states, origin) / epsilon)

    def _bilinear_from(
        self,
        theta: Array,
        states: Array,
        psi: Array,
        directions: Array,
        *,
        first: Array,
        mixed: list[Array],
        sensor_first: Array | None,
        sensor_mixed: list[Array],
        observation_jacobian: Array | None,
    ) -> Bilinear:
        """The record of derivatives, from differences by (x, u).

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            states: (N+1, ns) states.
            psi: (N+1, nx, p) sensitivity [x-unit / theta-unit].
            directions: (r, p) directions w [theta-unit].
            first: (nx+nu, N+1, nx) first differences of F.
            mixed: r mixed differences of F, each (nx+nu, N+1, nx).
            sensor_first: (nx+nu, N+1, nsensordata) first differences of the sensors, or None
                without sensors.
            sensor_mixed: r mixed differences of the sensors, each (nx+nu, N+1, nsensordata); empty
                without sensors.
            observation_jacobian: (N, derivative substeps, w, nx+nu) derivative of the observations,
                or None.
        """
        plant, nx = self.plant, self.plant.space.nx
        unit = self._unit_moves(len(states))

        # The state after the last sample is no state of the trajectory.
        AB = np.moveaxis(first[:, :-1], 0, 2)
        F_mixed = np.moveaxis(np.array(mixed)[:, :, :-1], 1, 2)
        CD = np.moveaxis(plant.outputs.tangent(states, unit, sensor_first), 0, 2)

        h_mixed = None
        if sensor_mixed or plant.outputs.curved:
            changes = []
            for r, w in enumerate(directions):
                of_sensors = sensor_mixed[r] if sensor_mixed else None
                changes.append(plant.outputs.mixed_change(states, unit, psi @ w, of_sensors))
            h_mixed = np.moveaxis(np.array(changes), 1, 2)

        return Bilinear(
            A=AB[..., :nx],
            B=AB[..., nx:],
            C=CD[..., :nx],
            D=CD[..., nx:],
            F_mixed=F_mixed,
            h_mixed=h_mixed,
            output_delay=plant.output_delay(theta, len(states)),
            delay_derivative=plant.parameters.delay_derivative,
            observation_jacobian=observation_jacobian,
        )

    def _direction_step(
        self, accuracy: DifferenceAccuracy, state_direction: Array, w: Array
    ) -> float:
        """Step along (psi w, w).

        It is relative to the larger of the two parts: the state direction psi w: (N+1, nx), and w
        divided by `parameter_scale`.
        """
        in_model = self.plant.parameters.changes_model
        relative = np.where(in_model, np.abs(w / self.parameter_scale), 0.0).max(initial=0.0)
        largest = max(np.abs(state_direction).max(initial=0.0), relative, TINY)
        return float(accuracy.direction_step / largest)


def _all_samples(trajectory: Trajectory) -> tuple[Array, Array]:
    """States (N+1, ns) and controls (N+1, nu) of all samples.

    The last control is held for the outputs of the last sample.
    """
    return trajectory.state, np.concatenate([trajectory.ctrl, trajectory.ctrl[-1:]])


def _theta_moves(p: int, moving: np.ndarray, h: Array, central: bool, needs_origin: bool) -> Array:
    """(m, p) moves of theta, one for each rollout.

    There are n forward moves, n backward moves for two-sided differences, and a zero move if the
    rollout at theta is needed.

    Args:
        p: Number of parameters.
        moving: (n,) indices of the parameters that are moved.
        h: (n,) difference steps of these parameters [theta-unit].
        central: True for two-sided differences.
        needs_origin: Whether the rollout at theta is needed.
    """
    count = len(moving)
    forward = np.zeros((count, p))
    forward[np.arange(count), moving] = h

    backward = -forward if central else forward[:0]
    origin = np.zeros((int(needs_origin), p))
    return np.concatenate([forward, backward, origin])


def _sensor_differences(
    moved: _MovedSamples, sensors: Array, epsilon: float
) -> tuple[Array, Array]:
    """First and mixed differences of sensors by (x, u).

    Args:
        moved: The n moved samples.
        sensors: (2*m*n, nsensordata) sensor data of steps at +epsilon, then at -epsilon.
        epsilon: Step along (psi w, w).

    Returns:
        (c, n, nsensordata) first differences and (c, n, nsensordata) mixed differences.
    """
    count = len(moved.widths)
    pair = moved.unflatten(sensors)
    first = np.mean(pair[:, :count] - pair[:, count:], axis=0) / moved.widths
    mixed = moved.quotient((pair[0] - pair[1]) / (2.0 * epsilon))
    return first, mixed


def _with_origin(moves: Array, central: bool) -> Array:
    """(J, k) moves of rollouts from the forward moves: (q, k).

    There is a zero move, then the forward moves, then the backward moves for two-sided differences.
    """
    origin = np.zeros((1, moves.shape[1]))
    backward = -moves if central else moves[:0]
    return np.concatenate([origin, moves, backward])


def _tiled(curve: Array, count: int) -> Array:
    """(count*n, k) copies of a curve: (n, k), one after the other."""
    return np.broadcast_to(curve, (count, *curve.shape)).reshape(-1, curve.shape[1])


def _require_finite(derivative: Array) -> Array:
    """Return a derivative after a check.

    Raises:
        SimulationDivergedError: A number of the derivative is not finite.
    """
    if not np.isfinite(derivative).all():
        raise SimulationDivergedError("a perturbed step diverged during linearization")
    return derivative
