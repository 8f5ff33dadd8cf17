"""The descent direction under hard limits: exact curvature of their barrier, learnt curvature of the cost. Arrays only."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from mjfim.arrays import Array
from mjfim.optimize.barrier import BarrierExpansion
from mjfim.optimize.lq import CurveCoordinates, RiccatiSolution, TangentCurve, Weights
from mjfim.optimize.projection_operator import Expansion

BENT = 1e-8  # relative curvature of a pair that still counts
LEAST = 1e-4  # damping that is worth it, in units of mu


TRIES, RAISED, LOWERED = (
    5,
    (2.0, 10.0),
    (0.1, 1.0),
)  # dampings of a step at most, and factors between two of them


AIM = 1.5  # factor of the damping, over how far a step goes
CUT = 0.3  # share of a step that was taken below which the next one is damped more, else less if it did not go far
WORTH = 0.01  # loss that a step promised from which on it is damped for having been cut; less would look like convergence


TINY = 1e-300


@dataclass(frozen=True, eq=False)
class CurveMetric:
    """The quadratic form of the barrier's Gauss-Newton Hessian and a ridge, on what the control may do: anything."""

    chart: CurveCoordinates
    weights: Weights

    @cached_property
    def _factored(self) -> RiccatiSolution:
        return RiccatiSolution.solve(self.chart.A, self.chart.B, self.weights)

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (N, nu)."""
        return self.chart.gradient(*self.weights.half_gradient(self.chart.lift(s)))

    def solve(self, g: Array) -> Array:
        """What apply undoes, by the Riccati equations."""
        K = self.chart.K
        a = np.zeros((len(g) + 1, K.shape[2]))
        a[:-1] = -np.einsum("kui,ku->ki", K, g)
        zeta = self._factored.descent(a, -g)
        return np.asarray(zeta.v + np.einsum("kui,ki->ku", K, zeta.z[:-1]))


@dataclass(frozen=True, eq=False)
class Curves:
    """What each coefficient of a basis: (N, M), of every control alike, does to the state: z (N+1, nx, M nu)."""

    basis: Array
    z: Array

    @staticmethod
    def of(expansion: Expansion, basis: Array) -> Curves:
        """Follow the linear recursion."""
        A, B = expansion.A, expansion.B
        N, nx, _ = B.shape
        drive = np.einsum("km,kiu->kimu", basis, B).reshape(N, nx, -1)
        z = np.zeros((N + 1, *drive.shape[1:]))
        for k in range(N):
            z[k + 1] = A[k] @ z[k] + drive[k]
        return Curves(basis, z)

    def form(self, weights: Weights) -> Array:
        """(M nu, M nu) the quadratic form on the coefficients, summed over the curves that they make."""
        N, nu, nx = weights.S.shape
        M = self.basis.shape[1]
        Qz = (weights.Q @ self.z).reshape(-1, M * nu)
        Qz[: N * nx] += 2.0 * np.einsum("km,kui->kimu", self.basis, weights.S).reshape(
            N * nx, M * nu
        )
        H = Qz.T @ self.z.reshape(-1, M * nu)
        pairs = np.einsum("km,kn->kmn", self.basis, self.basis).reshape(N, -1)
        own = (pairs.T @ weights.R.reshape(N, -1)).reshape(M, M, nu, nu)
        stepped = np.diff(self.basis, axis=0, prepend=0.0, append=0.0)
        for u in range(nu):
            own[:, :, u, u] += stepped.T @ (weights.W[:, u, None] * stepped)
        return np.asarray(0.5 * (H + H.T) + own.swapaxes(1, 2).reshape(M * nu, M * nu))


@dataclass(frozen=True, eq=False)
class BasisMetric:
    """The same on the coefficients of a basis; dense.  H: (M nu, M nu)"""

    H: Array

    @staticmethod
    def of(expansion: Expansion, weights: Weights, basis: Array) -> BasisMetric:
        """Of a form on curves."""
        return BasisMetric(Curves.of(expansion, basis).form(weights))

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky factor."""
        factor, lower = cho_factor(self.H, lower=True)
        return factor, bool(lower)

    def apply(self, s: Array) -> Array:
        """The form's gradient at s: (M, nu)."""
        return np.asarray((self.H @ s.reshape(-1)).reshape(s.shape))

    def solve(self, g: Array) -> Array:
        """What apply undoes."""
        return np.asarray(cho_solve(self.factor, g.reshape(-1)).reshape(g.shape))


@dataclass(frozen=True, eq=False)
class Learnt:
    """A step s and what its model left out of the change y of the cost's gradient, limits not in it; (N, nu) or (M, nu)."""

    s: Array
    y: Array


@dataclass(frozen=True, eq=False)
class Local:
    """What is known at a point, in the coordinates: (N, nu) controls or (M, nu) coefficients of a basis.

    weights: the barrier's Gauss-Newton Hessian and the ridge
    gradient: of all;  cost: of the cost without limits;  slopes: (m, ...) of the spectral model's coordinates
    """

    expansion: Expansion
    chart: CurveCoordinates
    weights: Weights
    gradient: Array
    cost: Array
    slopes: Array
    basis: Array | None

    def metric(self, damping: float) -> CurveMetric | BasisMetric:
        """Of the weights, and a multiple of even ones."""
        even = _barrier(self.expansion).uniform_weights
        if self.basis is None:
            return CurveMetric(
                self.chart, self.weights.plus(even, damping) if damping > 0.0 else self.weights
            )
        form, spread = self._forms
        return BasisMetric(form + damping * spread if damping > 0.0 else form)

    @cached_property
    def _forms(self) -> tuple[Array, Array]:
        """The weights' form and the even one, on the coefficients."""
        if self.basis is None:
            raise ValueError("no basis, no coefficients")
        curves = Curves.of(self.expansion, self.basis)
        return curves.form(self.weights), curves.form(_barrier(self.expansion).uniform_weights)

    def modelled(self, s: Array) -> Array:
        """Gradient of the cost that the model expects after a step s, over that at its start."""
        model = self.expansion.eigenvalue_model
        if model is None:
            return np.zeros_like(s)
        d = np.tensordot(self.slopes, s, axes=s.ndim)
        return np.asarray(
            np.tensordot(model.gradient(d) - model.gradient(np.zeros_like(d)), self.slopes, axes=1)
        )


