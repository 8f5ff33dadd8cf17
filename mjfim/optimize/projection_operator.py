"""Algorithm 1 of Wilson & Murphey: descend over the trajectory manifold through the projection operator.

Knows arrays and one protocol, neither MuJoCo nor Fisher information. The loop is a generator of iterates; progress
bars, logs, checkpoints and early stops consume it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.barrier import BarrierExpansion
from mjfim.optimize.eigenvalue_model import EigenvalueModel
from mjfim.optimize.lq import CurveCoordinates, TangentCurve, largest_amplification, regulator
from mjfim.records.design import Status

P = TypeVar("P")
ROUND_OFF = 1e-12  # relative; a promised decrease below it says nothing


@dataclass(frozen=True, kw_only=True, eq=False)
class Expansion:
    """First-order model of the cost on the tangent space, `DJ.zeta = sum a'z + b'v` with `z_{k+1} = A z_k + B v_k`.

    A: (N, nx, nx);  B: (N, nx, nu);  a: (N+1, nx) [1 / x-unit];  b: (N, nu) [1 / u-unit]
    extended: the same with psi among the states (nx (1+p) of them), where a metric with weight on psi wants it
    barrier: the share of hard limits in a and b, with its Gauss-Newton Hessian
    eigenvalue_model: model of the cost's logarithm where a and b are of that, better than linear
    """

    A: Array
    B: Array
    a: Array
    b: Array
    extended: Expansion | None = None
    barrier: BarrierExpansion | None = None
    eigenvalue_model: EigenvalueModel | None = None

    def slope(self, zeta: TangentCurve) -> float:
        """DJ.zeta."""
        return float(np.sum(self.a * zeta.z) + np.sum(self.b * zeta.v))

    def gradient(self, K: Array) -> Array:
        """(N, nu) derivative of the cost by the curve coordinate `c = u + K x`, i.e. through the projection."""
        return CurveCoordinates(A=self.A, B=self.B, K=K).gradient(self.a, self.b)

    def lift(self, K: Array, c: Array) -> TangentCurve:
        """Tangent vector whose curve coordinate moves by c: (N, nu)."""
        return CurveCoordinates(A=self.A, B=self.B, K=K).lift(c)


class Problem(Protocol[P]):
    """What Algorithm 1 needs to know. A point P is a trajectory with whatever was computed along it."""

    def value(self, point: P) -> float:
        """J at a point; infinite where the trial diverged."""
        ...

    def size(self, point: P) -> float:
        """What a change of J is compared with, > 0: J itself where J is positive."""
        ...

    def expand(self, point: P) -> Expansion:
        """First-order expansion at a point."""
        ...

    def project(self, point: P, zeta: TangentCurve, gamma: float, K: Array) -> P:
        """The trajectory P(xi + gamma zeta) under the regulator K."""
        ...

    def difference(self, new: P, old: P) -> TangentCurve:
        """Tangent-space difference of two trajectories, (x_new - x_old, u_new - u_old)."""
        ...

    def refine(self, point: P) -> P | None:
        """The same point with more accurate differences, or None where they are already the most accurate."""
        ...


class Direction(Protocol):
    """Chooses zeta from the expansion; told of each accepted step."""

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """A descent direction."""
        ...

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Called with the expansion at the new point and the difference to the old one."""
        ...

    def reset(self) -> bool:
        """Forget what was learnt; True if there was something to forget."""
        ...


