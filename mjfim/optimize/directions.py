"""Descent directions: metric descent and limited-memory BFGS, and structured BFGS under limits.

The two-loop recursion of limited-memory BFGS is algorithm 7.4 of Nocedal & Wright, Numerical
Optimization. Under hard limits, the Hessian of the barrier is the Gauss-Newton one, and the
curvature of the remaining cost is estimated by BFGS.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.optimize.cost_models import BarrierExpansion
from mjfim.optimize.lq import (
    CurveCoordinates,
    RiccatiSolution,
    TangentCurve,
    Weights,
    products_at_samples,
)
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


class PairMemory:
    """Pairs of changes of iterates and gradients, which a direction remembers."""

    _pairs: tuple[Any, ...]

    def reset(self) -> bool:
        """Clear the memory.

        Returns:
            True if there was something to clear.
        """
        had_pairs = bool(self._pairs)
        self._pairs = ()
        return had_pairs


@dataclass
class LBFGS(PairMemory):
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


# ---- direction under hard limits

# Smallest curvature of a pair that is used, relative to the norms of the step and of the change of
# the gradient.
MIN_CURVATURE_INSIDE = 1e-8

# Smallest positive damping, in units of mu.
MIN_DAMPING = 1e-4

# Largest number of dampings that are tried for one step.
MAX_DAMPED_TRIALS = 5

# The damping is multiplied by this gain times the ratio of the step's length to the trusted length,
# within the limits below.
DAMPING_GAIN = 1.5

# Smallest and largest factor by which the damping rises after a step that is too long.
RAISE_LIMITS = (2.0, 10.0)

# Smallest and largest factor by which the damping falls after a step that was taken.
LOWER_LIMITS = (0.1, 1.0)

# Fraction of a step above which the step counts as taken, so that the damping falls.
MIN_TAKEN_FRACTION = 0.3

# Predicted decrease above which a shortened step raises the damping. With a smaller one, short
# damped steps would look like convergence.
SIGNIFICANT_DECREASE = 0.01

# Largest number of models, one after the other, with the curvature of the barrier along the minimum
# of the model before.
MAX_BENT_MODELS = 6

# Growth of the curvature of any limit along the minimum of a model from which on the next model
# takes the curvature along it.
SIGNIFICANT_GROWTH = 1.3

# Fraction of a step below which the line search has shortened it much.
MUCH_SHORTENED = 0.5

# Smallest squared norm of a step in a denominator.
SMALLEST_SQUARE = 1e-300


# Product of a matrix with coordinates of a step, or with m of them: of the same shape.
Product = Callable[[Array], Array]

# Products of the matrix of a metric, and of its inverse, with coordinates.
Metric = tuple[Product, Product]


def metric_of_curves(coordinates: CurveCoordinates, weights: Weights) -> Metric:
    """Metric on (N, nu) curve coordinates: a quadratic form on the curves to which they lift.

    Args:
        coordinates: Curve coordinates of the trajectory.
        weights: Quadratic form on tangent curves, positive on the controls.
    """

    def apply(s: Array) -> Array:
        a, b = weights.half_gradient(coordinates.lift(s))
        return coordinates.gradient(a, b)

    def solve(g: Array) -> Array:
        # The Riccati equations invert the metric.
        A, B, K = coordinates.A, coordinates.B, coordinates.K
        *m, N, _ = g.shape
        a = np.zeros((*m, N + 1, K.shape[2]))
        a[..., :-1, :] = -products_at_samples(K.swapaxes(1, 2), g)
        return coordinates.coordinate(RiccatiSolution.solve(A, B, weights).descent(a, -g))

    return apply, solve


def metric_of_matrix(H: Array) -> Metric:
    """Metric on (M, nu) coefficients by a symmetric positive definite matrix: (M nu, M nu)."""

    def apply(s: Array) -> Array:
        return (s.reshape(-1, len(H)) @ H).reshape(s.shape)

    def solve(g: Array) -> Array:
        factor = scipy.linalg.cho_factor(H, lower=True)
        columns = g.reshape(-1, len(H)).T
        return np.asarray(scipy.linalg.cho_solve(factor, columns).T.reshape(g.shape))

    return apply, solve


def basis_response(expansion: Expansion, basis: Array) -> Array:
    """Change of the state by the coefficients of a basis of controls; all controls share the basis.

    The linearised dynamics are followed for every basis function and control.

    Args:
        expansion: Expansion at a trajectory.
        basis: (N, M) basis functions.

    Returns:
        (N+1, nx, M nu) derivative of the state by the coefficients.
    """
    N, nx, _ = expansion.B.shape
    inputs = np.einsum("km,kiu->kimu", basis, expansion.B).reshape(N, nx, -1)
    z = np.zeros((N + 1, *inputs.shape[1:]))
    for k in range(N):
        z[k + 1] = expansion.A[k] @ z[k] + inputs[k]
    return z


def basis_matrix(basis: Array, response: Array, weights: Weights) -> Array:
    """Matrix of a quadratic form on the coefficients of a basis of controls.

    Args:
        basis: (N, M) basis functions.
        response: (N+1, nx, M nu) derivative of the state by the coefficients.
        weights: Quadratic form on tangent curves.

    Returns:
        (M nu, M nu) symmetric matrix.

    Raises:
        numpy.linalg.LinAlgError: The linearised motion is too unstable.
    """
    N, nu, nx = weights.S.shape
    M = basis.shape[1]

    # Terms with the state: z'Qz + 2 v'Sz. They overflow where the linearised motion explodes.
    with np.errstate(over="ignore", invalid="ignore"):
        Qz = (weights.Q @ response).reshape(-1, M * nu)
        coupling = np.einsum("km,kui->kimu", basis, weights.S)
        Qz[: N * nx] += 2.0 * coupling.reshape(N * nx, M * nu)
        H = Qz.T @ response.reshape(-1, M * nu)
    if not np.isfinite(H).all():
        raise np.linalg.LinAlgError("the linearised motion is too unstable for a direction")

    # Terms with the control: v'Rv.
    products = np.einsum("km,kn->kmn", basis, basis).reshape(N, -1)
    control = (products.T @ weights.R.reshape(N, -1)).reshape(M, M, nu, nu)

    # Terms with the changes of the control.
    steps = np.diff(basis, axis=0, prepend=0.0, append=0.0)
    for u in range(nu):
        control[:, :, u, u] += steps.T @ (weights.W[:, u, None] * steps)

    return np.asarray(0.5 * (H + H.T) + control.swapaxes(1, 2).reshape(M * nu, M * nu))


@record
class _LocalModel:
    """Gradients and metrics at a point.

    Coordinates are (N, nu) curve coordinates, or (M, nu) coefficients of a basis of controls.

    Attributes:
        expansion: Expansion at the point.
        barrier: Its barrier.
        coordinates: Curve coordinates of its trajectory.
        weights: The barrier's Gauss-Newton Hessian and the ridge, as a form on tangent curves.
        gradient: Gradient of cost and barrier.
        cost_gradient: Gradient of the cost without the barrier.
        eigenvalue_slopes: (m, ...) gradients of the coordinates of the eigenvalue model; m is 0
            without such a model.
        basis: (N, M) basis of the controls, or None.
    """

    expansion: Expansion
    barrier: BarrierExpansion
    coordinates: CurveCoordinates
    weights: Weights
    gradient: Array
    cost_gradient: Array
    eigenvalue_slopes: Array
    basis: Array | None

    def metric(self, damping: float) -> Metric:
        """Metric of the weights plus a multiple of the uniform weights.

        Args:
            damping: Factor of the uniform weights.

        Returns:
            The metric in these coordinates.
        """
        if self.basis is None:
            weights = self.weights
            if damping > 0.0:
                weights = weights.plus(self.barrier.uniform_weights, damping)
            return metric_of_curves(self.coordinates, weights)

        H, uniform_H = self._matrices
        if damping > 0.0:
            H = H + damping * uniform_H
        return metric_of_matrix(H)

    @cached_property
    def _matrices(self) -> tuple[Array, Array]:
        """(M nu, M nu) matrices of the weights and of the uniform weights on the coefficients."""
        assert self.basis is not None
        response = basis_response(self.expansion, self.basis)
        return (
            basis_matrix(self.basis, response, self.weights),
            basis_matrix(self.basis, response, self.barrier.uniform_weights),
        )

    def predicted_change(self, s: Array) -> Array:
        """Change of the cost's gradient along a step s that the eigenvalue model predicts.

        Args:
            s: (N, nu) or (M, nu) step in these coordinates.

        Returns:
            Change of the gradient, shaped like s; zero without an eigenvalue model.
        """
        model = self.expansion.eigenvalue_model
        if model is None:
            return np.zeros_like(s)

        d = np.tensordot(self.eigenvalue_slopes, s, axes=s.ndim)
        change = model.gradient(d) - model.gradient(np.zeros_like(d))
        return np.tensordot(change, self.eigenvalue_slopes, axes=1)


@dataclass
class StructuredBFGS(PairMemory):
    """Quasi-Newton direction with a structured Hessian.

    The Hessian is the sum of the barrier's Gauss-Newton Hessian, the Hessian of the eigenvalue
    model, and a BFGS approximation of the remainder. The first two are computed at every point. The
    curvature pairs contain the remainder only, so that they stay valid for a sharper barrier.

    Steps that are too long are damped by `BarrierExpansion.uniform_weights` (Levenberg &
    Marquardt). This shortens directions with little curvature, but not the step back inside the
    limits, where the barrier's curvature is large.

    Where the line search shortens a step much, the barrier's curvature changes too much along it.
    The next directions then follow this change: the minimum of the model is found again with the
    curvature along the minimum before, which costs no simulation.

    A curvature pair is a step of the curve coordinate, or of the coefficients of a basis, and the
    change of the cost's gradient along it that the model did not predict; the barrier of the limits
    is not included.

    Attributes:
        ridge: (nu,) weight of the control at every sample, which keeps the metric positive.
        basis: (N, M) basis of the controls, or None where the controls are free.
        memory: Largest number of stored pairs.
        reach: Trusted length of a step: largest change of any limited quantity, over half of its
            range.
        damping: Factor of the uniform weights in the next step, in units of mu.
        is_bent: Whether the next step uses the curvature of the barrier along the step.
    """

    ridge: Array
    basis: Array | None = None
    memory: int = 30
    reach: float = 0.5
    damping: float = 0.0
    is_bent: bool = False
    _pairs: tuple[tuple[Array, Array], ...] = ()
    _last: _LocalModel | None = field(default=None, repr=False)
    _proposed: TangentCurve | None = field(default=None, repr=False)

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        """The direction, damped until no limited quantity changes too much.

        Args:
            expansion: Expansion of cost and barrier.
            K: (N, nu, nx) gain of the projection operator.

        Returns:
            The direction.

        Raises:
            ValueError: The expansion has no barrier.
        """
        here = self._local_model(expansion, K)
        zeta, relative_length = self._damped_curve(here)
        if self.is_bent:
            here, zeta, relative_length = self._bent(here, zeta, relative_length)

        for _ in range(MAX_DAMPED_TRIALS - 1):
            if relative_length <= 1.0:
                break
            factor = float(np.clip(DAMPING_GAIN * relative_length, *RAISE_LIMITS))
            self.damping = max(self.damping, MIN_DAMPING) * factor
            zeta, relative_length = self._damped_curve(here)

        # A step that is still too long after all trials of the damping is scaled down.
        fraction = 1.0 / max(relative_length, 1.0)
        self._proposed = TangentCurve(z=fraction * zeta.z, v=fraction * zeta.v)
        return self._proposed

    def _bent(
        self, here: _LocalModel, zeta: TangentCurve, relative_length: float
    ) -> tuple[_LocalModel, TangentCurve, float]:
        """Minimum of the model with the curvature of the barrier along the step itself.

        Args:
            here: The model with the curvature at its point.
            zeta: Tangent curve of its minimum.
            relative_length: Length of this over the trusted length.

        Returns:
            The model with the last curvature, its minimum, and the length of that.
        """
        curvature = here.barrier.curvature
        if curvature is None:
            return here, zeta, relative_length

        factors: tuple[Array, ...] | None = None
        for _ in range(MAX_BENT_MODELS):
            weights, factors, growth = curvature(zeta, factors)
            if growth < SIGNIFICANT_GROWTH:
                break
            weights = weights.scaled(here.barrier.mu)
            here = replace(here, weights=self._with_ridge(weights))
            zeta, relative_length = self._damped_curve(here)

        return here, zeta, relative_length

    def _with_ridge(self, form: Weights) -> Weights:
        """Weights of the barrier plus those of the ridge."""
        return replace(form, R=form.R + np.diag(self.ridge))

    def _damped_curve(self, here: _LocalModel) -> tuple[TangentCurve, float]:
        """Tangent curve of the model's minimum, and its length over the trusted length."""
        step = self._step(here)
        c = step if self.basis is None else self.basis @ step
        zeta = here.coordinates.lift(c)
        return zeta, here.barrier.largest_relative_move(zeta) / self.reach

    def _step(self, here: _LocalModel) -> Array:
        """Minimum of the model, in its coordinates, with the present damping."""
        # Product of the inverse Hessian of metric and stored pairs with a vector.
        apply, solve = here.metric(self.damping)
        pairs: list[CurvaturePair] = []
        if self._pairs:
            s, y = (np.stack(each) for each in zip(*self._pairs, strict=True))
            pairs = convex_pairs(s, y + apply(s), MIN_CURVATURE_INSIDE)
        inverse = partial(inverse_hessian_product, pairs=pairs, initial=solve)

        model = here.expansion.eigenvalue_model
        if model is None:
            return -inverse(here.gradient)

        # Step without the eigenvalue model.
        slopes = here.eigenvalue_slopes
        m = len(slopes)
        model_gradient = np.tensordot(model.gradient(np.zeros(m)), slopes, axes=1)
        found = inverse(np.concatenate([(here.gradient - model_gradient)[None], slopes]))
        step = -found[0]

        # The model depends on the step through m numbers d only. Solve for these numbers, then
        # correct the step.
        responses = found[1:]
        flat = slopes.reshape(m, -1)
        d = flat @ step.reshape(-1)
        spread = flat @ responses.reshape(m, -1).T
        w = model.minimising_gradient(d, 0.5 * (spread + spread.T))
        return np.asarray(step - np.tensordot(w, responses, axes=1))

    def accept(self, expansion: Expansion, K: Array, moved: TangentCurve) -> None:
        """Adapt damping and curvature to an accepted step, and store a curvature pair.

        Args:
            expansion: Expansion at the new point.
            K: (N, nu, nx) gain of the projection operator.
            moved: Difference between the new and the old point.
        """
        before = self._last
        proposed = self._proposed
        if before is None or proposed is None:
            return

        # The curvature along the step is tried after a step that was much too long, and given up
        # after one that was too long in spite of it.
        square = max(float(np.vdot(proposed.v, proposed.v)), SMALLEST_SQUARE)
        taken_fraction = float(np.vdot(proposed.v, moved.v)) / square
        if taken_fraction < MUCH_SHORTENED and before.barrier.curvature is not None:
            self.is_bent = not self.is_bent

        # The damping falls after a step that was taken, and rises after a shortened one.
        if taken_fraction > MIN_TAKEN_FRACTION:
            relative_length = before.barrier.largest_relative_move(proposed) / self.reach
            factor = float(np.clip(DAMPING_GAIN * relative_length, *LOWER_LIMITS))
            self.damping = self.damping * factor if self.damping > MIN_DAMPING else 0.0
        elif before.expansion.slope(proposed) < -SIGNIFICANT_DECREASE:
            self.damping = RAISE_LIMITS[0] * max(self.damping, MIN_DAMPING)

        after = self._local_model(expansion, K)
        s = after.coordinates.coordinate(moved)
        if self.basis is not None:
            s = np.asarray(np.linalg.lstsq(self.basis, s)[0], dtype=np.float64)

        y = after.cost_gradient - before.cost_gradient - before.predicted_change(s)
        self._pairs = (*self._pairs, (s, y))[-self.memory :]

    def _local_model(self, expansion: Expansion, K: Array) -> _LocalModel:
        """Gradients and weights at an expansion, computed once per expansion and regulator."""
        last = self._last
        if last is not None and last.expansion is expansion and last.coordinates.K is K:
            return last

        barrier = expansion.barrier
        if barrier is None:
            raise ValueError("a direction under hard limits needs their expansion")
        coordinates = expansion.coordinates(K)

        # Gradients of the sum, of the cost alone, and of the coordinates of the eigenvalue model.
        a = [expansion.a[None], (expansion.a - barrier.a)[None]]
        b = [expansion.b[None], (expansion.b - barrier.b)[None]]
        model = expansion.eigenvalue_model
        if model is not None:
            a.append(model.a)
            b.append(model.b)
        gradients = coordinates.gradient(np.concatenate(a), np.concatenate(b))
        if self.basis is not None:
            gradients = self.basis.T @ gradients

        self._last = _LocalModel(
            expansion=expansion,
            barrier=barrier,
            coordinates=coordinates,
            weights=self._with_ridge(barrier.weights),
            gradient=gradients[0],
            cost_gradient=gradients[1],
            eigenvalue_slopes=gradients[2:],
            basis=self.basis,
        )
        return self._last
