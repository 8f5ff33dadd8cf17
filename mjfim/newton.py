"""The descent direction under hard limits: exact curvature of their barrier, learnt curvature of the cost. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mjfim.barrier import Hedge
from mjfim.lq import TangentCurve, Weights, weighted_descent
from mjfim.pronto import Expansion
from mjfim.trajectory import Array

BENT = 1e-8  # relative curvature of a pair that still counts


@dataclass(frozen=True, eq=False)
class Metric:
    """The quadratic form of the barrier's Gauss-Newton Hessian and a ridge, on what the control may do: anything.

    bends: (N, nu) slopes whose squares are known to be in the Hessian as well
    """

    expansion: Expansion
    K: Array
    weights: Weights
    bends: tuple[Array, ...]

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (N, nu), without the bends."""
        e = self.expansion
        a, b = self.weights.force(e.lift(self.K, s))
        return Expansion(e.A, e.B, a, b).gradient(self.K)

    @cached_property
    def _bent(self) -> tuple[Array, Array]:
        """U: (N * nu, r) the bends after the form is undone, and `1 + D'U`."""
        D = np.stack([bend.reshape(-1) for bend in self.bends], axis=1)
        U = np.stack([self._undone(bend).reshape(-1) for bend in self.bends], axis=1)
        return U, np.eye(len(self.bends)) + D.T @ U

    def _undone(self, g: Array) -> Array:
        """What apply undoes, by the Riccati equations."""
        e = self.expansion
        a = np.zeros((len(g) + 1, e.A.shape[1]))
        a[:-1] = -np.einsum("kui,ku->ki", self.K, g)
        zeta = weighted_descent(e.A, e.B, a, -g, self.weights)
        return np.asarray(zeta.v + np.einsum("kui,ki->ku", self.K, zeta.z[:-1]))

    def solve(self, g: Array) -> Array:
        """What the form with its bends undoes."""
        undone = self._undone(g)
        if not self.bends:
            return undone
        U, inner = self._bent
        return np.asarray(undone - (U @ np.linalg.solve(inner, U.T @ g.reshape(-1))).reshape(g.shape))


@dataclass(frozen=True, eq=False)
class BasisMetric:
    """The same on the coefficients of a basis: (N, M), of every control alike; dense.

    H: the form without bends;  factor: Cholesky factor of the form with them
    """

    H: Array
    factor: tuple[Array, bool]

    @staticmethod
    def of(expansion: Expansion, weights: Weights, basis: Array, bends: tuple[Array, ...]) -> BasisMetric:
        """Sums the form over the curves that each coefficient makes. bends: (M, nu) each"""
        A, B = expansion.A, expansion.B
        N, nx, nu = B.shape
        M = basis.shape[1]
        drive = np.einsum("km,uw->kumw", basis, np.eye(nu)).reshape(N, nu, M * nu)
        z, rows = np.zeros((nx, M * nu)), []
        for k in range(N):
            form = np.block([[weights.Q[k], weights.S[k].T], [weights.S[k], weights.R[k]]])
            rows.append(_root(form) @ np.concatenate([z, drive[k]]))
            z = A[k] @ z + B[k] @ drive[k]
        rows.append(_root(weights.Q[N]) @ z)
        stepped = np.diff(drive, axis=0, prepend=0.0, append=0.0)[:N] * np.sqrt(weights.W[:N, :, None])
        rows += [stepped.reshape(N * nu, -1), drive[-1] * np.sqrt(weights.W[N, :, None])]
        X = np.concatenate(rows)
        H = X.T @ X
        D = np.stack([bend.reshape(-1) for bend in bends], axis=1) if bends else np.zeros((len(H), 0))
        return BasisMetric(H, cho_factor(H + D @ D.T, lower=True))

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (M, nu), without the bends."""
        return np.asarray((self.H @ s.reshape(-1)).reshape(s.shape))

    def solve(self, g: Array) -> Array:
        """What the form with its bends undoes."""
        return np.asarray(cho_solve(self.factor, g.reshape(-1)).reshape(g.shape))


def _root(form: Array) -> Array:
    """X with `X'X = form` for a symmetric form that is positive up to round-off; only rows that matter."""
    values, vectors = np.linalg.eigh(form)
    kept = values > 1e-14 * max(values[-1], 0.0)
    return np.asarray(np.sqrt(values[kept])[:, None] * vectors[:, kept].T)


@dataclass(frozen=True, eq=False)
class Learnt:
    """A step s and the change y of the cost's gradient along it, limits left out; both (N, nu) or (M, nu)."""

    s: Array
    y: Array


