"""The descent direction under hard limits: exact curvature of their barrier, learnt curvature of the cost. Arrays only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mjfim.barrier import Hedge
from mjfim.lq import TangentCurve, Weights, weighted_descent
from mjfim.pronto import Expansion
from mjfim.trajectory import Array

BENT = 1e-8  # relative curvature of a pair that still counts


@dataclass(frozen=True, eq=False)
class Metric:
    """The quadratic form of the barrier's Gauss-Newton Hessian and a ridge, on what the control may do: anything."""

    expansion: Expansion
    K: Array
    weights: Weights

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (N, nu)."""
        e = self.expansion
        a, b = self.weights.force(e.lift(self.K, s))
        return Expansion(e.A, e.B, a, b).gradient(self.K)

    def solve(self, g: Array) -> Array:
        """What apply undoes, by the Riccati equations."""
        e = self.expansion
        a = np.zeros((len(g) + 1, e.A.shape[1]))
        a[:-1] = -np.einsum("kui,ku->ki", self.K, g)
        zeta = weighted_descent(e.A, e.B, a, -g, self.weights)
        return np.asarray(zeta.v + np.einsum("kui,ki->ku", self.K, zeta.z[:-1]))


@dataclass(frozen=True, eq=False)
class BasisMetric:
    """The same on the coefficients of a basis: (N, M), of every control alike; dense.  factor: Cholesky factor of H"""

    H: Array
    factor: tuple[Array, bool]

    @staticmethod
    def of(expansion: Expansion, weights: Weights, basis: Array) -> BasisMetric:
        """Sums the form over the curves that each coefficient makes."""
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
        return BasisMetric(H, cho_factor(H, lower=True))

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (M, nu)."""
        return np.asarray((self.H @ s.reshape(-1)).reshape(s.shape))

    def solve(self, g: Array) -> Array:
        """What apply undoes."""
        return np.asarray(cho_solve(self.factor, g.reshape(-1)).reshape(g.shape))


def _root(form: Array) -> Array:
    """X with `X'X = form` for a symmetric form that is positive up to round-off; only rows that matter."""
    values, vectors = np.linalg.eigh(form)
    kept = values > 1e-14 * max(values[-1], 0.0)
    return np.asarray(np.sqrt(values[kept])[:, None] * vectors[:, kept].T)


@dataclass(frozen=True, eq=False)
class Learnt:
    """A step s and what its model left out of the change y of the cost's gradient, limits not in it; (N, nu) or (M, nu)."""

    s: Array
    y: Array


@dataclass(frozen=True, eq=False)
class Local:
    """What is known at a point, in the coordinates: (N, nu) controls or (M, nu) coefficients of a basis.

    gradient: of all;  cost: of the cost without limits;  slopes: (m, ...) of the spectral model's coordinates
    """

    expansion: Expansion
    K: Array
    metric: Metric | BasisMetric
    gradient: Array
    cost: Array
    slopes: Array

    def modelled(self, s: Array) -> Array:
        """Gradient of the cost that the model expects after a step s, over that at its start."""
        model = self.expansion.spectral
        if model is None:
            return np.zeros_like(s)
        d = np.tensordot(self.slopes, s, axes=s.ndim)
        return np.asarray(np.tensordot(model.gradient(d) - model.gradient(np.zeros_like(d)), self.slopes, axes=1))


@dataclass
class StructuredBFGS:
    """BFGS of what remains of the cost, on top of the barrier's Gauss-Newton Hessian and the model of the criterion.

    Both are exact at every point; pairs hold the remainder alone, so what was learnt outlives a sharper barrier.
    ridge: (nu,) weight of the control at every sample;  basis: (N, M) what controls may do, or None
    reach: largest move of anything limited in one step, over half of its range
    """

    ridge: Array
    basis: Array | None = None
    memory: int = 30
    reach: float = 0.5
    _pairs: tuple[Learnt, ...] = ()
    _last: Local | None = field(default=None, repr=False)

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta by the two-loop recursion and the model, shortened where it would move too far."""
        here = self._local(expansion, K)
        undo = self._inverse(here.metric)
        model = expansion.spectral
        if model is None:
            step = -undo(here.gradient)
        else:
            m = len(here.slopes)
            rest = here.gradient - np.tensordot(model.gradient(np.zeros(m)), here.slopes, axes=1)
            away = -undo(rest)
            moves = np.stack([undo(slope) for slope in here.slopes])
            flat = here.slopes.reshape(m, -1)
            spread = flat @ moves.reshape(m, -1).T
            w = model.settle(flat @ away.reshape(-1), 0.5 * (spread + spread.T))
            step = away - np.tensordot(w, moves, axes=1)
        zeta = expansion.lift(K, step if self.basis is None else self.basis @ step)
        move = self.reach / max(_hedge(expansion).motion(zeta), self.reach)
        return TangentCurve(move * zeta.z, move * zeta.v)

    def _inverse(self, metric: Metric | BasisMetric) -> Callable[[Array], Array]:
        """What undoes the Hessian of metric and pairs: BFGS, the two-loop recursion."""
        used = []
        for pair in self._pairs:
            y = pair.y + metric.apply(pair.s)
            curvature = float(np.vdot(pair.s, y))
            if curvature > BENT * np.linalg.norm(pair.s) * np.linalg.norm(y):
                used.append((pair.s, y, curvature))

        def undo(g: Array) -> Array:
            q, alphas = g, []
            for s, y, curvature in reversed(used):
                alphas.append(np.vdot(s, q) / curvature)
                q = q - alphas[-1] * y
            q = metric.solve(q)
            for (s, y, curvature), alpha in zip(used, reversed(alphas), strict=True):
                q = q + s * (alpha - np.vdot(y, q) / curvature)
            return q

        return undo

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Learn from the step that led to this expansion what its model left out."""
        before = self._last
        if before is None:
            return
        s = moved.v + np.einsum("kui,ki->ku", K, moved.z[:-1])
        if self.basis is not None:
            s = np.linalg.lstsq(self.basis, s)[0]
        after = self._local(expansion, K)
        self._pairs = (*self._pairs, Learnt(s, after.cost - before.cost - before.modelled(s)))[-self.memory :]

    def reset(self) -> bool:
        """Forget all pairs."""
        had = bool(self._pairs)
        self._pairs = ()
        return had

    def _local(self, expansion: Expansion, K: Array) -> Local:
        """Everything about an expansion, once."""
        if self._last is None or self._last.expansion is not expansion or self._last.K is not K:
            hedge, w = _hedge(expansion), _hedge(expansion).weights
            weights = Weights(w.Q, w.S, w.R + np.diag(self.ridge), w.W)
            metric: Metric | BasisMetric = Metric(expansion, K, weights)
            if self.basis is not None:
                metric = BasisMetric.of(expansion, weights, self.basis)
            forms = [(expansion.a, expansion.b), (expansion.a - hedge.a, expansion.b - hedge.b)]
            if expansion.spectral is not None:
                forms += list(zip(expansion.spectral.a, expansion.spectral.b, strict=True))
            found = [Expansion(expansion.A, expansion.B, a, b).gradient(K) for a, b in forms]
            if self.basis is not None:
                found = [self.basis.T @ g for g in found]
            slopes = np.stack(found[2:]) if len(found) > 2 else np.zeros((0, *found[0].shape))
            self._last = Local(expansion, K, metric, found[0], found[1], slopes)
        return self._last


def _hedge(expansion: Expansion) -> Hedge:
    if expansion.hedge is None:
        raise ValueError("a direction under hard limits needs their expansion")
    return expansion.hedge