@dataclass(frozen=True, kw_only=True)
class Armijo:
    """Backtracking to `J(gamma) <= J(0) + sigma gamma DJ.zeta`.

    A rejected gamma shortens to the minimum of the parabola through J(0), slope and J(gamma), within [0.1, beta] gamma.
    """

    sigma: float = 1e-4
    beta: float = 0.5
    trials: int = 30

    def __post_init__(self) -> None:
        if not (0.0 < self.sigma < 0.5 and 0.0 < self.beta < 1.0 and self.trials > 0):
            raise ValueError("Armijo needs 0 < sigma < 0.5, 0 < beta < 1 and trials > 0")

    def search(
        self,
        problem: Problem[P],
        point: P,
        zeta: TangentCurve,
        slope: float,
        K: Array,
        first: float = 1.0,
    ) -> tuple[P, float] | None:
        """The accepted point and its gamma, or None where even the shortest step does not lower J."""
        value, gamma = problem.value(point), first
        for _ in range(self.trials):
            if gamma * abs(slope) <= ROUND_OFF * abs(value):
                return None
            trial = problem.project(point, zeta, gamma, K)
            new = problem.value(trial)
            if new <= value + self.sigma * gamma * slope:
                return trial, gamma
            curvature = new - value - gamma * slope
            shorter = (
                -0.5 * slope * gamma**2 / curvature if np.isfinite(new) and curvature > 0.0 else 0.0
            )
            gamma = float(np.clip(shorter, 0.1 * gamma, self.beta * gamma))
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class Iterate(Generic[P]):
    """One iterate of Algorithm 1. slope: |DJ.zeta| at this point; gamma: the step that led here; status: set on the last."""

    index: int
    point: P
    value: float
    slope: float
    gamma: float
    status: Status | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Regulator:
    """How K is made: weights Q, R, terminal (times dt) of the LQR along the trajectory, renewed every `period` iterates.

    feedback_threshold: K is zero where no deviation grows more than this along the open-loop trajectory
    """

    Q: Array
    R: Array
    terminal: Array
    period: int = 10
    feedback_threshold: float = 0.0

    def gain(self, expansion: Expansion) -> Array:
        """K: (N, nu, nx) about the expansion's trajectory."""
        if (
            self.feedback_threshold
            and largest_amplification(expansion.A) <= self.feedback_threshold
        ):
            N, nx, nu = expansion.B.shape
            return np.zeros((N, nu, nx))
        return regulator(expansion.A, expansion.B, self.Q, self.R, self.terminal)


def optimize(
    problem: Problem[P],
    start: P,
    direction: Direction,
    regulate: Regulator,
    armijo: Armijo,
    tolerance: float,
    max_iterations: int,
) -> Iterator[Iterate[P]]:
    """Algorithm 1. Yields every iterate; the last one carries a status. Stops at `|DJ.zeta| <= tolerance * size`."""
    point, gamma, index = start, 0.0, 0
    expansion = problem.expand(point)
    K = regulate.gain(expansion)
    while True:
        zeta = direction(expansion, K)
        slope = expansion.slope(zeta)
        value, size = problem.value(point), problem.size(point)
        if abs(slope) <= tolerance * size:
            better = problem.refine(point)
            if better is None:
                yield Iterate(
                    index=index,
                    point=point,
                    value=value,
                    slope=abs(slope),
                    gamma=gamma,
                    status=Status.CONVERGED,
                )
                return
            point, expansion = better, problem.expand(better)
            continue
        if index >= max_iterations:
            yield Iterate(
                index=index,
                point=point,
                value=value,
                slope=abs(slope),
                gamma=gamma,
                status=Status.MAX_ITERATIONS,
            )
            return
        yield Iterate(index=index, point=point, value=value, slope=abs(slope), gamma=gamma)
        first = min(
            1.0, -2.0 * size / slope
        )  # a step that promises to lose more than twice J is too long to try
        found = armijo.search(problem, point, zeta, slope, K, first) if slope < 0.0 else None
        if found is None:
            better = problem.refine(point)
            if better is not None:
                point, expansion = better, problem.expand(better)
                continue
            if direction.reset():
                continue
            yield Iterate(
                index=index,
                point=point,
                value=value,
                slope=abs(slope),
                gamma=gamma,
                status=Status.STALLED,
            )
            return
        old, (point, gamma) = point, found
        expansion = problem.expand(point)
        direction.accept(expansion, K, problem.difference(point, old))
        index += 1
        if index % regulate.period == 0:
            K = regulate.gain(expansion)
