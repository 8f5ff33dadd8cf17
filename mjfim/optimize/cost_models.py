"""Models of parts of the cost that hold for longer steps than a linear one.

The relaxed logarithmic barrier of numbers between bounds (Hauser & Saccon 2006) is

    beta(s) = -log s                                           for s > delta
              1/2 [((s - 2 delta) / delta)^2 - 1] - log delta  else

The relative distance s to a bound is the distance over half of the range; in the middle of the
range, s is 1 and beta is 0. The barrier is twice differentiable, and it is defined outside the
bounds, so that a descent may begin there.

The model of the smooth E-criterion includes the interaction of close eigenvalues. With the r
smallest eigenvalues Lambda and their eigenvectors w_i, a step s changes the information by
`B_ij = d(w_i' I w_j).s`, also off the diagonal. The model assumes that `log I` is linear in s:

    h(s) = 1/q log tr exp(-q (log Lambda + B(s))).

It is exact to first order and convex. Its curvature is large where eigenvalues meet, like that of
the criterion. Larger eigenvalues are left out. If the model held them constant, it would stop a
step where the smallest eigenvalues reach them, although the larger ones change as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, cached_property

import numpy as np

from mjfim.arrays import Array, record
from mjfim.optimize.lq import TangentCurve, Weights

# Smallest and largest factor of the curvature of the barrier in the model of a step.
MIN_FACTOR = 0.05
MAX_FACTOR = 1e4

# Change of a distance to a bound, relative to the distance, below which the curvature is constant.
SHORT_STEP = 1e-6

# Weight of off-diagonal entries in the coordinates of a symmetric matrix; these entries count twice
# in the scalar product of matrices.
SQRT_2 = np.sqrt(2.0)

# Largest number of Newton steps of the proximal problem.
MAX_NEWTON_STEPS = 50

# Gradient of the proximal problem, relative to its solution, below which it is solved.
NEWTON_TOLERANCE = 1e-10

# Smallest accepted share of the predicted decrease of a Newton step (Armijo's rule).
SUFFICIENT_DECREASE = 1e-4

# Shortest fraction of a Newton step.
MIN_NEWTON_FRACTION = 1e-8

# Relative distance of two eigenvalues below which their divided difference is the derivative.
EQUAL_EIGENVALUES = 1e-6


# Sum of the barrier over all numbers, or over all norms of vectors; its (..., w) slope by each;
# its (..., w) curvature by each number, or (..., w, w) by the components of each vector.
BarrierDerivatives = tuple[float, Array, Array]


def relaxed_log_barrier(s: Array, delta: float) -> tuple[Array, Array, Array]:
    """Relaxed logarithmic barrier beta(s) with its derivatives.

    Args:
        s: (...) relative distances to the bound, negative outside.
        delta: Distance below which a parabola replaces the logarithm.

    Returns:
        (...) beta, its first and its second derivative.
    """
    inside = s > delta
    safe = np.where(inside, s, 1.0)
    parabola = (s - 2.0 * delta) / delta

    value = np.where(inside, -np.log(safe), 0.5 * (parabola**2 - 1.0) - np.log(delta))
    first = np.where(inside, -1.0 / safe, parabola / delta)
    second = np.where(inside, safe**-2.0, delta**-2.0)
    return value, first, second


def curvature_factors(slacks: Array, changes: Array, factors: Array, delta: float) -> Array:
    """Factors by which the curvature of the barrier changes along a step.

    A quadratic model with the curvature of the barrier at the beginning of a step is wrong where a
    distance s to a bound changes by a large part: it takes the distance across the bound, or stops
    it early on the way inside. The wanted curvature is the mean one between s and the distance s+
    at which the barrier has the slope that the model predicts for the end of the step. With the
    logarithm this is the curvature z / s of primal-dual methods, where z is the predicted slope.
    Where such models, each with the curvature along the minimum of the one before, come to rest,
    the minimum is that of the barrier itself, with limits that are linear in the step.

    Args:
        slacks: (...) relative distances s to bounds, infinite without a bound.
        changes: (...) their changes along the minimum of the model.
        factors: (...) factors of the curvature in this model.
        delta: Relative distance below which the barrier is relaxed.

    Returns:
        (...) factors for the next model, 1 without a bound.
    """
    bounded = np.isfinite(slacks)
    s = np.where(bounded, slacks, 1.0)
    ds = np.where(bounded, changes, 0.0)

    # Slope of the barrier that the model predicts; it always pushes inside.
    _, first, second = relaxed_log_barrier(s, delta)
    pushed = np.maximum(-first - factors * second * ds, -MIN_FACTOR * first)

    # Distance at which the barrier has this slope.
    after = np.where(pushed * delta < 1.0, 1.0 / pushed, delta * (2.0 - pushed * delta))

    # Both differences vanish for a short step, where the curvature does not change.
    difference = s - after
    is_short = np.abs(difference) <= SHORT_STEP * np.maximum(np.abs(s), delta)
    mean = (pushed + first) / np.where(is_short, 1.0, difference)
    found = np.where(is_short, 1.0, np.clip(mean / second, MIN_FACTOR, MAX_FACTOR))
    return np.where(bounded, found, 1.0)


@record
class Bounds:
    """Bounds of w numbers.

    Attributes:
        lower: (w,) lower bounds, -inf without one [unit of each number].
        upper: (w,) upper bounds, inf without one [unit of each number].
        scale: (w,) half of each range, which makes distances to the bounds relative [unit of each
            number].
    """

    lower: Array
    upper: Array
    scale: Array

    @staticmethod
    def from_range(lower: Array, upper: Array, size: Array | float = 1.0) -> Bounds:
        """Bounds with half of the range as scale.

        Args:
            lower: (w,) lower bounds, -inf without one.
            upper: (w,) upper bounds, inf without one.
            size: (w,) or one number for all; natural sizes of the numbers.

        Returns:
            Bounds. The scale of one-sided bounds is the magnitude of the bound, at least the
            natural size; without bounds it is the natural size.
        """
        two_sided = np.isfinite(lower) & np.isfinite(upper)
        magnitude = np.where(np.isfinite(lower), np.abs(lower), np.abs(upper))
        one_sided_scale = np.where(np.isfinite(magnitude), np.maximum(magnitude, size), size)

        # inf - inf gives NaN where a number is free; it is not used there.
        with np.errstate(invalid="ignore"):
            half = 0.5 * (upper - lower)

        return Bounds(lower=lower, upper=upper, scale=np.where(two_sided, half, one_sided_scale))

    def tightened(self, fraction: Array | float) -> Bounds:
        """Bounds moved inwards, with the scale kept.

        Args:
            fraction: (w,) or one number for all; how far both bounds move, relative to the scale.

        Returns:
            The narrower bounds.
        """
        return Bounds(
            lower=self.lower + fraction * self.scale,
            upper=self.upper - fraction * self.scale,
            scale=self.scale,
        )

    def margin(self, r: Array) -> Array:
        """Distance to the nearer bound.

        Args:
            r: (..., w) numbers.

        Returns:
            (..., w) distances [unit of each number], negative outside, infinite without a bound.
        """
        return np.minimum(r - self.lower, self.upper - r)

    def relative_position(self, r: Array) -> Array:
        """Position of each number in its range.

        Args:
            r: (..., w) numbers.

        Returns:
            (..., w) positions: -1 at the lower bound, 1 at the upper bound, 0 without bounds.
        """
        from_upper = 1.0 - (self.upper - r) / self.scale
        from_lower = (r - self.lower) / self.scale - 1.0

        one_sided = np.where(np.isfinite(self.lower), from_lower, 0.0)
        return np.where(np.isfinite(self.upper), from_upper, one_sided)

    def slacks(self, r: Array) -> Array:
        """Relative distances to both bounds.

        Args:
            r: (..., w) numbers.

        Returns:
            (2, ..., w) distances to the lower and to the upper bound over the scale, negative
            outside, infinite without a bound.
        """
        return np.stack([r - self.lower, self.upper - r]) / self.scale

    def slack_changes(self, change: Array) -> Array:
        """Changes of the relative distances to both bounds.

        Args:
            change: (..., w) changes of the numbers.

        Returns:
            (2, ..., w) changes, ordered like `slacks`.
        """
        return np.stack([change, -change]) / self.scale

    def narrowing(self, r: Array, delta: float, weight: float) -> Array:
        """Derivative of the barrier by the share of `scale` by which both bounds move inwards.

        Args:
            r: (..., w) numbers.
            delta: Relative distance below which the barrier is relaxed.
            weight: Factor of the barrier of every number.

        Returns:
            (w,) derivatives, summed over all rows of numbers; 0 without a bound.
        """
        first = relaxed_log_barrier(self.slacks(r), delta)[1]
        return np.asarray(-weight * first.sum(axis=tuple(range(first.ndim - 1))))

    def barrier(
        self, r: Array, delta: float, weight: float, factors: Array | None = None
    ) -> BarrierDerivatives:
        """Sum of the barrier of all numbers, with its derivatives.

        Args:
            r: (..., w) numbers.
            delta: Relative distance below which the barrier is relaxed.
            weight: Factor of the barrier of every number.
            factors: (2, ..., w) factors of the curvature that belongs to the lower and to the
                upper bound; default: 1.

        Returns:
            Sum and derivatives of the weighted barrier; zero where a number has no bound.
        """
        value = 0.0
        slope = np.zeros(r.shape)
        curvature = np.zeros(r.shape)

        for side, (sign, bound) in enumerate(((1.0, self.lower), (-1.0, self.upper))):
            bounded = np.isfinite(bound)
            scale = self.scale[bounded]
            distance = sign * (r[..., bounded] - bound[bounded]) / scale

            beta, first, second = relaxed_log_barrier(distance, delta)
            value += weight * float(np.sum(beta))
            slope[..., bounded] += sign * weight * first / scale
            if factors is not None:
                second = second * factors[side][..., bounded]
            curvature[..., bounded] += weight * second / scale**2

        return value, slope, curvature


# Curvature of the barrier along the minimum of a quadratic model, see `curvature_factors`. It takes
# the minimum of the model, and the factors of the curvature in this model by kind of limit; None
# stands for the curvature at the beginning of the step. It returns the Gauss-Newton Hessian with
# the curvature along the step, factors of the curvature at its beginning, and the largest ratio of
# a factor to that in the model that led to the step, at least 1.
Factors = tuple[Array, ...]
StepCurvature = Callable[[TangentCurve, Factors | None], tuple[Weights, Factors, float]]


@record
class BarrierExpansion:
    """Expansion of the barrier of all limits about a trajectory.

    It holds the gradient and the Gauss-Newton Hessian.

    Attributes:
        a: (N+1, nx) derivative by the state at every sample [1 / x-unit].
        b: (N, nu) derivative by the control at every sample [1 / u-unit].
        weights: Gauss-Newton Hessian of the barrier as a quadratic form on tangent curves.
        observations: (N, S, w, nx+nu) derivatives of the w limited quantities at S engine steps of
            every sample by its state and control, over the scale of their bounds.
        control_scale: (nu,) scale of the control [u-unit].
        control_step_scale: (nu,) scale of the control's change from one sample to the next
            [u-unit], infinite without a limit.
        mu: Weight of the barrier in all of these.
        curvature: The curvature along steps of the barrier with the weight 1; None where only that
            at the trajectory is known.
    """

    a: Array
    b: Array
    weights: Weights
    observations: Array
    control_scale: Array
    control_step_scale: Array
    mu: float = 1.0
    curvature: StepCurvature | None = None

    def scaled(self, mu: float) -> BarrierExpansion:
        """Expansion of a multiple of the barrier, with unchanged scales of the limits.

        Args:
            mu: Factor of the barrier.

        Returns:
            The expansion.
        """
        return replace(
            self,
            a=mu * self.a,
            b=mu * self.b,
            weights=self.weights.scaled(mu),
            mu=mu * self.mu,
        )

    def largest_relative_move(self, zeta: TangentCurve) -> float:
        """Largest change of any limited quantity or control along a tangent curve.

        Args:
            zeta: The tangent curve.

        Returns:
            The change, over half of the range of the quantity.
        """
        state_and_control = np.concatenate([zeta.z[:-1], zeta.v], axis=1)
        changes = np.einsum("kswi,ki->ksw", self.observations, state_and_control)
        all_changes = np.append(changes, zeta.v / self.control_scale)
        return float(np.abs(all_changes).max(initial=0.0))

    @cached_property
    def uniform_weights(self) -> Weights:
        """Mean square over time of all relative changes along a tangent curve.

        It equals the barrier's Hessian far from all bounds. Changes of the control from sample to
        sample are included where they are limited.
        """
        N, steps, w, n = self.observations.shape
        nu = len(self.control_scale)
        nx = n - nu

        # Mean over the engine steps of every sample.
        rows = self.observations.reshape(N, steps * w, n)
        H = np.swapaxes(rows, 1, 2) @ rows / (N * steps)

        Q = np.zeros((N + 1, nx, nx))
        Q[:-1] = H[:, :nx, :nx]
        R = H[:, nx:, nx:] + np.diag(self.control_scale**-2.0 / N)
        W = np.where(self.weights.W > 0.0, self.control_step_scale**-2.0 / N, 0.0)
        return Weights(Q=Q, S=H[:, nx:, :nx], R=R, W=W)


@record
class EigenvalueModel:
    """The model about a point, in the m = r (r + 1) / 2 coordinates of B.

    Attributes:
        eigenvalues: (r,) smallest eigenvalues of the information, ascending.
        power: Power q of the smooth E-criterion.
        weight: Weight of the criterion in the cost.
        a: (m, N+1, nx) derivative of each coordinate by the state: of `B_ii`, and of `sqrt(2) B_ij`
            for i < j.
        b: (m, N, nu) derivative of each coordinate by the control.
    """

    eigenvalues: Array
    power: float
    weight: float
    a: Array
    b: Array

    def gradient(self, d: Array) -> Array:
        """Gradient of the model.

        Args:
            d: (m,) coordinates of B.

        Returns:
            (m,) derivative by the coordinates.
        """
        return self._expanded(d)[1]

    def _expanded(self, d: Array) -> tuple[float, Array, Array]:
        """Value up to a constant, gradient (m,) and Hessian (m, m) of the model at d: (m,).

        The derivative of the matrix exponential has divided differences of the exponentials as its
        entries, in the basis of the eigenvectors (Daleckii & Krein).
        """
        before = np.diag(np.log(self.eigenvalues / self.eigenvalues[0]))
        logs, vectors = np.linalg.eigh(before + symmetric_matrix(d, len(before)))
        # The smallest eigenvalue is factored out, so that exponentials neither overflow nor vanish.
        exponentials = np.exp(-self.power * (logs - logs[0]))
        shares = exponentials / exponentials.sum()
        value = np.log(exponentials.sum()) / self.power - logs[0]

        # The divided difference of two shares is the larger one times a factor that is q where the
        # eigenvalues are equal.
        distance = np.abs(logs[:, None] - logs)
        is_equal = self.power * distance < EQUAL_EIGENVALUES
        safe = np.where(is_equal, 1.0, distance)
        factor = np.where(is_equal, self.power, -np.expm1(-self.power * distance) / safe)
        divided = np.maximum(shares[:, None], shares) * factor

        units = vectors.T @ symmetric_units(len(logs)) @ vectors
        curvature = np.einsum("aij,ij,bij->ab", units, divided, units)
        slopes = np.einsum("aii,i->a", units, shares)
        hessian = self.weight * (curvature - self.power * np.outer(slopes, slopes))
        return self.weight * float(value), -self.weight * slopes, hessian

    def minimising_gradient(self, d0: Array, spread: Array) -> Array:
        """Gradient of the model at the minimum of `h(d) + 1/2 (d - d0)' spread^-1 (d - d0)`.

        With the returned gradient w, the minimum is `d = d0 - spread w`. Newton's method is applied
        to y in `d = d0 + L y`, with `L L' = spread`, which also works where spread is singular.

        Args:
            d0: (m,) centre of the proximal term.
            spread: (m, m) positive semidefinite matrix.

        Returns:
            (m,) the gradient w.
        """
        values, vectors = np.linalg.eigh(spread)
        L = vectors * np.sqrt(np.maximum(values, 0.0))

        y = np.zeros(len(d0))
        value, gradient, hessian = self._expanded(d0)
        for _ in range(MAX_NEWTON_STEPS):
            g = y + L.T @ gradient
            if np.abs(g).max() <= NEWTON_TOLERANCE * max(1.0, np.abs(y).max()):
                break

            H = np.eye(len(y)) + L.T @ hessian @ L
            step = -np.linalg.solve(0.5 * (H + H.T), g)

            # The step is halved until the model plus `1/2 |y|^2` falls sufficiently.
            before, slope = value + 0.5 * float(y @ y), float(g @ step)
            fraction = 2.0
            while fraction > 2.0 * MIN_NEWTON_FRACTION:
                fraction *= 0.5
                new = y + fraction * step
                value, gradient, hessian = self._expanded(d0 + L @ new)
                after = value + 0.5 * float(new @ new)
                if after <= before + SUFFICIENT_DECREASE * fraction * slope:
                    break
            y = new

        return gradient


@cache
def symmetric_units(r: int) -> Array:
    """Symmetric matrices whose coordinates are the unit vectors.

    Args:
        r: Size of the matrices.

    Returns:
        (m, r, r) matrices, m = r (r + 1) / 2; the array is shared and cannot be written.
    """
    rows, columns = np.triu_indices(r)
    entries = np.where(rows == columns, 1.0, 1.0 / SQRT_2)

    units = np.zeros((len(rows), r, r))
    each = np.arange(len(rows))
    units[each, rows, columns] = entries
    units[each, columns, rows] = entries
    units.flags.writeable = False
    return units


def symmetric_matrix(d: Array, r: int) -> Array:
    """Symmetric matrix of given coordinates, whose scalar product is that of matrices.

    Args:
        d: (m,) coordinates, m = r (r + 1) / 2.
        r: Size of the matrix.

    Returns:
        (r, r) matrix.
    """
    return (d @ symmetric_units(r).reshape(-1, r * r)).reshape(r, r)


def divided_log_differences(values: Array) -> Array:
    """Divided differences of the logarithm of eigenvalues.

    They turn the change of a matrix into the change of its logarithm.

    Args:
        values: (r,) positive eigenvalues.

    Returns:
        (r, r) `(log a - log b) / (a - b)` of every pair of eigenvalues, 1 / a where they are equal.
    """
    ratio = values[:, None] / values
    equal = np.abs(ratio - 1.0) < EQUAL_EIGENVALUES
    safe = np.where(equal, 2.0, ratio)
    return np.where(equal, 1.0, np.log(safe) / (safe - 1.0)) / values
