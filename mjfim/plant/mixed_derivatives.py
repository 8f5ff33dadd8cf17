"""Mixed second derivatives of F and h along directions (psi w, w), by differences of MuJoCo steps.

The gradient of a criterion needs these second derivatives. The steps also give all first
derivatives by state and control.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array, record
from mjfim.plant.batch import SampleSteps, SubstepObservations
from mjfim.plant.dynamics import Dynamics
from mjfim.plant.first_derivatives import FirstDerivatives, MovedSamples, all_samples, tiled
from mjfim.plant.outputs import OutputDelay
from mjfim.records.trajectory import Trajectory


@record
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

# One-sided in everything with a short step, for a plant with smoothed dry friction or with impacts
# of a term, whose derivatives change quickly.
SHARED_ORIGIN_SHORT = DifferenceAccuracy(
    central=False, coordinate_step=1e-6, direction_step=1e-5, shared_origin=True
)

# Two-sided in everything: the most accurate differences.
CENTRAL_DIFFERENCES = DifferenceAccuracy(central=True, coordinate_step=1e-4, direction_step=1e-3)


@record
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


class MixedDerivatives(FirstDerivatives):
    """First and mixed second derivatives of F and h."""

    @property
    def quickest_accuracy(self) -> DifferenceAccuracy:
        """The quickest differences for mixed second derivatives of this plant."""
        jumps = self.plant.smooth.source.smoothing_speeds or not self.plant.moves_freely.all()
        return SHARED_ORIGIN_SHORT if jumps else SHARED_ORIGIN

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

        plant, smooth, space = self.plant, self.plant.smooth, self.plant.space
        # Derivatives of sensors need the mean of both sides, so one-sided differences are used only
        # without sensors.
        has_origin = accuracy.shared_origin and not plant.simulator.sensors
        sizes = self.difference_sizes(trajectory)
        steps = accuracy.coordinate_step * sizes
        moved = self._move_samples(*all_samples(trajectory), steps, accuracy.central)

        # Steps from which first derivatives follow: those at theta, or those on both sides of it.
        # One-sided mixed differences are relative to the steps of the smooth plant at theta.
        near: list[SampleSteps] = []
        origin = None
        if has_origin:
            near.append(
                plant.simulator.step([plant.model(theta)], moved.states, moved.ctrl, observations)
            )
            origin = near[0]
            if smooth is not plant:
                origin = smooth.simulator.step([smooth.model(theta)], moved.states, moved.ctrl)

        F_mixed, of_sensors = [], []
        for number, w in enumerate(directions):
            along = (psi @ w) * plant.moves_freely
            epsilon = self.direction_step(accuracy.direction_step, along / sizes[: space.nx], w)
            distances = np.array([epsilon] if has_origin else [epsilon, -epsilon])
            at = theta + distances[:, None] * w
            shifts = distances[:, None, None] * along
            if origin is None:
                # First derivatives of the observations do not depend on w.
                near.append(_stepped(plant, moved, at, shifts, None if number else observations))
            on_smooth = (
                near[-1]
                if smooth is plant and origin is None
                else _stepped(smooth, moved, at, shifts)
            )
            after, smooth_sensors, _ = on_smooth
            reached = moved.unflatten(after)
            other = reached[1] if origin is None else moved.unflatten(origin[0])[0]
            width = 2.0 * epsilon if origin is None else epsilon
            F_mixed.append(moved.quotient(space.minus(reached[0], other) / width))
            if smooth_sensors is not None:
                pair = moved.unflatten(smooth_sensors)
                of_sensors.append(moved.quotient((pair[0] - pair[1]) / width))

        # The state after the last sample is no state of the trajectory.
        jacobian = None
        if (observed := near[0][2]) is not None:
            jacobian = moved.observation_jacobian(_mean_change(moved, observed))[:-1]
        count = len(moved.widths)
        states = [moved.unflatten(each) for each, _, _ in near]
        by_z = [np.mean(space.minus(x[:, :count], x[:, count:]), axis=0) for x in states]
        sensors = [_mean_change(moved, each) for _, each, _ in near if each is not None]
        return self._bilinear_from(
            theta,
            trajectory.state,
            psi,
            directions,
            first=np.mean([each / moved.widths for each in by_z], axis=0),
            mixed=F_mixed,
            sensor_first=np.mean([x / moved.widths for x in sensors], axis=0) if sensors else None,
            sensor_mixed=of_sensors,
            observation_jacobian=jacobian,
        )

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
        origin, F_mixed = found
        first = np.moveaxis(np.concatenate([origin.A, origin.B], axis=2), 2, 0)
        after = np.zeros((*first.shape[:1], 1, first.shape[2]))
        mixed = [np.concatenate([each.swapaxes(0, 1), after], axis=1) for each in F_mixed]
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


def _mean_change(moved: MovedSamples, values: Array) -> Array:
    """(c, n, ...) changes of values by the moves, averaged over the sides of the direction."""
    count = len(moved.widths)
    sides = moved.unflatten(values)
    return np.asarray(np.mean(sides[:, :count] - sides[:, count:], axis=0))


def _stepped(
    plant: Dynamics,
    moved: MovedSamples,
    theta: Array,
    shifts: Array,
    observations: SubstepObservations | None = None,
) -> SampleSteps:
    """Steps of moved samples at several parameter values, one after the other.

    Args:
        plant: The plant.
        moved: The samples, moved along each coordinate of (x, u).
        theta: (b, p) parameters.
        shifts: (b, n, nx) further moves of the samples, which belong to the parameters.
        observations: Quantities to observe, or None.
    """
    moves = [tiled(shift, moved.batch_shape[0]) for shift in shifts]
    return plant.simulator.step(
        plant.models(theta),
        np.concatenate([plant.space.plus(moved.states, move) for move in moves]),
        np.concatenate([moved.ctrl] * len(moves)),
        observations,
    )
