"""The plant: discrete-time dynamics with outputs, and all their derivatives in one object.

Derivatives are differences of MuJoCo steps in tangent-space coordinates (`StateSpace`). This module
differentiates whole rollouts, `first_derivatives` single samples, `mixed_derivatives` single
samples twice. Where the plant is an arm or similar, derivatives in closed form take their place in
parts. Combinations of parameters that have no effect save rollouts (`LumpedParameters`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.plant.batch import Rollouts
from mjfim.plant.dynamics import Dynamics
from mjfim.plant.first_derivatives import TINY
from mjfim.plant.mixed_derivatives import MixedDerivatives
from mjfim.plant.running_law import InputContext, LawMemory
from mjfim.records.trajectory import Sensitivity, Trajectory

# Relative step of the differences between whole rollouts.
SENSITIVITY_STEP = 1e-5

# Relative effect of a parameter on the trajectory below which its steps are lengthened.
MIN_PARAMETER_EFFECT = 1e-2

# Largest factor by which the difference step of a parameter is lengthened.
MAX_STEP_FACTOR = 100.0

# Largest number of state values that are in memory at once.
MAX_NUMBERS_AT_ONCE = 2_000_000

# Smallest ratio of the last to the first pivot with which parameters are lumped.
LEAST_PIVOT_RATIO = 1e-3

# Entry of a direction, relative to its largest one, below which the entry is round-off.
ROUND_OFF = 1e-12

# Largest effect of the probe, relative to the effects that cancel in it, that counts as none. It is
# above the curvature of one-sided differences.
LARGEST_REMAINDER = 1e-4


# Outputs of S curves over an interval of samples: (S, n+1, ny) [y-unit]; their derivatives by theta
# (S, n+1, ny, p) [y-unit / theta-unit], and by k directions of the initial state (S, n+1, ny, k)
# [y-unit / x-unit], None if not requested. Delays of the outputs are left out.
Response = tuple[Array, Array | None, Array | None]


class Derivatives(MixedDerivatives):
    """Derivatives of a plant, most of them by differences of MuJoCo steps.

    Attributes:
        plant: The plant.
    """

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
        found = self.rollout_differences(theta, self.plant.initial_state(theta), ctrl, step)
        return None if found is None else (found[0], found[1].G)

    def sensitivity(
        self,
        theta: Array,
        trajectory: Trajectory,
        step: float | Array = SENSITIVITY_STEP,
        central: bool = True,
        lumped: LumpedParameters | None = None,
        closed_form: bool = False,
    ) -> Sensitivity | None:
        """Sensitivities psi and G of a trajectory at fixed control, by differences of rollouts.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Open-loop or closed-loop trajectory; its control is kept.
            step: Difference step relative to `parameter_scale`, one number or (p,).
            central: True for two-sided differences. False is honoured only if no sensor is an
                output.
            lumped: Parameters whose columns follow from those of the others, without rollouts of
                their own; None for none. Where this motion shows that they do not follow, all
                parameters are moved.
            closed_form: True to take derivatives in closed form, by the parameters for which the
                plant has one.

        Returns:
            The sensitivities, or None if a perturbed rollout diverges.
        """
        # All parameters that take part in the lumping have to change the motion, and sensors may
        # show what the motion does not.
        is_still = ~self.plant.parameters.changes_motion
        can_lump = lumped is not None and not (
            self.plant.outputs.needs_sensors
            or is_still[lumped.lumped].any()
            or lumped.probe[is_still].any()
        )
        found = self.rollout_differences(
            theta,
            trajectory.state[0],
            trajectory.ctrl,
            step,
            states=trajectory.state,
            central=central or self.plant.outputs.needs_sensors,
            lumped=lumped if can_lump else None,
            closed_form=trajectory if closed_form else None,
        )
        return None if found is None else found[1]

    def rollout_differences(
        self,
        theta: Array,
        initial_state: Array,
        ctrl: Array,
        step: float | Array,
        *,
        states: Array | None = None,
        central: bool = True,
        lumped: LumpedParameters | None = None,
        closed_form: Trajectory | None = None,
        wanted: np.ndarray | None = None,
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
            lumped: Parameters whose columns follow from those of the others, or None.
            closed_form: The trajectory at theta, whose derivatives are taken in closed form by the
                parameters for which the plant has one; None for rollouts only.
            wanted: (p,) True for the parameters that are moved; None for all. The columns of the
                others are zero. All are moved where some of them are lumped.

        Returns:
            y: (N+1, ny) outputs [y-unit] and the sensitivities, or None if a rollout diverges. The
            outputs of sensors are NaN where the rollout at theta was not simulated.
        """
        plant, p = self.plant, len(theta)
        delay = plant.output_delay(theta, len(ctrl) + 1)
        needs_values = delay is not None or plant.calibration.scales
        needs_origin = states is None or (needs_values and plant.outputs.needs_sensors)

        is_moved, directions, widths = self._moved_directions(step, lumped, wanted)
        known = None
        if closed_form is not None:
            known = self.closed_form_sensitivity(theta, closed_form, directions)
        rolled = np.ones(len(widths), dtype=bool) if known is None else ~known[0]
        forward = directions[rolled] * widths[rolled, None]
        begin = np.zeros((int(needs_origin), p))
        moves = np.concatenate([begin, forward, -forward if central else forward[:0]])

        out = self._moved_rollouts(theta, initial_state, ctrl, moves) if len(moves) else None
        if len(moves) and out is None:
            return None
        origin = np.zeros((len(ctrl) + 1, 0)) if states is None else states
        sensors = None
        if out is not None and needs_origin:
            origin = out.states[0]
            sensors = None if out.sensors is None else out.sensors[0]

        psi = np.zeros((len(widths), len(origin), plant.space.nx))
        G = np.zeros((len(widths), len(origin), len(plant.outputs)))
        if out is not None:
            first = len(begin)
            psi[rolled], by_sensors = self.quotients(
                out.states[first:],
                None if out.sensors is None else out.sensors[first:],
                widths[rolled] * (2.0 if central else 1.0),
                None if central else (origin, sensors),
            )
            G[rolled] = plant.outputs.tangent(origin, psi[rolled], by_sensors)
        if known is not None:
            psi[~rolled] = known[1]
            G[~rolled] = plant.outputs.tangent(origin, known[1], None)

        count, by_probe = int(is_moved.sum()), psi[-1:]
        psi, G = (_columns(each[:count], is_moved, lumped) for each in (psi, G))
        if lumped is not None:
            sizes = plant.sizes.state
            if not lumped.explains(psi / sizes[:, None], by_probe[0] / sizes):
                return self.rollout_differences(
                    theta,
                    initial_state,
                    ctrl,
                    step,
                    states=states,
                    central=central,
                    closed_form=closed_form,
                )

        # Errors of the sensors, and the delay.
        exact = plant.outputs(origin, sensors)
        y = plant.calibration.measured(exact, theta)
        G = plant.calibration.by_theta(exact, G, theta)
        if delay is not None:
            by_delay = delay.derivative(y)[..., None] * plant.parameters.delay_derivative
            y, G = delay.apply(y), delay.apply(G) + by_delay
        return y, Sensitivity(psi=psi, G=G, is_lumped=lumped is not None)

    def _moved_rollouts(
        self, theta: Array, initial_state: Array, ctrl: Array, moves: Array
    ) -> Rollouts | None:
        """Rollouts at theta plus each row of moves: (m, p), all under one control.

        Returns:
            The rollouts, or None if MuJoCo cannot compile a model or a simulation diverges.
        """
        plant = self.plant
        starts = plant.space.plus(initial_state, moves @ plant.initial_state_derivative.T)
        models, compiled = plant.try_models(theta + moves)
        held = np.broadcast_to(ctrl, (len(moves), *ctrl.shape))
        out = plant.simulator.rollout(models, starts, held)
        return out if (out.finite & compiled).all() else None

    def _moved_directions(
        self, step: float | Array, lumped: LumpedParameters | None, wanted: np.ndarray | None
    ) -> tuple[np.ndarray, Array, Array]:
        """Directions of theta along which rollouts are differentiated.

        Returns:
            (p,) True for parameters that are moved alone; (n, p) directions, of which the probe of
            lumped parameters is the last one; (n,) lengths of their steps.
        """
        h = step * self.parameter_scale
        is_moved = self.plant.parameters.changes_motion.copy()
        if lumped is None:
            is_moved &= True if wanted is None else wanted
            return is_moved, np.eye(len(h))[is_moved], h[is_moved]

        is_moved[lumped.lumped] = False
        directions = np.concatenate([np.eye(len(h))[is_moved], lumped.probe[None]])
        return is_moved, directions, np.append(h[is_moved], 1.0 / np.abs(lumped.probe / h).max())

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
        lead: int = 0,
        samples: np.ndarray | None = None,
        max_numbers: int = MAX_NUMBERS_AT_ONCE,
    ) -> Iterator[Response | None]:
        """Simulate S curves, with derivatives by theta and by the initial state.

        The samples are divided into intervals, which are simulated one after the other, so that the
        memory is bounded.

        Args:
            theta: (p,) parameters [theta-unit].
            initial_states: (S, ns) initial states.
            ctrl: (S, lead + N, nu) controls, or inputs of control laws.
            start_directions: (nx, k) directions of the initial state by which to differentiate;
                None for no derivatives, neither by the initial state nor by theta.
            central: True for two-sided differences.
            step: Difference step relative to `parameter_scale`.
            wanted: (p,) True for parameters by which to differentiate; None for all. Biases are
                always included, because they need no simulation.
            lead: Number of samples of `ctrl` before the curves, which matter to control laws.
            samples: (S,) samples from the begin of the recordings to the first ones of `ctrl`; None
                for 0.
            max_numbers: Largest number of state values of one interval.

        Yields:
            The response over each interval; None, and nothing after it, if a simulation diverges.
        """
        plant = self.plant
        curves = Curves(
            self,
            theta,
            initial_states,
            start_directions=start_directions,
            central=central,
            step=step,
            wanted=wanted,
        )
        # Control laws are evaluated where an interval begins.
        ticks = plant.tick_samples
        interval = max(int(max_numbers / (ticks * curves.numbers_per_sample)), 1) * ticks
        begun = np.zeros(len(ctrl), dtype=np.intp) if samples is None else samples
        for first in range(lead, ctrl.shape[1], interval):
            place = slice(first, first + interval)
            context = None
            if plant.laws is not None:
                context = InputContext.of_interval(ctrl, begun, place, lead, curves.memory)
            response = curves.advance(ctrl[:, place], context)
            yield response
            if response is None:
                return


