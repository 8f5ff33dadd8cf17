"""Algorithm 1 of Wilson & Murphey: descent on the trajectory manifold with the projection operator.

The loop is a generator of iterates, which progress bars, logs, checkpoints and early stops consume.
The module knows arrays and two protocols, neither MuJoCo nor Fisher information.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from mjfim.arrays import Array, record
from mjfim.optimize.cost_models import BarrierExpansion, EigenvalueModel
from mjfim.optimize.lq import (
    CurveCoordinates,
    TangentCurve,
    amplification_in_best_units,
    regulator,
)
from mjfim.parallel.budget import Budget
from mjfim.records.design import Status

P = TypeVar("P")

# Predicted decrease, relative to the cost, below which round-off hides the actual decrease.
ROUND_OFF = 1e-12

# Smallest accepted share of the predicted decrease of a step (Armijo's rule).
SUFFICIENT_DECREASE = 1e-4

# Smallest and largest factor by which the line search shortens a rejected step.
MIN_SHORTENING, MAX_SHORTENING = 0.3, 0.5

# Largest number of steps that a line search tries.
MAX_TRIALS = 30

# Largest predicted decrease of the first trial step, relative to the scale of the cost.
MAX_PREDICTED_DECREASE = 2.0


@record
class Expansion:
    """First-order model of the cost on the tangent space.

    The derivative of the cost along (z, v) is `DJ.zeta = sum a'z + b'v` with
    `z_{k+1} = A_k z_k + B_k v_k`.

    Attributes:
        A: (N, nx, nx) derivative of the next state by the state.
        B: (N, nx, nu) derivative of the next state by the control [x-unit / u-unit].
        a: (N+1, nx) derivative of the cost by the state [1 / x-unit].
        b: (N, nu) derivative of the cost by the control [1 / u-unit].
        extended: Expansion with psi among its nx (1+p) states, for a metric with weight on psi;
            otherwise None.
        barrier: Part of a and b that comes from the barrier, with the barrier's Gauss-Newton
            Hessian; None without limits.
        eigenvalue_model: Model of the logarithm of the cost that is better than linear, if a and b
            are derivatives of that logarithm; otherwise None.
    """

    A: Array
    B: Array
    a: Array
    b: Array
    extended: Expansion | None = None
    barrier: BarrierExpansion | None = None
    eigenvalue_model: EigenvalueModel | None = None

    def slope(self, zeta: TangentCurve) -> float:
        """Directional derivative DJ.zeta of the cost.

        Args:
            zeta: The tangent vector.

        Returns:
            The derivative.
        """
        return float(np.sum(self.a * zeta.z) + np.sum(self.b * zeta.v))

    def coordinates(self, K: Array) -> CurveCoordinates:
        """Curve coordinates of the trajectory, with a gain K: (N, nu, nx)."""
        return CurveCoordinates(A=self.A, B=self.B, K=K)

    def gradient(self, K: Array) -> Array:
        """Gradient by the curve coordinate `c = u + K x`, that is, through the projection operator.

        Args:
            K: (N, nu, nx) gain of the projection operator.

        Returns:
            (N, nu) gradient [1 / u-unit].
        """
        return self.coordinates(K).gradient(self.a, self.b)

    def lift(self, K: Array, c: Array) -> TangentCurve:
        """Tangent vector of a change of the curve coordinate.

        Args:
            K: (N, nu, nx) gain of the projection operator.
            c: (N, nu) change of the curve coordinate [u-unit].

        Returns:
            The tangent vector.
        """
        return self.coordinates(K).lift(c)


class Problem(Protocol[P]):
    """Cost and dynamics as Algorithm 1 needs them.

    A point P is a trajectory together with everything that was computed along it.
    """

    def value(self, point: P) -> float:
        """Cost J at a point.

        Args:
            point: The point.

        Returns:
            The cost; infinite where the simulation of the point diverged.
        """

    def size(self, point: P) -> float:
        """Scale with which changes of J are compared.

        Args:
            point: The point.

        Returns:
            A positive number; J itself where J is positive.
        """

    def expand(self, point: P) -> Expansion:
        """First-order expansion at a point.

        Args:
            point: The point.

        Returns:
            The expansion.
        """

    def project(self, point: P, zeta: TangentCurve, gamma: float, K: Array) -> P:
        """The trajectory P(xi + gamma zeta).

        Args:
            point: The point xi.
            zeta: Direction.
            gamma: Step length.
            K: (N, nu, nx) gain of the projection operator.

        Returns:
            The projected point.
        """

    def difference(self, new: P, old: P) -> TangentCurve:
        """Difference of two trajectories in the tangent space.

        Args:
            new: One point.
            old: Another point.

        Returns:
            The tangent vector (x_new - x_old, u_new - u_old).
        """

    def refine(self, point: P) -> P | None:
        """Make the derivatives at a point more accurate.

        Args:
            point: The point.

        Returns:
            The point with more accurate derivatives; None where there are no more accurate ones.
        """


class Direction(Protocol):
    """Chooses a descent direction from the expansion and may learn from accepted steps."""

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """A descent direction at an expansion, under the regulator K: (N, nu, nx)."""

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Learn from an accepted step.

        Args:
            expansion: Expansion at the new point.
            K: (N, nu, nx) gain of the projection operator.
            moved: Difference between the new and the old point.
        """
        return

    def reset(self) -> bool:
        """Clear the memory; True if there was something to clear."""
        return False


