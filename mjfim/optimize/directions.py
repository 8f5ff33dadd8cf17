"""Descent directions of Algorithm 1 without limits: metric descent and limited-memory BFGS.

The two-loop recursion of limited-memory BFGS is algorithm 7.4 of Nocedal & Wright, Numerical
Optimization.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.lq import RiccatiSolution, TangentCurve, Weights
from mjfim.optimize.projection_operator import Direction, Expansion

# Smallest curvature of a stored pair, relative to the norms of the step and of the change of the
# gradient.
MIN_RELATIVE_CURVATURE = 1e-10


# A step s, the change y of the gradient along it, and their product, which is positive.
CurvaturePair = tuple[Array, Array, float]


def convex_pairs(s: Array, y: Array, tolerance: float) -> list[CurvaturePair]:
    """The pairs of steps and changes of the gradient whose curvature is clearly positive.

    Args:
        s: (p, ...) steps.
        y: (p, ...) changes of the gradient along these steps.
        tolerance: Smallest curvature, relative to the norms of s and y.

    Returns:
        The pairs, in the same order.
    """
    steps = s.reshape(len(s), -1)
    changes = y.reshape(len(y), -1)
    curvatures = np.einsum("pi,pi->p", steps, changes)
    norms = np.linalg.norm(steps, axis=1) * np.linalg.norm(changes, axis=1)
    convex = np.flatnonzero(curvatures > tolerance * norms)
    return [(s[i], y[i], float(curvatures[i])) for i in convex]


def inverse_hessian_product(
    g: Array, pairs: Sequence[CurvaturePair], initial: Callable[[Array], Array]
) -> Array:
    """Product of the BFGS approximation of the inverse Hessian with a vector.

    Args:
        g: (...) vector, usually a gradient, or m vectors: (m, ...).
        pairs: Curvature pairs, the oldest first.
        initial: Product of the initial inverse Hessian with vectors of the shape of g.

    Returns:
        (...) or (m, ...) the product.
    """
    if not pairs:
        return initial(g)

    # A product of the rows with a vector has the shape (m,), or is a number for a single row.
    step = pairs[0][0]
    size = step.size
    rows = g.reshape(*g.shape[: g.ndim - step.ndim], size)

    alphas = []
    for s, y, curvature in reversed(pairs):
        alpha = (rows @ s.reshape(size) / curvature)[..., None]
        rows = rows - alpha * y.reshape(size)
        alphas.append(alpha)

    rows = initial(rows.reshape(g.shape)).reshape(rows.shape)

    for (s, y, curvature), alpha in zip(pairs, reversed(alphas), strict=True):
        beta = (rows @ y.reshape(size) / curvature)[..., None]
        rows = rows + (alpha - beta) * s.reshape(size)

    return rows.reshape(g.shape)


@dataclass
class MetricDescent(Direction):
    """The paper's direction, the solution of its problem (8).

    It minimises `DJ.zeta + 1/2 <zeta, zeta>` over the tangent space. All weights are already
    multiplied by the sample period.

    Attributes:
        Q: (nx, nx) metric on the state, or (nx (1+p), nx (1+p)) metric on x and on psi, stacked
            parameter by parameter.
        R: (nu, nu) metric on the control.
        terminal: Metric on the last state, shaped like Q.
        weighs_psi: Whether the metric also weighs the psi-part of zeta.
    """

    Q: Array
    R: Array
    terminal: Array
    weighs_psi: bool = False

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """The direction, by the Riccati equations.

        Its psi-part is left out, because the projection computes psi anew.
        """
        shown = expansion.extended if self.weighs_psi else expansion
        if shown is None:
            raise ValueError(
                "the problem must provide extended expansions for a metric with weight on psi"
            )

        weights = Weights.constant(len(shown.B), self.Q, self.R, self.terminal)
        zeta = RiccatiSolution.solve(shown.A, shown.B, weights).descent(shown.a, shown.b)
        nx = expansion.A.shape[1]
        return TangentCurve(z=zeta.z[:, :nx], v=zeta.v)


@dataclass
class LBFGS:
    """Limited-memory BFGS in the curve coordinate `c = u + K x`.

    In this coordinate, P(xi + gamma zeta) is affine in gamma. The initial Hessian is the control
    metric, so that the number of iterations does not depend on the sample period.

    Attributes:
        R: (nu, nu) control metric, already multiplied by the sample period.
        memory: Largest number of stored pairs.
    """

    R: Array
    memory: int = 40
    _pairs: tuple[CurvaturePair, ...] = ()
    _last: tuple[Expansion, Array, Array] | None = None

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """The quasi-Newton direction zeta = -H DJ."""
        c = -inverse_hessian_product(self._gradient(expansion, K), self._pairs, self._initial)
        return expansion.lift(K, c)

    def _initial(self, g: Array) -> Array:
        """(N, nu) product of the initial inverse Hessian with g: (N, nu).

        The initial inverse Hessian is the inverse metric, scaled by the newest pair.
        """
        scaled = self._inverse_metric(g)
        if self._pairs:
            _, y, curvature = self._pairs[-1]
            scaled *= curvature / np.vdot(y, self._inverse_metric(y))

        return scaled

    def _inverse_metric(self, g: Array) -> Array:
        """(N, nu) R^-1 g at every sample."""
        return np.asarray(np.linalg.solve(self.R, g.T).T, dtype=np.float64)

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Store the curvature pair of an accepted step, if its curvature is positive.

        Args:
            expansion: Expansion at the new point.
            K: (N, nu, nx) gain of the projection operator.
            moved: Difference between the new and the old point.
        """
        if self._last is None:
            return

        before = self._last[2]
        s = expansion.coordinates(K).coordinate(moved)
        y = self._gradient(expansion, K) - before

        pairs = convex_pairs(s[None], y[None], MIN_RELATIVE_CURVATURE)
        self._pairs = (*self._pairs, *pairs)[-self.memory :]

    def _gradient(self, expansion: Expansion, K: Array) -> Array:
        """(N, nu) gradient by the curve coordinate, once per expansion and regulator."""
        last = self._last
        if last is None or last[0] is not expansion or last[1] is not K:
            last = self._last = (expansion, K, expansion.gradient(K))
        return last[2]

    def refined(self, R: Array, factor: int) -> LBFGS:
        """A direction with this memory on a finer grid of samples.

        A step s is held over the finer samples. The change of the gradient y is an integral over a
        sample, so it is divided among the finer samples.

        Args:
            R: (nu, nu) control metric, multiplied by the finer sample period.
            factor: Number of finer samples in a coarse one.

        Returns:
            The direction on the finer grid.
        """
        pairs = []
        for coarse_s, coarse_y, _ in self._pairs:
            s = np.repeat(coarse_s, factor, axis=0)
            y = np.repeat(coarse_y, factor, axis=0) / factor
            pairs.append((s, y, float(np.vdot(s, y))))

        return LBFGS(R, self.memory, tuple(pairs))

    def reset(self) -> bool:
        """Clear the memory.

        Returns:
            True if there was something to clear.
        """
        had_pairs = bool(self._pairs)
        self._pairs = ()
        return had_pairs