class Curves:
    """S curves that are simulated piece by piece, each beside its moves for the derivatives.

    Attributes:
        samples: Number of samples so far.
        numbers_per_sample: Number of values that the simulation of a sample records.
        memory: What control laws remember; None without laws or before the first sample.
    """

    def __init__(
        self,
        derivatives: Derivatives,
        theta: Array,
        initial_states: Array,
        *,
        start_directions: Array | None = None,
        central: bool = True,
        step: float = SENSITIVITY_STEP,
        wanted: np.ndarray | None = None,
    ) -> None:
        """Begin the curves; the arguments are those of `Derivatives.responses`."""
        plant = self._plant = derivatives.plant
        self._derivatives, self._theta, self._central = derivatives, theta, central
        self._with_derivatives = start_directions is not None
        # Moves along parameters that are wanted and change the motion, then along k directions of
        # the initial state.
        moving = np.zeros(0, dtype=np.intp)
        directions = np.zeros((plant.space.nx, 0))
        if start_directions is not None:
            chosen = plant.parameters.changes_motion
            moving = np.flatnonzero(chosen if wanted is None else chosen & wanted)
            directions = start_directions
        h = (step * derivatives.parameter_scale)[moving]
        along = np.zeros((len(moving) + directions.shape[1], len(theta)))
        along[np.arange(len(moving)), moving] = h

        # A parameter that is a deviation of the initial state moves theta and the initial state.
        of_start = along @ plant.initial_state_derivative.T
        reach = (np.abs(directions) / plant.sizes.state[:, None]).max(axis=0, initial=0.0)
        start_steps = step / np.maximum(reach, TINY)
        of_start[len(moving) :] = start_steps[:, None] * directions.T
        self._moving = moving
        self._widths = np.concatenate([h, start_steps]) * (2.0 if central else 1.0)

        # J rollouts: without a move, then forward, then backward for two-sided differences.
        theta_moves, start_moves = (
            np.concatenate([np.zeros((1, each.shape[1])), each, -each if central else each[:0]])
            for each in (along, of_start)
        )
        models, compiled = plant.try_models(theta + theta_moves)
        self._is_possible = bool(compiled.all())

        # States of each of the J moves for all S curves.
        self._current = plant.space.plus(initial_states, start_moves[:, None])
        J, S, state_size = self._current.shape
        self._models = [model for model in models for _ in range(S)] if J > 1 else models
        self.numbers_per_sample = J * S * plant.simulator.substeps * (1 + state_size)
        self.memory: tuple[LawMemory, ...] | None = None
        self.samples = 0

    @property
    def states(self) -> Array:
        """(S, ns) states of the curves after these samples."""
        return np.asarray(self._current[0])

    def advance(self, held: Array, context: InputContext | None = None) -> Response | None:
        """Simulate the next samples.

        Args:
            held: (S, n, nu) controls, or inputs of control laws.
            context: What control laws read besides; None without laws.

        Returns:
            The response over these samples; None if a simulation diverges.
        """
        plant, (J, S, _) = self._plant, self._current.shape
        every = np.broadcast_to(held, (J, *held.shape)).reshape(J * S, *held.shape[1:])
        out = plant.simulator.rollout(
            self._models,
            self._current.reshape(J * S, -1),
            every,
            context=None if context is None else context.repeated(J),
        )
        self.memory = out.memory
        if not (out.finite.all() and self._is_possible):
            return None

        count = held.shape[1] + 1
        self.samples += held.shape[1]
        states = out.states.reshape(J, S, count, -1)
        sensors = None if out.sensors is None else out.sensors.reshape(J, S, count, -1)
        self._current = states[:, :, -1]
        still = states[0], None if sensors is None else sensors[0]
        h_still = plant.outputs(*still)
        y = plant.calibration.measured(h_still, self._theta)
        if not self._with_derivatives:
            return y, None, None

        moved = None if sensors is None else sensors[1:]
        moves = self._derivatives.quotients(
            states[1:], moved, self._widths, None if self._central else still
        )
        G = np.moveaxis(plant.outputs.tangent(states[0], *moves), 0, 3)
        common = np.zeros((*y.shape, len(self._theta)))
        common[..., self._moving] = G[..., : len(self._moving)]
        return (
            y,
            plant.calibration.by_theta(h_still, common, self._theta),
            plant.calibration.scaled(G[..., len(self._moving) :], self._theta),
        )


