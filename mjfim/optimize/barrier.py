"""The relaxed logarithmic barrier (Hauser & Saccon 2006) on ranges of numbers. Arrays only.

    beta(s) = -log s                                    for s > delta
              1/2 [((s - 2 delta) / delta)^2 - 1] - log delta   else

twice differentiable, and defined outside as well, so that a descent may begin there. s is the distance to a bound over
half of the range: 1 in the middle, where beta is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.lq import TangentCurve, Weights


@dataclass(frozen=True, kw_only=True, eq=False)
class BarrierDerivatives:
    """Barrier of some numbers and its derivatives by them. value: the sum;  slope, curvature: (..., w) first and second"""

    value: float
    slope: Array
    curvature: Array


def relaxed_log_barrier(s: Array, delta: float) -> tuple[Array, Array, Array]:
    """beta and its first two derivatives at s: (...,)."""
    inside = s > delta
    safe = np.where(inside, s, 1.0)
    outside = (s - 2.0 * delta) / delta
    value = np.where(inside, -np.log(safe), 0.5 * (outside**2 - 1.0) - np.log(delta))
    return (
        value,
        np.where(inside, -1.0 / safe, outside / delta),
        np.where(inside, safe**-2.0, delta**-2.0),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Bounds:
    """Ranges of w numbers, infinite where free. lower, upper: (w,);  scale: (w,) half of each range"""

    lower: Array
    upper: Array
    scale: Array

    @staticmethod
    def from_range(lower: Array, upper: Array) -> Bounds:
        """With half of the range as scale; of one-sided ranges, the size of the bound, at least 1."""
        both = np.isfinite(lower) & np.isfinite(upper)
        one = np.maximum(np.where(np.isfinite(lower), np.abs(lower), np.abs(upper)), 1.0)
        with np.errstate(invalid="ignore"):
            half = 0.5 * (upper - lower)
        return Bounds(
            lower=lower,
            upper=upper,
            scale=np.where(both, half, np.where(np.isfinite(one), one, 1.0)),
        )

    def tightened(self, share: Array | float) -> Bounds:
        """Both bounds moved inwards by a share of the scale."""
        return Bounds(
            lower=self.lower + share * self.scale,
            upper=self.upper - share * self.scale,
            scale=self.scale,
        )

    def margin(self, r: Array) -> Array:
        """(..., w) distance to the nearer bound, negative outside, infinite where free."""
        return np.asarray(np.minimum(r - self.lower, self.upper - r))

    def relative_position(self, r: Array) -> Array:
        """(..., w) where in its range each number is: -1 at the lower bound, 1 at the upper one; 0 where free."""
        upper, lower = 1.0 - (self.upper - r) / self.scale, (r - self.lower) / self.scale - 1.0
        both = np.where(
            np.isfinite(self.upper), upper, np.where(np.isfinite(self.lower), lower, 0.0)
        )
        return np.asarray(both)

    def barrier(self, r: Array, delta: float, weight: float) -> BarrierDerivatives:
        """Barrier of the numbers r: (..., w), each times weight."""
        value, slope, curvature = 0.0, np.zeros(r.shape), np.zeros(r.shape)
        for sign, bound in ((1.0, self.lower), (-1.0, self.upper)):
            held = np.isfinite(bound)
            b, first, second = relaxed_log_barrier(
                sign * (r[..., held] - bound[held]) / self.scale[held], delta
            )
            value += weight * float(np.sum(b))
            slope[..., held] += sign * weight * first / self.scale[held]
            curvature[..., held] += weight * second / self.scale[held] ** 2
        return BarrierDerivatives(value=value, slope=slope, curvature=curvature)


@dataclass(frozen=True, kw_only=True, eq=False)
class BarrierExpansion:
    """Expansion of the barrier: its derivatives by x and u along the curve, and its Gauss-Newton Hessian.

    a: (N+1, nx);  b: (N, nu);  observations: (N, looked-at substeps, w, nx+nu) over the scale of what they show
    control_scale: (nu,);  control_step_scale: (nu,) of its change from one sample to the next, infinite where free
    """

    a: Array
    b: Array
    weights: Weights
    observations: Array
    control_scale: Array
    control_step_scale: Array

    def scaled(self, mu: float) -> BarrierExpansion:
        """The same of mu times the barrier."""
        return replace(self, a=mu * self.a, b=mu * self.b, weights=self.weights.scaled(mu))

    def largest_relative_move(self, zeta: TangentCurve) -> float:
        """The largest move along a tangent curve of anything limited, over half of its range."""
        both = np.concatenate([zeta.z[:-1], zeta.v], axis=1)
        moves = np.abs(np.einsum("kswi,ki->ksw", self.observations, both)).max(initial=0.0)
        return float(max(moves, np.abs(zeta.v / self.control_scale).max(initial=0.0)))

    @cached_property
    def uniform_weights(self) -> Weights:
        """The mean square over time of such moves, of the control's changes too: a barrier's Hessian far from all bounds."""
        N, looked, w, n = self.observations.shape
        nu = len(self.control_scale)
        flat = self.observations.reshape(N, looked * w, n)
        H = np.swapaxes(flat, 1, 2) @ flat / (N * looked)
        Q, nx = np.zeros((N + 1, n - nu, n - nu)), n - nu
        Q[:-1] = H[:, :nx, :nx]
        W = np.where(self.weights.W > 0.0, self.control_step_scale**-2.0 / N, 0.0)
        return Weights(
            Q=Q, S=H[:, nx:, :nx], R=H[:, nx:, nx:] + np.diag(self.control_scale**-2.0 / N), W=W
        )
