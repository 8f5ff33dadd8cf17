"""Descent directions of Algorithm 1: the paper's metric descent, its extended form, limited-memory BFGS. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.lq import TangentCurve, descent
from mjfim.optimize.projection_operator import Expansion


@dataclass
class MetricDescent:
    """The paper's direction: minimise `DJ.zeta + 1/2 <zeta, zeta>` over the tangent space (problem 8), no weight on psi.

    Q, terminal: (nx, nx) and R: (nu, nu), already multiplied by dt.
    """

    Q: Array
    R: Array
    terminal: Array

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta by the Riccati equations."""
        return descent(
            expansion.A, expansion.B, expansion.a, expansion.b, self.Q, self.R, self.terminal
        )

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Nothing is learnt."""

    def reset(self) -> bool:
        """Nothing to forget."""
        return False


@dataclass
class ExtendedMetricDescent:
    """Problem (8) as the paper states it: the metric also weighs the psi-part of zeta.

    Q, terminal: (nx(1+p), nx(1+p)) over (x, psi stacked by parameter);  R: (nu, nu), already multiplied by dt
    """

    Q: Array
    R: Array
    terminal: Array

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta by the Riccati equations of the extended system, its psi-part dropped (P recomputes it)."""
        e, nx = expansion.extended, expansion.A.shape[1]
        if e is None:
            raise ValueError(
                "the problem must provide extended expansions for a metric with weight on psi"
            )
        zeta = descent(e.A, e.B, e.a, e.b, self.Q, self.R, self.terminal)
        return TangentCurve(z=zeta.z[:, :nx], v=zeta.v)

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Nothing is learnt."""

    def reset(self) -> bool:
        """Nothing to forget."""
        return False


@dataclass(frozen=True, eq=False)
class Pair:
    """A step s and the change y of the gradient along it, both (N, nu);  curvature: s'y > 0."""

    s: Array
    y: Array
    curvature: float


@dataclass
class LBFGS:
    """Limited-memory BFGS in the curve coordinate `c = u + K x`, where P(xi + gamma zeta) is affine in gamma.

    The inner product is the control metric `v' R v` (R: (nu, nu), multiplied by dt), so that the iteration count does not
    depend on the sample period. Nocedal & Wright, algorithm 7.4.
    """

    R: Array
    memory: int = 40
    _pairs: tuple[Pair, ...] = ()
    _last: tuple[Expansion, Array, Array] | None = None

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta = -H DJ by the two-loop recursion."""
        q, alphas = np.array(self._gradient(expansion, K)), []
        for pair in reversed(self._pairs):
            alphas.append(np.vdot(pair.s, q) / pair.curvature)
            q -= alphas[-1] * pair.y
        q = self._raise(q)
        if self._pairs:
            newest = self._pairs[-1]
            q *= newest.curvature / np.vdot(newest.y, self._raise(newest.y))
        for pair, alpha in zip(self._pairs, reversed(alphas), strict=True):
            q += pair.s * (alpha - np.vdot(pair.y, q) / pair.curvature)
        return expansion.lift(K, -q)

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Store the pair (s, y) if it has positive curvature."""
        if self._last is None:
            return
        old = self._last[2]
        s = moved.v + np.einsum("kui,ki->ku", K, moved.z[:-1])
        y = self._gradient(expansion, K) - old
        curvature = float(np.vdot(s, y))
        if curvature > 1e-10 * np.linalg.norm(s) * np.linalg.norm(y):
            self._pairs = (*self._pairs, Pair(s, y, curvature))[-self.memory :]

    def _gradient(self, expansion: Expansion, K: Array) -> Array:
        """Gradient in the curve coordinate, computed once per expansion and regulator."""
        if self._last is None or self._last[0] is not expansion or self._last[1] is not K:
            self._last = (expansion, K, expansion.gradient(K))
        return self._last[2]

    def _raise(self, g: Array) -> Array:
        """R^-1 g at every sample."""
        return np.asarray(np.linalg.solve(self.R, g.T).T, dtype=np.float64)

    def refined(self, R: Array, factor: int) -> LBFGS:
        """The same memory on a grid that is `factor` times finer: s is held, y (an integral over a sample) is shared out."""
        held = (
            (np.repeat(p.s, factor, axis=0), np.repeat(p.y, factor, axis=0) / factor)
            for p in self._pairs
        )
        return LBFGS(R, self.memory, tuple(Pair(s, y, float(np.vdot(s, y))) for s, y in held))

    def reset(self) -> bool:
        """Drop all pairs."""
        had = bool(self._pairs)
        self._pairs = ()
        return had