def _columns(by_move: Array, is_moved: np.ndarray, lumped: LumpedParameters | None) -> Array:
    """(n, k, p) derivatives by all parameters from those by the moved ones: (m, n, k)."""
    full = np.zeros((*by_move.shape[1:], len(is_moved)))
    full[..., is_moved] = np.moveaxis(by_move, 0, 2)
    return full if lumped is None else lumped.expanded(full[..., lumped.base])


def _unit_directions(directions: Array) -> Array:
    """(p, k) directions with a length of 1, without entries that are round-off."""
    # A parameter that takes part in a direction by round-off only does not take part in it.
    largest = np.abs(directions).max(axis=0)
    relative = np.where(np.abs(directions) > ROUND_OFF * largest, directions, 0.0)
    return np.asarray(relative / np.linalg.norm(relative, axis=0))


@record
class LumpedParameters:
    """Parameters that are lumped into others.

    Along a direction n without effect, `psi n = 0`. With k such directions, the columns of k
    parameters follow from those of the p - k others, so that only these need rollouts.

    Attributes:
        base: (b,) indices of the parameters that are moved.
        lumped: (k,) indices of the others.
        coefficients: (b, k) psi of the lumped parameters is psi of the base ones times these.
        probe: (p,) a combination of the directions without effect, whose rollout shows whether they
            have none along a motion [theta-unit].
    """

    base: np.ndarray
    lumped: np.ndarray
    coefficients: Array
    probe: Array

    @staticmethod
    def of(directions: Array, size: Array) -> LumpedParameters | None:
        """Choose the lumped parameters, so that the coefficients are small.

        Args:
            directions: (p, k) directions without effect [theta-unit].
            size: (p,) magnitudes of the parameters [theta-unit].

        Returns:
            The choice; None without directions, or where they are nearly dependent.
        """
        k = directions.shape[1]
        if not k:
            return None

        unit = _unit_directions(directions / size[:, None])
        _, triangle, pivots = scipy.linalg.qr(unit.T, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(triangle))
        if not diagonal[k - 1] > LEAST_PIVOT_RATIO * diagonal[0]:
            return None

        lumped = np.sort(pivots[:k])
        base = np.setdiff1d(np.arange(len(size)), lumped)
        by_size = -unit[base] @ np.linalg.inv(unit[lumped])
        share = np.random.default_rng(0).standard_normal(k)
        return LumpedParameters(
            base=base,
            lumped=lumped,
            coefficients=by_size * size[base][:, None] / size[lumped],
            probe=size * (unit @ share),
        )

    def expanded(self, of_base: Array) -> Array:
        """(..., p) derivatives by all parameters from those by the base ones: (..., b)."""
        count = len(self.base) + len(self.lumped)
        full = np.empty((*of_base.shape[:-1], count))
        full[..., self.base] = of_base
        full[..., self.lumped] = of_base @ self.coefficients
        return full

    def explains(self, derivatives: Array, along_probe: Array) -> bool:
        """Check whether the probe has no effect on a motion.

        Args:
            derivatives: (..., p) derivatives of states or outputs by all parameters, relative to
                the sizes of the states or outputs.
            along_probe: (...) derivatives along the probe.

        Returns:
            True where the effects of the parameters cancel along the probe.
        """
        lengths = np.linalg.norm(derivatives.reshape(-1, derivatives.shape[-1]), axis=0)
        parts = float(np.abs(self.probe) @ lengths)
        return bool(np.linalg.norm(along_probe) <= LARGEST_REMAINDER * parts)


