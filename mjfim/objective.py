"""The cost of a design, eq. 3 of the paper: information, control effort, tracking; and its expansion for Algorithm 1."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.extended import extend
from mjfim.fisher import Criterion, Information
from mjfim.lq import TangentCurve
from mjfim.plant import CENTRAL, FAST, Accuracy, Plant
from mjfim.pronto import Expansion
from mjfim.tangent import StateSpace
from mjfim.trajectory import Array, Sensitivity, Trajectory


@dataclass(frozen=True, eq=False)
class RunningCost:
    """`1/2 sum_k dt [(x_{k+1} - x_d)' Q (x_{k+1} - x_d) + u_k' R u_k]` over k = 0 ... N-1; x_0 is given.

    desired: x_d, (N+1, ns);  Q: (nx,) and R: (nu,) diagonals, not yet multiplied by dt
    """

    space: StateSpace
    dt: float
    desired: Array
    Q: Array
    R: Array

    def value(self, trajectory: Trajectory) -> float:
        """The integral."""
        dx = self.space.minus(trajectory.state, self.desired)[1:]
        return float(0.5 * self.dt * (np.sum(dx**2 * self.Q) + np.sum(trajectory.ctrl**2 * self.R)))

    def gradient(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """(a, b): derivative by x_k (N+1, nx) and u_k (N, nu)."""
        a = self.dt * self.space.minus(trajectory.state, self.desired) * self.Q
        a[0] = 0.0
        return a, self.dt * trajectory.ctrl * self.R


@dataclass(frozen=True, eq=False)
class Point:
    """A trajectory with everything computed along it. A diverged trial has no trajectory and infinite cost."""

    trajectory: Trajectory | None
    sensitivity: Sensitivity | None
    information: Array | None
    criterion: Criterion | None
    cost: float
    accuracy: Accuracy


DIVERGED = Point(None, None, None, None, np.inf, FAST)


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """J(theta fixed) as Algorithm 1 wants it: a `pronto.Problem` over `Point`s.

    extended: expansions also carry psi as a state;  draft: never refine the differences (coarse levels)
    """

    plant: Plant
    theta: Array
    information: Information
    running: RunningCost
    extended: bool = False
    draft: bool = False

    def point(self, trajectory: Trajectory, accuracy: Accuracy = FAST) -> Point:
        """Evaluate J along a trajectory."""
        sensitivity = self.plant.sensitivity(self.theta, trajectory)
        if sensitivity is None:
            return DIVERGED
        information = self.information.matrix(sensitivity)
        criterion = self.information.evaluate(information)
        cost = criterion.value + self.running.value(trajectory)
        return Point(trajectory, sensitivity, information, criterion, cost, accuracy)

    def value(self, point: Point) -> float:
        """J; infinite for a diverged trial."""
        return point.cost

    def size(self, point: Point) -> float:
        """J; for D-optimality, whose J has no natural zero, one nat per parameter and the running cost."""
        if self.information.criterion != "D":
            return point.cost
        trajectory, _, _ = _computed(point)
        return self.information.weight * len(self.theta) + self.running.value(trajectory)

    def expand(self, point: Point) -> Expansion:
        """Expansion of J about a point: mixed differences for the information, closed form for the rest."""
        trajectory, sensitivity, criterion = _computed(point)
        bilinear = self.plant.bilinear(self.theta, trajectory, sensitivity.psi, criterion.directions, point.accuracy)
        a, b = self.information.gradient(criterion, sensitivity, bilinear)
        a_running, b_running = self.running.gradient(trajectory)
        extended = None
        if self.extended:
            full = self.plant.bilinear(self.theta, trajectory, sensitivity.psi, np.eye(len(self.theta)), point.accuracy)
            a_psi, a_h, b_h = self.information.partials(criterion, sensitivity, full)
            extended = extend(full, a_running + a_h, b_running + b_h, a_psi)
        return Expansion(bilinear.A, bilinear.B, a + a_running, b + b_running, extended)

    def project(self, point: Point, zeta: TangentCurve, gamma: float, K: Array) -> Point:
        """P(xi + gamma zeta), evaluated."""
        trajectory, _, _ = _computed(point)
        moved = self.plant.project(self.theta, trajectory, zeta, gamma, K)
        return DIVERGED if moved is None else self.point(moved, point.accuracy)

    def difference(self, new: Point, old: Point) -> TangentCurve:
        """(x_new - x_old, u_new - u_old)."""
        return self.plant.difference(_computed(new)[0], _computed(old)[0])

    def refine(self, point: Point) -> Point | None:
        """The same point, to be expanded with central differences."""
        return None if self.draft or point.accuracy is CENTRAL else replace(point, accuracy=CENTRAL)


def _computed(point: Point) -> tuple[Trajectory, Sensitivity, Criterion]:
    if point.trajectory is None or point.sensitivity is None or point.criterion is None:
        raise ValueError("a diverged trial has no expansion")
    return point.trajectory, point.sensitivity, point.criterion
