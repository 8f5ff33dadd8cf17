"""Designs under hard limits: `log J + mu * barrier`, mu falling in stages (Hauser & Saccon 2006).

The logarithm makes the cost free of scale, so that one ladder of mu fits every experiment; its minima are those of J.
The barrier is relaxed: it stays defined outside, and an infeasible start is first driven inside without any cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.barrier import Hedge
from mjfim.fence import Fence, Sight
from mjfim.lq import TangentCurve
from mjfim.objective import DIVERGED, DesignProblem, Point
from mjfim.pronto import Expansion
from mjfim.trajectory import Array


@dataclass(frozen=True, eq=False)
class InteriorPoint:
    """A trajectory with its cost and its limits. A diverged trial has no sight and infinite value.

    point: with the cost J, or None where only the limits are looked at;  merit: log J, 0 without
    barrier: its value, mu left out
    """

    sight: Sight | None
    point: Point | None
    merit: float
    barrier: float

    @property
    def ctrl(self) -> Array:
        """(N, nu)"""
        return seen(self).trajectory.ctrl


OUTSIDE = InteriorPoint(None, None, np.inf, np.inf)


def seen(point: InteriorPoint) -> Sight:
    """What its limits look at. Raises ValueError for a diverged trial."""
    if point.sight is None:
        raise ValueError("a diverged trial has no trajectory")
    return point.sight


@dataclass(frozen=True, eq=False)
class InteriorProblem:
    """`log J + mu B` as Algorithm 1 wants it; D-optimality has its logarithm in it already and is counted per parameter.

    costs: False where only the limits are to be met;  delta: relaxation of the barrier
    """

    base: DesignProblem
    fence: Fence
    mu: float
    delta: float
    costs: bool = True

    def point(self, ctrl: Array) -> InteriorPoint:
        """Evaluate along the open-loop trajectory of a control."""
        watched = self.base.plant.watch(self.base.theta, ctrl, self.fence.taps)
        if watched is None:
            return OUTSIDE
        sight = self.fence.sight(*watched, slopes=False)
        barrier = self.fence.value(sight, self.delta)
        if not self.costs:
            return InteriorPoint(sight, None, 0.0, barrier)
        point = self.base.point(sight.trajectory, self.base.plant.draft)
        return OUTSIDE if point is DIVERGED else InteriorPoint(sight, point, self._merit(point), barrier)

    def again(self, point: InteriorPoint) -> InteriorPoint:
        """A point of a problem that differs from this one in criterion, mu, delta or the fence's bounds."""
        if point.sight is None or point.point is None:
            return point
        judged = self.base.judged(point.point)
        return InteriorPoint(point.sight, judged, self._merit(judged), self.fence.value(point.sight, self.delta))

    def _merit(self, point: Point) -> float:
        if self.base.information.criterion == "D":
            return point.cost / self._nats(point)
        return float(np.log(point.cost)) if point.cost > 0.0 and np.isfinite(point.cost) else np.inf

    def _share(self, point: InteriorPoint) -> float:
        """dJ over the change of the merit."""
        if point.point is None:
            return 1.0
        return self._nats(point.point) if self.base.information.criterion == "D" else point.point.cost

    def _nats(self, point: Point) -> float:
        count = 1 if point.criterion is None else len(point.criterion.eigenvalues)
        return self.base.information.weight * count

    def value(self, point: InteriorPoint) -> float:
        """`log J + mu B`."""
        return point.merit + self.mu * point.barrier

    def size(self, point: InteriorPoint) -> float:
        """One e-fold of J, or the barrier where that is more; without a cost, the barrier in full."""
        return max(1.0, abs(point.barrier) * (self.mu if self.costs else 1.0))

    def expand(self, point: InteriorPoint) -> Expansion:
        """Expansion of the sum; the barrier's share stands apart as well."""
        sight = seen(point)
        sight = self.fence.sight(sight.trajectory, sight.tapped, slopes=True)
        if point.point is None:
            A, B, rise = self.base.plant.tapped(self.base.theta, sight.trajectory, self.fence.taps)
            e = Expansion(A, B, np.zeros((len(A) + 1, A.shape[1])), np.zeros((len(A), B.shape[2])))
        else:
            e, found = self.base.tapped(point.point, self.fence.taps)
            if found is None:
                raise ValueError("an expansion along a criterion without directions")
            rise = found
        share = self._share(point)
        hedge: Hedge = self.fence.expand(sight, rise, self.delta).times(self.mu)
        return Expansion(e.A, e.B, e.a / share + hedge.a, e.b / share + hedge.b, None, hedge, e.spectral)

    def project(self, point: InteriorPoint, zeta: TangentCurve, gamma: float, K: Array) -> InteriorPoint:
        """P(xi + gamma zeta), evaluated."""
        trajectory = seen(point).trajectory
        if not K.any():
            return self.point(trajectory.ctrl + gamma * zeta.v)
        moved = self.base.plant.project(self.base.theta, trajectory, zeta, gamma, K)
        return OUTSIDE if moved is None else self.point(moved.ctrl)

    def difference(self, new: InteriorPoint, old: InteriorPoint) -> TangentCurve:
        """(x_new - x_old, u_new - u_old)."""
        return self.base.plant.difference(seen(new).trajectory, seen(old).trajectory)

    def refine(self, point: InteriorPoint) -> InteriorPoint | None:
        """Never: the ladder of mu ends before the differences matter."""
        return None
