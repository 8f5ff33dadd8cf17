"""Mixed second derivatives of F and h along directions (psi w, w), by differences of MuJoCo steps.

The gradient of a criterion needs these second derivatives. The steps also give all first
derivatives by state and control.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.delay import OutputDelay
from mjfim.plant.step_derivatives import MovedSamples, StepDerivatives, all_samples, tiled
from mjfim.records.trajectory import Trajectory


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
        observation_jacobian: (N, S, w, nx+nu) derivative of the observations by
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
class _PairDerivatives:
    """Differences by the c coordinates of (x, u) of two steps at +-epsilon along (psi w, w).

    Attributes:
        first: (c, n, nx) first differences of F.
        mixed: (c, n, nx) mixed differences of F.
        sensor_first: (c, n, nsensordata) first differences of the sensors, or None without sensors.
        sensor_mixed: (c, n, nsensordata) mixed differences of the sensors, or None without sensors.
        observation_jacobian: (N, S, w, c) first differences of the observations,
            or None.
    """

    first: Array
    mixed: Array
    sensor_first: Array | None
    sensor_mixed: Array | None
    observation_jacobian: Array | None


class MixedDerivatives(StepDerivatives):
    """First and mixed second derivatives of F and h."""

    @property
    def quickest_accuracy(self) -> DifferenceAccuracy:
        """The quickest differences for mixed second derivatives of this plant."""
        return SHARED_ORIGIN_SHORT if self.plant.smooth.source.smoothing_speeds else SHARED_ORIGIN

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
        direction w. They are taken on the smooth plant, all others on this plant. Where the plant
        has derivatives in closed form, these are taken instead of differences, except for
        `CENTRAL_DIFFERENCES`.

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
        # Central differences are asked for where a search does not go on, and for numbers that are
        # shown: both have to come from the engine alone.
        if accuracy is not CENTRAL_DIFFERENCES:
            closed = self._in_closed_form(theta, trajectory, psi, directions, observations)
            if closed is not None:
                return closed

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

    def _in_closed_form(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        observations: SubstepObservations | None,
    ) -> Bilinear | None:
        """`bilinear` in closed form, but for observations; None where there is no closed form."""
        found = self.closed_form_mixed(theta, trajectory, psi, directions)
        if found is None:
            return None

        jacobian = None
        if observations is not None:
            jacobian = self.observation_jacobians(theta, trajectory, observations)[2]

        # Nothing refers to the state after the last sample.
        first = np.moveaxis(np.concatenate([found.first.A, found.first.B], axis=2), 2, 0)
        after = np.zeros((*first.shape[:1], 1, first.shape[2]))
        mixed = [np.concatenate([each.swapaxes(0, 1), after], axis=1) for each in found.F_mixed]
        return self._bilinear_from(
            theta,
            trajectory.state,
            psi,
            directions,
            first=np.concatenate([first, after], axis=1),
            mixed=mixed,
            sensor_first=None,
            sensor_mixed=[],
            observation_jacobian=jacobian,
        )

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
        sizes = self.difference_sizes(trajectory)
        steps, nx = accuracy.coordinate_step * sizes, self.plant.space.nx
        moved = self._move_samples(*all_samples(trajectory), steps, accuracy.central)
        pairs = []
        for number, w in enumerate(directions):
            # First derivatives of the observations do not depend on w, so the first pair gives
            # them.
            wanted = observations if number == 0 else None
            state_direction = psi @ w
            epsilon = self.direction_step(accuracy.direction_step, state_direction / sizes[:nx], w)
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
        moved: MovedSamples,
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
        shift = tiled(epsilon * state_direction, moved.batch_shape[0])
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
        sizes = self.difference_sizes(trajectory)
        steps, nx = accuracy.coordinate_step * sizes, self.plant.space.nx
        moved = self._move_samples(*all_samples(trajectory), steps, False)
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
            epsilon = self.direction_step(accuracy.direction_step, state_direction / sizes[:nx], w)
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
        moved: MovedSamples,
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
        shift = tiled(epsilon * state_direction, moved.batch_shape[0])
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
            observation_jacobian: (N, S, w, nx+nu) derivative of the observations,
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

        # A scale error multiplies the outputs, so that its effect changes with them.
        calibration = plant.calibration
        if calibration.scales:
            of_scales = np.einsum("kyz,rp,yp->rkzy", CD, directions, calibration.scale)
            if h_mixed is not None:
                of_scales = of_scales + calibration.factor(theta) * h_mixed
            h_mixed, CD = of_scales, calibration.scaled(CD, theta)

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


def _sensor_differences(moved: MovedSamples, sensors: Array, epsilon: float) -> tuple[Array, Array]:
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
