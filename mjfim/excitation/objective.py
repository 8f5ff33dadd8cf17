"""The cost of a design: a criterion of the Fisher information plus a running cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.information.criteria import Criterion
from mjfim.information.fisher import FisherInformation
from mjfim.model.parameters import sample_parameters
from mjfim.optimize.lq import TangentCurve
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.mixed_derivatives import (
    CENTRAL_DIFFERENCES,
    FORWARD_DIFFERENCES,
    Bilinear,
    DifferenceAccuracy,
)
from mjfim.plant.plant import LumpedParameters, Plant
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Sensitivity, Trajectory

# Exponent q of the smooth maximum.
POOLING_EXPONENT = 20.0


@record
class RunningCost:
    """Weighted squares of the deviations from a desired trajectory and a desired control.

        1/2 sum_k dt [(x_{k+1} - x_d)' Q (x_{k+1} - x_d) + (u_k - u_d)' R (u_k - u_d)]

    for k = 0 ... N-1. The initial state is given and costs nothing.

    Attributes:
        space: Layout of the state.
        dt: Sample period [s].
        desired_state: x_d, (N+1, ns).
        Q: (nx,) diagonal of the weight on the state, not yet multiplied by dt [1 / (x-unit^2 s)].
        R: (nu,) diagonal of the weight on the control, not yet multiplied by dt [1 / (u-unit^2 s)].
        desired_control: u_d, (nu,) [u-unit].
    """

    space: StateSpace
    dt: float
    desired_state: Array
    Q: Array
    R: Array
    desired_control: Array

    def value(self, trajectory: Trajectory) -> float:
        """The running cost along a trajectory."""
        dx = self.space.minus(trajectory.state, self.desired_state)[1:]
        du = trajectory.ctrl - self.desired_control

        state_cost = np.sum(dx**2 * self.Q)
        control_cost = np.sum(du**2 * self.R)
        return float(0.5 * self.dt * (state_cost + control_cost))

    def gradient(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """Gradient of the running cost.

        Args:
            trajectory: The trajectory.

        Returns:
            (N+1, nx) derivative by the state and (N, nu) derivative by the control.
        """
        a = self.dt * self.space.minus(trajectory.state, self.desired_state) * self.Q
        a[0] = 0.0
        b = self.dt * (trajectory.ctrl - self.desired_control) * self.R
        return a, b


@record
class DesignPoint:
    """A trajectory with its information and its cost.

    A trial whose simulation diverges has no trajectory and an infinite cost.

    Attributes:
        trajectory: The trajectory, or None.
        sensitivity: Sensitivities of states and outputs to the parameters, or None.
        information: (p, p) Fisher information with the prior [1 / (theta_i theta_j unit)], or None.
        criterion: The criterion of the information with its derivative, or None.
        cost: J.
        accuracy: Differences with which the point is expanded.
        others: Points of this control at the further parameter samples of a robust design; their
            cost is not computed.
        lumps: False where the motion, or one from which the search came, shows that the columns of
            lumped parameters do not follow from the others. All parameters are moved then, here and
            at the points to which the search goes from here.
    """

    trajectory: Trajectory | None
    sensitivity: Sensitivity | None
    information: Array | None
    criterion: Criterion | None
    cost: float
    accuracy: DifferenceAccuracy
    others: tuple[DesignPoint, ...] = ()
    lumps: bool = True

    @property
    def phi(self) -> tuple[float, ...]:
        """Criterion at theta and at the further parameter samples; infinite where unknown."""
        criteria = [point.criterion for point in (self, *self.others)]
        return tuple(np.inf if criterion is None else criterion.value for criterion in criteria)


# The point of every trial whose simulation diverges.
DIVERGED = DesignPoint(
    trajectory=None,
    sensitivity=None,
    information=None,
    criterion=None,
    cost=np.inf,
    accuracy=FORWARD_DIFFERENCES,
)


@record
class ParameterSamples:
    """Parameter samples, and how the criterion is pooled over them.

    Attributes:
        thetas: (S, p) parameter values, the guess first [theta-unit].
        over: "mean" or "worst".
        logarithmic: True where phi is a logarithm, as for D-optimality.
    """

    thetas: Array
    over: Literal["mean", "worst"]
    logarithmic: bool = False

    @classmethod
    def of(cls, system: System) -> ParameterSamples | None:
        """Parameter values over which a robust design pools its criterion.

        Args:
            system: The system.

        Returns:
            The samples; None where `[robust]` is not stated.

        Raises:
            ExperimentError: The parameters cannot be sampled, or the descent weighs psi.
        """
        experiment = system.experiment
        robust = experiment.robust
        if robust is None:
            return None
        if experiment.descent.psi_weight:
            raise ExperimentError(
                "robust: descent.psi_weight is for a design at one parameter value; remove one of "
                "them"
            )

        thetas = sample_parameters(
            system.parameters, system.theta, robust.samples, robust.seed, system.impossible
        )
        return cls(thetas=thetas, over=robust.over, logarithmic=experiment.cost.criterion == "D")

    def value(self, phi: Sequence[float]) -> float:
        """Pool the criterion over the samples.

        Args:
            phi: S values of the criterion.

        Returns:
            The pooled value; infinite where a value is not finite.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)
        if not np.isfinite(values).all():
            return np.inf

        if self.over == "mean":
            return float(values.mean())
        if self.logarithmic:
            return float((scipy.special.logsumexp(q * values) - np.log(len(values))) / q)

        # Divide by the largest value, so that powers neither overflow nor vanish.
        largest = values.max()
        return float(largest * np.mean((values / largest) ** q) ** (1.0 / q))

    def weights(self, phi: Sequence[float]) -> Array:
        """Differentiate the pooled criterion.

        Args:
            phi: S values of the criterion, all finite.

        Returns:
            (S,) derivative by each value.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)

        if self.over == "mean":
            return np.full(len(values), 1.0 / len(values))
        if self.logarithmic:
            return np.asarray(np.exp(q * values - scipy.special.logsumexp(q * values)))

        pooled = self.value(phi)
        return np.asarray((values / pooled) ** (q - 1.0) / len(values))


@record
class DesignProblem:
    """The cost J of a design, in the form that Algorithm 1 of the paper needs.

    It is a `projection_operator.Problem` whose points are `DesignPoint`s.

    Attributes:
        plant: The plant.
        theta: (p,) parameter values at which the information is computed.
        information: Fisher information of the measured samples, and the criterion.
        running: Running cost.
        forward_differences_only: Never refine the differences; meant for coarse levels.
        parameter_samples: Samples over which a robust design pools the criterion, theta first, or
            None. One control drives all samples, without feedback.
        lumped: Parameters whose sensitivities follow from those of the others, or None.
        extends: Expansions also have psi as a state, for a metric that weighs psi.
    """

    plant: Plant
    theta: Array
    information: FisherInformation
    running: RunningCost
    forward_differences_only: bool = False
    parameter_samples: ParameterSamples | None = None
    lumped: LumpedParameters | None = None
    extends: bool = False

    def point(
        self,
        trajectory: Trajectory,
        accuracy: DifferenceAccuracy = FORWARD_DIFFERENCES,
        *,
        lumps: bool = True,
    ) -> DesignPoint:
        """Evaluate the cost along a trajectory.

        Args:
            trajectory: A trajectory of the plant at theta.
            accuracy: Differences with which sensitivities are computed.
            lumps: False to move all parameters, see `DesignPoint`.

        Returns:
            The point; `DIVERGED` where a simulation with moved parameters diverges.
        """
        point = self._point_without_cost(self.theta, trajectory, accuracy, lumps)
        if point.criterion is None:
            return DIVERGED

        others = []
        for theta in self._further_samples():
            try:
                moved = self.plant.simulate(theta, trajectory.ctrl)
            except SimulationDivergedError:
                return DIVERGED
            others.append(self._point_without_cost(theta, moved, accuracy))
            if others[-1].trajectory is None:
                return DIVERGED
        return self._with_cost(replace(point, others=tuple(others)))

    def reevaluated(self, point: DesignPoint) -> DesignPoint:
        """Evaluate the criterion and the cost of a point without a simulation.

        Args:
            point: A point of a problem that differs from this one in the criterion only.

        Returns:
            The point of this problem.
        """
        if point.information is None:
            return point

        others = tuple(self._with_criterion(other) for other in point.others)
        return self._with_cost(replace(self._with_criterion(point), others=others))

    def _with_criterion(self, point: DesignPoint) -> DesignPoint:
        """The point with the criterion of its information."""
        if point.information is None:
            return point
        return replace(point, criterion=self.information.evaluate(point.information))

    def _with_cost(self, point: DesignPoint) -> DesignPoint:
        """The point with its cost, which is computed from its criteria."""
        trajectory, _, criterion = _computed(point)
        phi = criterion.value
        if self.parameter_samples is not None:
            phi = self.parameter_samples.value(point.phi)
        return replace(point, cost=phi + self.running.value(trajectory))

    def _further_samples(self) -> Array:
        """(S-1, p) parameter samples besides theta."""
        if self.parameter_samples is None:
            return np.zeros((0, len(self.theta)))
        return self.parameter_samples.thetas[1:]

    def _point_without_cost(
        self,
        theta: Array,
        trajectory: Trajectory,
        accuracy: DifferenceAccuracy,
        lumps: bool = True,
    ) -> DesignPoint:
        """Point of a trajectory of the plant at theta: (p,), without its cost."""
        central = not accuracy.shared_origin

        # A search is quicker in closed form; numbers that are shown come from the engine alone.
        closed_form = accuracy is not CENTRAL_DIFFERENCES

        # At other values, other combinations may be without effect.
        may_lump = lumps and np.array_equal(theta, self.theta)
        lumped = self.lumped if may_lump else None
        sensitivity = self.plant.derivatives.sensitivity(
            theta, trajectory, central=central, lumped=lumped, closed_form=closed_form
        )
        if sensitivity is None:
            return DIVERGED

        information = self.information.matrix(sensitivity)
        return DesignPoint(
            trajectory=trajectory,
            sensitivity=sensitivity,
            information=information,
            criterion=self.information.evaluate(information),
            cost=np.inf,
            accuracy=accuracy,
            lumps=lumps and (lumped is None or sensitivity.is_lumped),
        )

    def value(self, point: DesignPoint) -> float:
        """J; infinite for a trial that diverges."""
        return point.cost

    def size(self, point: DesignPoint) -> float:
        """Size of J, which makes slopes relative.

        D-optimality minimises a logarithm, which has no natural zero. So the size of its criterion
        is one nat per parameter.
        """
        if self.information.criterion != "D":
            return point.cost
        trajectory, _, criterion = _computed(point)
        nats = len(criterion.eigenvalues)
        return self.information.weight * nats + self.running.value(trajectory)

    def expand(self, point: DesignPoint) -> Expansion:
        """Expand J about a point.

        The derivatives of the information are mixed differences, the others have a closed form.
        """
        return self.expand_observed(point, None)[0]

    def expand_observed(
        self, point: DesignPoint, observations: SubstepObservations | None
    ) -> tuple[Expansion, Array | None]:
        """Expand J and differentiate observations in one set of simulations.

        Args:
            point: The point.
            observations: The w quantities to observe at S engine steps of every sample, or None.

        Returns:
            The expansion, and (N, S, w, nx+nu) derivatives of the observations by state and
            control, or None.
        """
        trajectory, sensitivity, criterion = _computed(point)
        bilinear, a, b = self._criterion_gradient(self.theta, point, observations)

        # Under hard limits the smooth E-criterion gets a model of its eigenvalues as well.
        model = None
        under_limits = observations is not None
        if under_limits and self.parameter_samples is None and np.isfinite(criterion.power):
            model = self.information.eigenvalue_model(criterion, sensitivity, bilinear, point.cost)

        if self.parameter_samples is not None:
            # The trajectories of the further samples are functions of the control alone, so that
            # they add to b only.
            first, *weights = self.parameter_samples.weights(point.phi)
            a, b = first * a, first * b
            thetas = self._further_samples()
            for weight, theta, other in zip(weights, thetas, point.others, strict=True):
                own, own_a, own_b = self._criterion_gradient(theta, other)
                open_loop = np.zeros((len(own_b), own_b.shape[1], own_a.shape[1]))
                slope = Expansion(A=own.A, B=own.B, a=own_a, b=own_b).gradient(open_loop)
                b += weight * slope

        a_running, b_running = self.running.gradient(trajectory)
        expansion = Expansion(
            A=bilinear.A,
            B=bilinear.B,
            a=a + a_running,
            b=b + b_running,
            extended=self._extended(point, a_running, b_running) if self.extends else None,
            eigenvalue_model=model,
        )
        return expansion, bilinear.observation_jacobian

    def _extended(self, point: DesignPoint, a: Array, b: Array) -> Expansion:
        """Expansion of J over (x, psi), from the gradient (a, b) of the running cost."""
        trajectory, sensitivity, criterion = _computed(point)
        full = self.plant.derivatives.bilinear(
            self.theta, trajectory, sensitivity.psi, np.eye(len(self.theta)), point.accuracy
        )
        by_psi, by_state, by_control = self.information.partial_derivatives(
            criterion, sensitivity, full
        )
        return extend(full, a + by_state, b + by_control, by_psi)

    def _criterion_gradient(
        self, theta: Array, point: DesignPoint, observations: SubstepObservations | None = None
    ) -> tuple[Bilinear, Array, Array]:
        """Derivatives of the plant and of the criterion at a point of the plant at theta: (p,).

        Returns:
            The derivatives of the plant; those of the criterion by the state, (N+1, nx), and by the
            control, (N, nu).
        """
        trajectory, sensitivity, criterion = _computed(point)
        bilinear = self.plant.derivatives.bilinear(
            theta, trajectory, sensitivity.psi, criterion.directions, point.accuracy, observations
        )
        a, b = self.information.gradient(criterion, sensitivity, bilinear)
        return bilinear, a, b

    def project(
        self, point: DesignPoint, zeta: TangentCurve, gamma: float, K: Array
    ) -> DesignPoint:
        """Evaluate the trajectory P(xi + gamma zeta).

        Args:
            point: The point at xi.
            zeta: Direction, a tangent curve.
            gamma: Step length.
            K: (N, nu, nx) gain of the projection operator [u-unit / x-unit].
        """
        trajectory, _, _ = _computed(point)
        moved = self.plant.project(self.theta, trajectory, zeta, gamma, K)
        if moved is None:
            return DIVERGED
        return self.point(moved, point.accuracy, lumps=point.lumps)

    def difference(self, new: DesignPoint, old: DesignPoint) -> TangentCurve:
        """(x_new - x_old, u_new - u_old)."""
        return self.plant.difference(_computed(new)[0], _computed(old)[0])

    def refine(self, point: DesignPoint) -> DesignPoint | None:
        """The point with central differences; None where it has these, or may not have them."""
        if self.forward_differences_only or point.accuracy is CENTRAL_DIFFERENCES:
            return None
        others = tuple(replace(other, accuracy=CENTRAL_DIFFERENCES) for other in point.others)
        return replace(point, accuracy=CENTRAL_DIFFERENCES, others=others)


def _computed(point: DesignPoint) -> tuple[Trajectory, Sensitivity, Criterion]:
    """Trajectory, sensitivity and criterion of a point.

    Raises ValueError for a trial that diverges.
    """
    if point.trajectory is None or point.sensitivity is None or point.criterion is None:
        raise ValueError("a diverged trial has no expansion")
    return point.trajectory, point.sensitivity, point.criterion


def extend(full: Bilinear, a: Array, b: Array, a_psi: Array) -> Expansion:
    """Expand over the extended state (x, psi_1, ..., psi_p).

    Args:
        full: Bilinear derivatives along the unit directions of theta.
        a: (N+1, nx) derivative of J by the state at constant psi.
        b: (N, nu) derivative of J by the control at constant psi.
        a_psi: (N+1, nx, p) derivative of J by psi.

    Returns:
        The expansion, with nx (1+p) states.
    """
    N, nx, nu = full.B.shape
    p = a_psi.shape[2]
    # (N, p, nx, nx+nu) derivatives of the next psi by the state and the control.
    mixed = np.transpose(full.F_mixed, (1, 0, 3, 2))

    states = 1 + p
    A = np.zeros((N, states, nx, states, nx))
    A[:, range(states), :, range(states)] = full.A
    A[:, 1:, :, 0] = mixed[..., :nx]
    B = np.concatenate([full.B[:, None], mixed[..., nx:]], axis=1)

    size = states * nx
    return Expansion(
        A=A.reshape(N, size, size),
        B=B.reshape(N, size, nu),
        a=np.concatenate([a, np.swapaxes(a_psi, 1, 2).reshape(N + 1, nx * p)], axis=1),
        b=np.array(b),
    )