def line_search(
    problem: Problem[P],
    point: P,
    zeta: TangentCurve,
    slope: float,
    K: Array,
    *,
    budget: Budget,
    first: float = 1.0,
) -> tuple[P, float] | None:
    """Search along a direction until `J(gamma) <= J(0) + SUFFICIENT_DECREASE gamma DJ.zeta`.

    A rejected gamma is shortened to the minimum of the parabola through J(0), the slope and
    J(gamma), within [MIN_SHORTENING, MAX_SHORTENING] gamma.

    Args:
        problem: Cost and projection.
        point: Point to start from.
        zeta: Descent direction.
        slope: Directional derivative DJ.zeta, negative.
        K: (N, nu, nx) gain of the projection operator.
        budget: Where it is exhausted, no further step is tried.
        first: First step length.

    Returns:
        The accepted point and its gamma, or None where even the shortest step does not lower J
        and where the time is over.
    """
    value = problem.value(point)
    gamma = first

    for _ in range(MAX_TRIALS):
        if gamma * abs(slope) <= ROUND_OFF * abs(value):
            return None

        trial = problem.project(point, zeta, gamma, K)
        new = problem.value(trial)
        if new <= value + SUFFICIENT_DECREASE * gamma * slope:
            return trial, gamma
        if budget.exhausted is not None:
            return None

        # Minimum of the parabola. A diverged trial has none; its step is shortened as much as
        # possible.
        excess = new - value - gamma * slope
        shorter = 0.0
        if np.isfinite(new) and excess > 0.0:
            shorter = -0.5 * slope * gamma**2 / excess
        gamma = float(np.clip(shorter, MIN_SHORTENING * gamma, MAX_SHORTENING * gamma))

    return None


@dataclass(frozen=True, kw_only=True, eq=False)
class Iterate(Generic[P]):
    """One iterate of Algorithm 1.

    Attributes:
        index: Number of accepted steps so far.
        point: The point.
        value: Cost J at the point.
        slope: Magnitude of DJ.zeta at the point.
        gamma: Length of the step that led to the point.
        status: Why the algorithm ended; None except in the last iterate.
    """

    index: int
    point: P
    value: float
    slope: float
    gamma: float
    status: Status | None = None


@record
class Regulator:
    """Linear-quadratic regulator along a trajectory, the gain K of the projection operator.

    Attributes:
        Q: (nx, nx) weight of the state, multiplied by the sample period.
        R: (nu, nu) weight of the control, multiplied by the sample period.
        terminal: (nx, nx) weight of the last state.
        period: Number of iterates after which K is renewed.
        feedback_threshold: Amplification of deviations along the open-loop trajectory, in the best
            units, up to which the projection needs no feedback and K is zero. With 0 there is
            always feedback, with infinity never.
        state_sizes: (nx,) sizes of the state's components [x-unit], units in which deviations are
            measured besides the best ones.
    """

    Q: Array
    R: Array
    terminal: Array
    period: int = 10
    feedback_threshold: float = 0.0
    state_sizes: Array | float = 1.0

    def gain(self, expansion: Expansion) -> Array:
        """Gain about the trajectory of an expansion.

        Args:
            expansion: Expansion at the trajectory.

        Returns:
            K: (N, nu, nx).
        """
        # The two extreme thresholds need no amplification, whose computation takes time.
        threshold = self.feedback_threshold
        growth = np.inf if threshold == 0.0 else 0.0
        if 0.0 < threshold < np.inf:
            growth = amplification_in_best_units(expansion.A, self.state_sizes)
        if growth > threshold:
            return regulator(expansion.A, expansion.B, self.Q, self.R, self.terminal)

        return np.zeros_like(expansion.B.swapaxes(1, 2))


def optimize(
    problem: Problem[P],
    start: P,
    direction: Direction,
    regulate: Regulator,
    *,
    budget: Budget,
    tolerance: float,
    max_iterations: int,
) -> Iterator[Iterate[P]]:
    """Run Algorithm 1 from a point; the consumer decides when to stop earlier.

    Args:
        problem: Cost and dynamics.
        start: First point.
        direction: Chooses descent directions.
        regulate: Makes the gain of the projection operator.
        budget: Where it is exhausted, the line search ends.
        tolerance: The algorithm has converged where `|DJ.zeta| <= tolerance * size`.
        max_iterations: Largest number of accepted steps.

    Yields:
        Every iterate; the last one carries a status, unless the time ended the line search.
    """
    point, gamma, index = start, 0.0, 0
    expansion = problem.expand(point)
    K = regulate.gain(expansion)

    while True:
        # A direction may learn when it is asked, so that it is asked once at each point.
        zeta = direction(expansion, K)
        slope = expansion.slope(zeta)
        size = problem.size(point)
        iterate = Iterate(
            index=index,
            point=point,
            value=problem.value(point),
            slope=abs(slope),
            gamma=gamma,
        )

        found, status = None, Status.CONVERGED
        if abs(slope) > tolerance * size:
            if index >= max_iterations:
                yield replace(iterate, status=Status.MAX_ITERATIONS)
                return

            yield iterate
            status = Status.STALLED

            # The linear model is wrong for a step that predicts a decrease of more than twice J.
            # The line search begins with a shorter step then.
            if slope < 0.0:
                first = min(1.0, -MAX_PREDICTED_DECREASE * size / slope)
                found = line_search(problem, point, zeta, slope, K, budget=budget, first=first)

        if found is None and budget.exhausted is not None:
            return

        # More accurate derivatives may show a further descent. Where there are none and no step
        # lowers J, the memory of the direction is cleared. If it is empty, the algorithm ends.
        if found is None:
            better = problem.refine(point)
            if better is not None:
                point = better
                expansion = problem.expand(point)
            elif status is Status.CONVERGED or not direction.reset():
                yield replace(iterate, status=status)
                return
            continue

        previous = point
        point, gamma = found
        expansion = problem.expand(point)
        direction.accept(expansion, K, problem.difference(point, previous))

        index += 1
        if index % regulate.period == 0:
            K = regulate.gain(expansion)