class Plant(Dynamics):
    """Dynamics with derivatives, see `Dynamics`."""

    @property
    def derivatives(self) -> Derivatives:
        """Derivatives of F and h, by differences of MuJoCo steps.

        They refer to this plant and are not kept, because the two would refer to each other: the
        memory of a plant that nothing uses any more is then free at once, without a search of
        Python's garbage collector.
        """
        return Derivatives(self, self._step_factors)

    def calibrated(
        self, theta: Array, trajectory: Trajectory, wanted: np.ndarray | None = None
    ) -> Self:
        """A plant with difference steps whose effect exceeds the round-off of a trajectory.

        Simulator and models are shared.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Trajectory on which the effect of every parameter is measured.
            wanted: (p,) True for the parameters whose effect is measured; None for all. The others
                keep their steps.

        Returns:
            The plant with longer difference steps for parameters that hardly move this trajectory,
            or the plant itself if a perturbed rollout diverges.
        """
        has_sensors = self.outputs.needs_sensors
        measured = self.derivatives.rollout_differences(
            theta,
            trajectory.state[0],
            trajectory.ctrl,
            SENSITIVITY_STEP,
            states=None if has_sensors else trajectory.state,
            closed_form=None if has_sensors else trajectory,
            wanted=wanted,
        )
        # Nothing asks for the gradient along this trajectory on account of a calibration.
        self.closed_form_memory.latest = None
        if measured is None:
            return self

        effects = self._effects(trajectory, *measured)
        factors = np.clip(MIN_PARAMETER_EFFECT / np.maximum(effects, TINY), 1.0, MAX_STEP_FACTOR)
        if wanted is not None:
            kept = 1.0 if self.step_factors is None else self.step_factors
            factors = np.where(wanted, factors, kept)
        return self.with_step_factors(factors)

    def _effects(self, trajectory: Trajectory, y: Array, sensitivity: Sensitivity) -> Array:
        """(p,) largest effects of the parameters on states and sensors, relative to their sizes.

        Sensors are relative to their largest values; those that stay zero do not count. The other
        outputs are states.
        """
        is_sensor = np.array([output.sensor is not None for output in self.outputs.outputs])
        largest = np.where(is_sensor, np.abs(y).max(axis=0, initial=0.0), 0.0)
        state_sizes = self.derivatives.difference_sizes(trajectory)[: self.space.nx]
        sizes = np.concatenate([state_sizes, np.where(largest > 0.0, largest, np.inf)])
        moves = np.concatenate([sensitivity.psi, sensitivity.G], axis=1)
        moves = np.abs(moves * self.parameters.magnitude).max(axis=0)
        return np.asarray((moves / sizes[:, None]).max(axis=0))