@dataclass
class StructuredBFGS:
    """BFGS of what remains of the cost, on top of the barrier's Gauss-Newton Hessian and the model of the criterion.

    Both are exact at every point; pairs hold the remainder alone, so what was learnt outlives a sharper barrier.
    Steps that go too far are damped by `uniform_weights` (Levenberg & Marquardt): it shortens what nothing holds, and leaves
    the way back inside as it is.
    ridge: (nu,) weight of the control at every sample;  basis: (N, M) what controls may do, or None
    reach: largest move of anything limited in one step, over half of its range;  damping: of the step to come
    """

    ridge: Array
    basis: Array | None = None
    memory: int = 30
    reach: float = 0.5
    damping: float = 0.0
    _pairs: tuple[Learnt, ...] = ()
    _last: Local | None = field(default=None, repr=False)
    _told: TangentCurve | None = field(default=None, repr=False)

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """zeta by the two-loop recursion and the model, damped until it does not move too far."""
        here, barrier = self._local(expansion, K), _barrier(expansion)
        for left in reversed(range(TRIES)):
            step = self._step(here)
            zeta = here.chart.lift(step if self.basis is None else self.basis @ step)
            far = barrier.largest_relative_move(zeta) / self.reach
            if far <= 1.0 or left == 0:
                break
            self.damping = max(self.damping, LEAST) * float(np.clip(AIM * far, *RAISED))
        move = 1.0 / max(far, 1.0)
        self._told = TangentCurve(z=move * zeta.z, v=move * zeta.v)
        return self._told

    def _step(self, here: Local) -> Array:
        """The model's minimum, in the coordinates."""
        undo = self._inverse(here.metric(self.damping))
        model = here.expansion.eigenvalue_model
        if model is None:
            return -undo(here.gradient)
        m = len(here.slopes)
        rest = here.gradient - np.tensordot(model.gradient(np.zeros(m)), here.slopes, axes=1)
        away = -undo(rest)
        moves = np.stack([undo(slope) for slope in here.slopes])
        flat = here.slopes.reshape(m, -1)
        spread = flat @ moves.reshape(m, -1).T
        w = model.minimising_gradient(flat @ away.reshape(-1), 0.5 * (spread + spread.T))
        return np.asarray(away - np.tensordot(w, moves, axes=1))

    def _inverse(self, metric: CurveMetric | BasisMetric) -> Callable[[Array], Array]:
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
        before, told = self._last, self._told
        if before is None or told is None:
            return
        gamma = float(np.vdot(told.v, moved.v)) / max(float(np.vdot(told.v, told.v)), TINY)
        if gamma > CUT:
            far = _barrier(before.expansion).largest_relative_move(told) / self.reach
            self.damping = (
                self.damping * float(np.clip(AIM * far, *LOWERED)) if self.damping > LEAST else 0.0
            )
        elif before.expansion.slope(told) < -WORTH:
            self.damping = RAISED[0] * max(self.damping, LEAST)
        s = moved.v + np.einsum("kui,ki->ku", K, moved.z[:-1])
        if self.basis is not None:
            s = np.linalg.lstsq(self.basis, s)[0]
        after = self._local(expansion, K)
        self._pairs = (*self._pairs, Learnt(s, after.cost - before.cost - before.modelled(s)))[
            -self.memory :
        ]

    def reset(self) -> bool:
        """Forget all pairs."""
        had = bool(self._pairs)
        self._pairs = ()
        return had

    def _local(self, expansion: Expansion, K: Array) -> Local:
        """Everything about an expansion, once."""
        if (
            self._last is None
            or self._last.expansion is not expansion
            or self._last.chart.K is not K
        ):
            barrier, w = _barrier(expansion), _barrier(expansion).weights
            weights = Weights(Q=w.Q, S=w.S, R=w.R + np.diag(self.ridge), W=w.W)
            chart = CurveCoordinates(A=expansion.A, B=expansion.B, K=K)
            forms = [(expansion.a, expansion.b), (expansion.a - barrier.a, expansion.b - barrier.b)]
            if expansion.eigenvalue_model is not None:
                forms += list(
                    zip(expansion.eigenvalue_model.a, expansion.eigenvalue_model.b, strict=True)
                )
            found = [chart.gradient(a, b) for a, b in forms]
            if self.basis is not None:
                found = [self.basis.T @ g for g in found]
            slopes = np.stack(found[2:]) if len(found) > 2 else np.zeros((0, *found[0].shape))
            self._last = Local(expansion, chart, weights, found[0], found[1], slopes, self.basis)
        return self._last


def _barrier(expansion: Expansion) -> BarrierExpansion:
    if expansion.barrier is None:
        raise ValueError("a direction under hard limits needs their expansion")
    return expansion.barrier
