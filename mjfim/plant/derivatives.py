"""Derivatives of the plant: first and mixed second derivatives of F and h, and sensitivities of whole rollouts.

Every derivative is a difference of MuJoCo steps in tangent-space coordinates (`StateSpace`), with
all samples and all perturbations batched into one call.
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
    """Kind and steps of the differences that make mixed second derivatives.

    Attributes:
        central: True for two-sided differences in state and control, False for one-sided ones.
        coordinate_step: Step in state and control, relative to the size of what is perturbed.
        direction_step: Step along (psi w, w), relative to the larger of its two parts.
        shared_origin: True for differences that are one-sided along (psi w, w) and in the
            parameters as well, so that all directions share one batch at their origin.
    """

    central: bool
    coordinate_step: float
    direction_step: float
    shared_origin: bool = False


# One-sided in state and control, two-sided along (psi w, w): about 1e-5 relative error.
FORWARD_DIFFERENCES = DifferenceAccuracy(central=False, coordinate_step=1e-6, direction_step=3e-3)
# One-sided in everything: the quickest differences for a plant without kinks.
SHARED_ORIGIN = DifferenceAccuracy(
    central=False, coordinate_step=1e-6, direction_step=1e-3, shared_origin=True
)
# One-sided in everything with a short step, for a plant whose dry friction is smoothed and so bends
# sharply.
SHARED_ORIGIN_SHORT = DifferenceAccuracy(
    central=False, coordinate_step=1e-6, direction_step=1e-5, shared_origin=True
)
# Two-sided in everything: the most accurate differences.
CENTRAL_DIFFERENCES = DifferenceAccuracy(central=True, coordinate_step=1e-4, direction_step=1e-3)

FIRST_DERIVATIVE_STEP = 1e-6  # Relative step of the differences that make A, B, C, D, E, H
SENSITIVITY_STEP = 1e-5  # Relative step of the differences between whole rollouts
MIN_PARAMETER_EFFECT = 1e-2  # Relative effect of a parameter below which its steps are lengthened
MAX_STEP_FACTOR = 100.0  # Largest factor by which the difference step of a parameter is lengthened
MAX_NUMBERS_AT_ONCE = 8_000_000  # Largest number of state values in memory at once.
MIN_CONTROL_SIZE = 1e-3  # Control magnitude below which an actuator's difference step is absolute.
TINY = 1e-300  # Smallest divisor; protects a division by zero.


@dataclass(frozen=True, kw_only=True, eq=False)
class Response:
    """Outputs of S curves over some consecutive samples, and their derivatives.

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
    """All n samples of a trajectory, and copies of them that are moved along each coordinate of (x, u).

    There are c = nx+nu coordinates and m rows of moves: c forward ones, then c backward ones or a
    single zero row.

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
        batches = len(values) // (moves * samples)  # not -1: there may be no numbers per sample
        return values.reshape(batches, moves, samples, *values.shape[1:])

    def quotient(self, values: Array) -> Array:
        """(c, n, k) differences by (x, u) from (m, n, k) values of the moved samples."""
        count = len(self.widths)
        return np.asarray((values[:count] - values[count:]) / self.widths)


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
    """Moves of theta and of the initial state whose rollouts give the derivatives of a response along q directions.

    Attributes:
        theta: (J, p) moves of theta: a zero move, q forward ones, and q backward ones if two-sided
            [theta-unit].
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
        """(p,) change of each parameter that moves the trajectory noticeably [theta-unit]; steps are relative to it."""
        return np.asarray(self.plant.parameters.magnitude * self._step_factors)

    def difference_sizes(self, trajectory: Trajectory) -> Array:
        """Magnitudes of state and control along a trajectory; difference steps are relative to them.

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
        """Factors on the parameters' difference steps with which their effect exceeds round-off.

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
        """Sensitivities psi and G of a trajectory at fixed control, by differences of whole rollouts.

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
        """Outputs (N+1, ny) and sensitivities from rollouts at theta +- h, for every parameter that changes the motion.

        states: (N+1, ns) at theta where they are known. Without them, and where sensors are
        delayed, one more rollout gives the states and sensors at theta.
        """
        plant = self.plant
        moving = np.flatnonzero(plant.parameters.changes_motion)
        count, p, N = len(moving), len(theta), len(ctrl)
        delay = plant.output_delay(theta, N + 1)
        needs_origin = states is None or (delay is not None and plant.outputs.needs_sensors)

        # One row of moves per rollout: forward, backward if two-sided, and a zero move for the
        # origin.
        h = (step * self.parameter_scale)[moving]
        forward = np.zeros((count, p))
        forward[np.arange(count), moving] = h
        backward = -forward if central else forward[:0]
        moves = np.concatenate([forward, backward, np.zeros((int(needs_origin), p))])

        psi = np.zeros((N + 1, plant.space.nx, p))
        G = np.zeros((N + 1, len(plant.outputs), p))
        sensors = None
        origin = np.zeros((N + 1, 0)) if states is None else states
        if len(moves):
            out = self._moved_rollouts(theta, initial_state, ctrl, moves)
            if out is None:
                return None
            if needs_origin:
                origin = out.states[-1]
                sensors = None if out.sensors is None else out.sensors[-1]

            width = (2.0 if central else 1.0) * h[:, None, None]
            other = out.states[count : 2 * count] if central else origin
            dx = plant.space.minus(out.states[:count], other) / width
            ds = None
            if out.sensors is not None:
                ds = (out.sensors[:count] - out.sensors[count : 2 * count]) / width
            psi[..., moving] = np.moveaxis(dx, 0, 2)
            G[..., moving] = np.moveaxis(plant.outputs.tangent(origin, dx, ds), 0, 2)

        G += plant.bias_derivative
        y = plant.outputs(origin, sensors) + plant.bias_derivative @ theta
        if delay is not None:
            by_delay = delay.derivative(y)[..., None] * plant.parameters.delay_derivative
            G = delay.apply(G) + by_delay
            y = delay.apply(y)
        return y, Sensitivity(psi=psi, G=G)

    def _moved_rollouts(
        self, theta: Array, initial_state: Array, ctrl: Array, moves: Array
    ) -> Rollouts | None:
        """Rollouts under one control at theta plus each row of moves: (m, p), which also move the initial state.

        None if one of them diverges or its model cannot be compiled.
        """
        plant = self.plant
        starts = plant.space.plus(initial_state, moves @ plant.initial_state_derivative.T)
        held = np.broadcast_to(ctrl, (len(moves), *ctrl.shape))
        models, compiled = plant.try_models(theta + moves)
        out = plant.simulator.rollout(models, starts, held)
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
        """Simulate S curves, one stretch of time after the other, with derivatives by theta and by the initial state.

        Args:
            theta: (p,) parameters [theta-unit].
            initial_states: (S, ns) initial states.
            ctrl: (S, N, nu) controls.
            start_directions: (nx, k) directions of the initial state by which to differentiate;
                None for no derivatives at all, those by theta included.
            central: True for two-sided differences.
            step: Difference step relative to `parameter_scale`.
            wanted: (p,) True for parameters by which to differentiate; None for all. Biases cost
                nothing and are always included.
            max_numbers: Numbers that the states of one stretch may hold.

        Yields:
            The response over each stretch; None, and nothing after it, if a simulation diverges.
        """
        plant = self.plant
        moves = self._response_moves(theta, start_directions, central, step, wanted)
        models, compiled = plant.try_models(theta + moves.theta)
        now = plant.space.plus(initial_states, moves.initial_state[:, None])
        J, S, state_size = now.shape
        if J > 1:
            models = [model for model in models for _ in range(S)]

        numbers_per_sample = J * S * plant.simulator.substeps * (1 + state_size)
        stretch = int(np.clip(max_numbers / numbers_per_sample, 1, ctrl.shape[1]))
        for first in range(0, ctrl.shape[1], stretch):
            held = ctrl[:, first : first + stretch]
            every = np.broadcast_to(held, (J, *held.shape)).reshape(J * S, *held.shape[1:])
            out = plant.simulator.rollout(models, now.reshape(J * S, -1), every)
            if not (out.finite.all() and compiled.all()):
                yield None
                return

            samples = held.shape[1] + 1
            states = out.states.reshape(J, S, samples, -1)
            sensors = None if out.sensors is None else out.sensors.reshape(J, S, samples, -1)
            yield self._response(theta, first, states, sensors, moves, start_directions is not None)
            now = states[:, :, -1]

    def _response_moves(
        self,
        theta: Array,
        start_directions: Array | None,
        central: bool,
        step: float,
        wanted: np.ndarray | None,
    ) -> _ResponseMoves:
        """Moves along the wanted parameters that change the motion, then along k directions of the initial state."""
        plant, p = self.plant, len(theta)
        if start_directions is None:
            start_directions = np.zeros((plant.space.nx, 0))
            moving = np.zeros(0, dtype=np.intp)
        else:
            chosen = plant.parameters.changes_motion
            moving = np.flatnonzero(chosen if wanted is None else chosen & wanted)

        # A parameter may be a deviation of the initial state: it then moves both.
        h = (step * self.parameter_scale)[moving]
        k = start_directions.shape[1]
        by_theta = np.zeros((len(moving) + k, p))
        by_theta[np.arange(len(moving)), moving] = h
        by_start = by_theta @ plant.initial_state_derivative.T
        by_start[len(moving) :] = step * start_directions.T

        return _ResponseMoves(
            theta=_with_origin(by_theta, central),
            initial_state=_with_origin(by_start, central),
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
        """Response over a stretch from states: (J, S, n+1, ns) and sensors: (J, S, n+1, nsensordata) of all moves."""
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
            ds = (sensors[1 : q + 1] - (sensors[q + 1 :] if moves.central else sensors[0])) / width
        G = np.moveaxis(outputs.tangent(states[0], dx, ds), 0, 3)

        count = len(moves.moving)
        common = np.zeros((*y.shape, len(theta)))
        common[..., moves.moving] = G[..., :count]
        return Response(first=first, y=y, common=common + bias, private=G[..., count:])

    # ---- single samples, first derivatives

    def linearize(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> Linearization:
        """First derivatives A, B, E, C, D, H along a trajectory by two-sided differences, in one batch per model.

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
        """Derivatives of F and of observations within the samples by state and control, by one-sided differences.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            observations: The w observed quantities.
            step: Difference step relative to `difference_sizes`.

        Returns:
            A: (N, nx, nx), B: (N, nx, nu), and (N, derivative substeps, w, nx+nu) derivatives of
            the observations.

        Raises:
            SimulationDivergedError: A perturbed step diverges.
        """
        plant, nx = self.plant, self.plant.space.nx
        sizes = self.difference_sizes(trajectory)
        moved = self._move_samples(trajectory.state[:-1], trajectory.ctrl, step * sizes, False)
        stepped = plant.simulator.step([plant.model(theta)], moved.states, moved.ctrl, observations)
        if stepped.observed is None:
            raise ValueError("the simulator returned no observations")

        states = moved.unflatten(stepped.states)[0]
        AB = np.moveaxis(
            _require_finite(plant.space.minus(states[:-1], states[-1:]) / moved.widths), 0, 2
        )
        observed = moved.unflatten(stepped.observed)[0]
        slopes = np.moveaxis((observed[:-1] - observed[-1:]) / moved.widths[..., None], 0, 3)
        return AB[..., :nx], AB[..., nx:], slopes

    def one_step(
        self, theta: Array, trajectory: Trajectory, samples: np.ndarray, step: float
    ) -> Array:
        """Effects of each parameter on the next state and on the sensors at some samples.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: The trajectory.
            samples: Indices of the samples.
            step: Difference step relative to `parameter_scale`.

        Returns:
            (n, p) effects per theta-unit; rows are relative to the size of a state component [1/s]
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
        """Derivatives of single steps by theta: (p, n, nx) of the next state, (p, n, nsensordata) of sensors or None."""
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
        """Two-sided quotients (count, n, nx) of F and (count, n, nsensordata) of sensors, or None without sensors.

        The first half of states: (2*count*n, ns) and ctrl: (2*count*n, nu) is the forward side;
        widths: (count, 1, 1)
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
        """Move states: (n, ns) and ctrl: (n, nu) along each coordinate of (x, u) by its step: (nx+nu,)."""
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
        """First derivatives, and derivatives of `DF[psi w, w]` and `Dh[psi w, w]` by (x, u) for each direction w.

        The mixed second derivatives are those of the smooth plant, everything else is this plant's.

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
        # Derivatives of sensors would need the mean of both sides: one-sided differences leave
        # sensors out.
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
        """`bilinear` by pairs at +-epsilon along (psi w, w) at every moved (x, u); means over the pairs give A and B."""
        steps = accuracy.coordinate_step * self.difference_sizes(trajectory)
        moved = self._move_samples(*_all_samples(trajectory), steps, accuracy.central)
        pairs = []
        for number, w in enumerate(directions):
            # First derivatives of the observations do not depend on w: the first pair gives them.
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
        """Differences by (x, u) of the mean and of the quotient of two steps at +-epsilon along (psi w, w)."""
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
        rise = np.mean(plant.space.minus(states[:, :count], states[:, count:]), axis=0)
        slope = plant.space.minus(states[0], states[1]) / (2.0 * epsilon)

        sensor_first = sensor_mixed = None
        if stepped.sensors is not None:
            sensors = moved.unflatten(stepped.sensors)
            sensor_first = np.mean(sensors[:, :count] - sensors[:, count:], axis=0) / moved.widths
            sensor_mixed = moved.quotient((sensors[0] - sensors[1]) / (2.0 * epsilon))

        jacobian = None
        if stepped.observed is not None:
            observed = moved.unflatten(stepped.observed)
            change = np.mean(observed[:, :count] - observed[:, count:], axis=0)
            jacobian = np.moveaxis((change / moved.widths[..., None])[:, :-1], 0, 3)
        return _PairDerivatives(
            first=rise / moved.widths,
            mixed=moved.quotient(slope),
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
        """`bilinear` by one-sided differences for outputs that are no sensors; all directions share a batch at their origin."""
        plant, smooth = self.plant, self.plant.smooth
        steps = accuracy.coordinate_step * self.difference_sizes(trajectory)
        moved = self._move_samples(*_all_samples(trajectory), steps, False)
        count = len(moved.widths)

        stepped = plant.simulator.step([plant.model(theta)], moved.states, moved.ctrl, observations)
        origin = moved.unflatten(stepped.states)[0]
        first = plant.space.minus(origin[:count], origin[count:]) / moved.widths
        jacobian = None
        if stepped.observed is not None:
            observed = moved.unflatten(stepped.observed)[0]
            change = observed[:count, :-1] - observed[count:, :-1]
            jacobian = np.moveaxis(change / moved.widths[..., None], 0, 3)

        # Mixed differences are taken on the smooth plant, relative to its unmoved step.
        if smooth is not plant:
            smooth_step = smooth.simulator.step([smooth.model(theta)], moved.states, moved.ctrl)
            origin = moved.unflatten(smooth_step.states)[0]
        mixed = []
        for w in directions:
            state_direction = psi @ w
            epsilon = self._direction_step(accuracy, state_direction, w)
            shifted = plant.space.plus(
                moved.states, _tiled(epsilon * state_direction, moved.batch_shape[0])
            )
            models = smooth.models((theta + epsilon * w)[None])
            states = moved.unflatten(smooth.simulator.step(models, shifted, moved.ctrl).states)[0]
            mixed.append(moved.quotient(plant.space.minus(states, origin) / epsilon))

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
        """Assemble the record; quotients by (x, u) are its first axis: first, mixed: (nx+nu, N+1, nx), r of mixed.

        states: (N+1, ns);  sensor_first, sensor_mixed: (nx+nu, N+1, nsensordata), None and empty
        without sensors
        """
        plant, nx = self.plant, self.plant.space.nx
        unit = self._unit_moves(len(states))

        # The state after the last sample is no state of the trajectory.
        AB = np.moveaxis(first[:, :-1], 0, 2)
        F_mixed = np.moveaxis(np.array(mixed)[:, :, :-1], 1, 2)
        CD = np.moveaxis(plant.outputs.tangent(states, unit, sensor_first), 0, 2)

        h_mixed = None
        if sensor_mixed or plant.outputs.curved:
            bends = [
                plant.outputs.mixed_change(
                    states, unit, psi @ w, sensor_mixed[r] if sensor_mixed else None
                )
                for r, w in enumerate(directions)
            ]
            h_mixed = np.moveaxis(np.array(bends), 1, 2)

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
        """Step along (psi w, w), relative to the larger of its two parts: psi w (N+1, nx), and w over `parameter_scale`."""
        in_model = self.plant.parameters.changes_model
        relative = np.where(in_model, np.abs(w / self.parameter_scale), 0.0).max(initial=0.0)
        largest = max(np.abs(state_direction).max(initial=0.0), relative, TINY)
        return float(accuracy.direction_step / largest)


def _all_samples(trajectory: Trajectory) -> tuple[Array, Array]:
    """States (N+1, ns) and controls (N+1, nu); the last control is held for the outputs of the last sample."""
    return trajectory.state, np.concatenate([trajectory.ctrl, trajectory.ctrl[-1:]])


def _with_origin(moves: Array, central: bool) -> Array:
    """(J, k) moves of rollouts: a zero move, the rows of moves: (q, k), and the opposite ones if differences are two-sided."""
    origin = np.zeros((1, moves.shape[1]))
    backward = -moves if central else moves[:0]
    return np.concatenate([origin, moves, backward])


def _tiled(curve: Array, count: int) -> Array:
    """(count*n, k) copies of a curve: (n, k), one after the other."""
    return np.broadcast_to(curve, (count, *curve.shape)).reshape(-1, curve.shape[1])


def _require_finite(derivative: Array) -> Array:
    """The derivative itself. Raises SimulationDivergedError where it is not finite."""
    if not np.isfinite(derivative).all():
        raise SimulationDivergedError("a perturbed step diverged during linearization")
    return derivative
