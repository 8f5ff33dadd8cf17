"""The cost of a design under hard limits: `log J + mu B` with a barrier B of the limits.

The logarithm makes the cost independent of its scale, so that one schedule of mu fits every
experiment; its minima are those of J. The barrier is relaxed, which means that it is defined
outside the limits as well (Hauser & Saccon 2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.limits.constraint_kinds import ConstraintValues
from mjfim.excitation.limits.constraints import ConstraintSet
from mjfim.excitation.objective import DIVERGED, DesignPoint, DesignProblem
from mjfim.optimize.lq import TangentCurve
from mjfim.optimize.projection_operator import Expansion

# Largest weight mu of the barrier with which directions may follow its curvature along a step. With
# larger weights it is so smooth that this is not worth the time.
SHARP_MU = 4e-3

# Smallest exponent of a limit that counts: 10 % more range change σ by a thousandth.
LEAST_EXPONENT = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class InteriorPoint:
    """A trajectory with its cost and the values of its constraints.

    Attributes:
        values: Constrained quantities; None for a trial that diverged.
        point: The trajectory with its cost J; None where only the constraints are evaluated.
        merit: log J; 0 without a cost, infinite for a trial that diverged.
        barrier: Value of the barrier, not multiplied by mu.
    """

    values: ConstraintValues | None
    point: DesignPoint | None
    merit: float
    barrier: float

    @property
    def ctrl(self) -> Array:
        """(N, nu) control [u-unit]."""
        return values_of(self).trajectory.ctrl


# The point of every trial that diverged.
DIVERGED_POINT = InteriorPoint(values=None, point=None, merit=np.inf, barrier=np.inf)


def values_of(point: InteriorPoint) -> ConstraintValues:
    """Return the constrained quantities of a point.

    Args:
        point: A point.

    Returns:
        Its constrained quantities.

    Raises:
        ValueError: The point is a trial that diverged.
    """
    if point.values is None:
        raise ValueError("a diverged trial has no trajectory")

    return point.values


@dataclass(frozen=True, kw_only=True, eq=False)
class InteriorProblem:
    """The problem of minimising `log J + mu B` over controls, in the form that Algorithm 1 needs.

    The cost of D-optimality is a logarithm already; the cost per parameter replaces `log J` there.

    Attributes:
        base: The cost J on the plant without clamps.
        constraints: The limits.
        mu: Weight of the barrier B.
        delta: Relaxation of the barrier, over half of each range.
        with_cost: False to minimise the barrier alone, which steers a control inside the limits.
        follows_curvature: Whether directions may follow the curvature of a sharp barrier along a
            step, see `StructuredBFGS`.
    """

    base: DesignProblem
    constraints: ConstraintSet
    mu: float
    delta: float
    with_cost: bool = True
    follows_curvature: bool = False

    def point(self, ctrl: Array, *, lumps: bool = True) -> InteriorPoint:
        """Evaluate a control along its open-loop trajectory.

        Args:
            ctrl: (N, nu) control [u-unit].
            lumps: False to move all parameters, see `DesignPoint`.

        Returns:
            The point; `DIVERGED_POINT` where the simulation diverges.
        """
        values = self.constraints.along(self.base.plant, self.base.theta, ctrl)
        if values is None:
            return DIVERGED_POINT

        point, merit = None, 0.0
        if self.with_cost:
            accuracy = self.base.plant.derivatives.quickest_accuracy
            point = self.base.point(values.trajectory, accuracy, lumps=lumps)
            if point is DIVERGED:
                return DIVERGED_POINT
            merit = self._merit(point)
        barrier = self.constraints.value(values, self.delta)
        return InteriorPoint(values=values, point=point, merit=merit, barrier=barrier)

    def reevaluate(self, point: InteriorPoint) -> InteriorPoint:
        """Evaluate a point of another problem without a simulation.

        The other problem may differ in its criterion, mu, delta and bounds.

        Args:
            point: Point of the other problem.

        Returns:
            The point of this problem.
        """
        if point.values is None or point.point is None:
            return point

        evaluated = self.base.reevaluated(point.point)
        return replace(
            point,
            point=evaluated,
            merit=self._merit(evaluated),
            barrier=self.constraints.value(point.values, self.delta),
        )

    def _merit(self, point: DesignPoint) -> float:
        """`log J`, infinite where J <= 0; for D-optimality the cost per parameter instead."""
        if self.base.information.criterion == "D":
            return point.cost / self._cost_per_nat(point)

        if point.cost > 0.0 and np.isfinite(point.cost):
            return float(np.log(point.cost))
        return np.inf

    def _merit_scale(self, point: InteriorPoint) -> float:
        """Derivative dJ / d(merit)."""
        if point.point is None:
            return 1.0
        if self.base.information.criterion == "D":
            return self._cost_per_nat(point.point)

        return point.point.cost

    def _cost_per_nat(self, point: DesignPoint) -> float:
        """Cost of D-optimality that corresponds to one e-fold of every eigenvalue."""
        count = 1 if point.criterion is None else len(point.criterion.eigenvalues)
        return self.base.information.weight * count

    def prices(self, point: InteriorPoint, controls: Sequence[str]) -> dict[str, float]:
        """Exponents e of the limits at the end of a stage: σ falls as `range^-e`.

        There, `mu dB/d(bound)` is the multiplier of a limit, the derivative of the merit by its
        bound. The merit is twice the logarithm of the σ that the criterion minimises.

        Args:
            point: Minimum of `log J + mu B`.
            controls: Names of the nu controls.

        Returns:
            Exponents by the titles of the limits; those that hardly matter are left out.
        """
        slopes = self.constraints.narrowing(values_of(point), self.delta, controls)
        exponents = {title: 0.5 * self.mu * slope for title, slope in slopes.items()}
        return {title: each for title, each in exponents.items() if each > LEAST_EXPONENT}

    def value(self, point: InteriorPoint) -> float:
        """`log J + mu B` at a point."""
        return point.merit + self.mu * point.barrier

    def size(self, point: InteriorPoint) -> float:
        """Scale of the slope in the test of convergence: 1, or the weighted barrier if larger."""
        weight = self.mu if self.with_cost else 1.0
        return max(1.0, abs(point.barrier) * weight)

    def _expansion_of_cost(
        self, point: InteriorPoint, values: ConstraintValues
    ) -> tuple[Expansion, Array]:
        """Expansion of `log J`, and derivatives of the observations by state and control."""
        observations = self.constraints.observations
        if point.point is not None:
            expansion, observed = self.base.expand_observed(point.point, observations)
            assert observed is not None
            return expansion, observed
        # Without a cost only the dynamics and the observations are linearised.
        A, B, jacobian = self.base.plant.derivatives.observation_jacobians(
            self.base.theta, values.trajectory, observations
        )
        a, b = np.zeros((len(A) + 1, A.shape[1])), np.zeros((len(A), B.shape[2]))
        return Expansion(A=A, B=B, a=a, b=b), jacobian

    def expand(self, point: InteriorPoint) -> Expansion:
        """Expand `log J + mu B` about a point; the expansion of `mu B` is also given separately.

        Args:
            point: Point that did not diverge.

        Returns:
            The linearised dynamics, the gradient of the sum and the expansion of the barrier.
        """
        values = values_of(point)
        values = self.constraints.evaluate(values.trajectory, values.observed, slopes=True)
        expansion, jacobian = self._expansion_of_cost(point, values)
        scale = self._merit_scale(point)
        barrier = self.constraints.expand(values, jacobian, self.delta)
        barrier = barrier.scaled(self.mu)
        if not (self.follows_curvature and self.mu <= SHARP_MU):
            barrier = replace(barrier, curvature=None)

        return replace(
            expansion,
            a=expansion.a / scale + barrier.a,
            b=expansion.b / scale + barrier.b,
            barrier=barrier,
        )

    def project(
        self, point: InteriorPoint, zeta: TangentCurve, gamma: float, K: Array
    ) -> InteriorPoint:
        """Evaluate P(xi + gamma zeta).

        Args:
            point: Point at xi.
            zeta: Direction.
            gamma: Length of the step.
            K: (N, nu, nx) gain of the projection operator [u-unit / x-unit].

        Returns:
            The new point.
        """
        trajectory = values_of(point).trajectory
        lumps = point.point is None or point.point.lumps
        if not K.any():
            return self.point(trajectory.ctrl + gamma * zeta.v, lumps=lumps)

        moved = self.base.plant.project(self.base.theta, trajectory, zeta, gamma, K)
        return DIVERGED_POINT if moved is None else self.point(moved.ctrl, lumps=lumps)

    def difference(self, new: InteriorPoint, old: InteriorPoint) -> TangentCurve:
        """(x_new - x_old, u_new - u_old) of two points."""
        return self.base.plant.difference(values_of(new).trajectory, values_of(old).trajectory)

    def refine(self, point: InteriorPoint) -> InteriorPoint | None:
        """Return None: a run ends before the accuracy of the derivatives matters."""
        return None