@dataclass
class StructuredBFGS:
    """BFGS of the cost on top of the Gauss-Newton Hessian of the barrier, which is exact at every point.

    Pairs hold the cost's share alone, so what was learnt outlives a sharper barrier.
    ridge: (nu,) weight of the control at every sample;  basis: (N, M) what controls may do, or None
    reach: largest move of anything limited in one step, over half of its range
    """

    ridge: Array
    basis: Array | None = None
    memory: int = 30
    reach: float = 0.5
    _pairs: tuple[Learnt, ...] = ()
    _last: tuple[Expansion, Array, Array, Metric | BasisMetric] | None = field(default=None, repr=False)

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta = -H DJ by the two-loop recursion, shortened where it would move too far."""
        _, _, metric = self._state(expansion, K)
        q, used = self._coordinates(expansion.gradient(K)), []
        for pair in self._pairs:
            y = pair.y + metric.apply(pair.s)
            curvature = float(np.vdot(pair.s, y))
            if curvature > BENT * np.linalg.norm(pair.s) * np.linalg.norm(y):
                used.append((pair.s, y, curvature))
        alphas = []
        for s, y, curvature in reversed(used):
            alphas.append(np.vdot(s, q) / curvature)
            q = q - alphas[-1] * y
        q = metric.solve(q)
        for (s, y, curvature), alpha in zip(used, reversed(alphas), strict=True):
            q = q + s * (alpha - np.vdot(y, q) / curvature)
        step = -q if self.basis is None else -self.basis @ q
        zeta = expansion.lift(K, step)
        move = self.reach / max(self._hedge(expansion).motion(zeta), self.reach)
        return TangentCurve(move * zeta.z, move * zeta.v)

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Learn from the step that led to this expansion."""
        if self._last is None:
            return
        old = self._last[2]
        s = moved.v + np.einsum("kui,ki->ku", K, moved.z[:-1])
        if self.basis is not None:
            s = np.linalg.lstsq(self.basis, s)[0]
        gradient = self._state(expansion, K)[1]
        self._pairs = (*self._pairs, Learnt(s, gradient - old))[-self.memory :]

    def reset(self) -> bool:
        """Forget all pairs."""
        had = bool(self._pairs)
        self._pairs = ()
        return had

    def _hedge(self, expansion: Expansion) -> Hedge:
        if expansion.hedge is None:
            raise ValueError("a direction under hard limits needs their expansion")
        return expansion.hedge

    def _coordinates(self, g: Array) -> Array:
        return g if self.basis is None else self.basis.T @ g

    def _state(self, expansion: Expansion, K: Array) -> tuple[Expansion, Array, Metric | BasisMetric]:
        """The expansion, the gradient of the cost without limits in the coordinates, and the metric; once per expansion."""
        if self._last is None or self._last[0] is not expansion or self._last[1] is not K:
            hedge = self._hedge(expansion)
            own = Expansion(expansion.A, expansion.B, expansion.a - hedge.a, expansion.b - hedge.b)
            w = hedge.weights
            weights = Weights(w.Q, w.S, w.R + np.diag(self.ridge), w.W)
            basis = self.basis
            slopes = (Expansion(expansion.A, expansion.B, bend.a, bend.b) for bend in expansion.bends)
            bends = tuple(self._coordinates(slope.gradient(K)) for slope in slopes)
            metric: Metric | BasisMetric = Metric(expansion, K, weights, bends)
            if basis is not None:
                metric = BasisMetric.of(expansion, weights, basis, bends)
            self._last = (expansion, K, self._coordinates(own.gradient(K)), metric)
        return self._last[0], self._last[2], self._last[3]
