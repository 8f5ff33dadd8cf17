"""Draws from a normal distribution of several variables inside bounds.

Bounds of single variables may be joined by matrices that depend linearly on the variables and have
to be positive definite, as pseudo-inertias have. The region inside all of them is convex.

The draws are made by Gibbs sampling (Robert, Simulation of truncated normal variables, Statistics
and Computing, 1995) in coordinates in which the untruncated distribution is standard normal. There,
correlations slow nothing down, and without a bound in reach each sweep is an independent draw.
Every draw is the end of a chain of its own, so that the draws are independent of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array

# Bounds farther from the mean than this are left out [standard deviations]; the probability beyond
# them is 1e-15.
REACH = 8.0

# Sweeps of a chain over all coordinates.
SWEEPS = 200

# Many chains with many matrices take fewer sweeps, so that about this number of matrices is
# factorised. The fewest sweeps are made in any case, because a chain has to forget its begin. They
# may exceed the number: 1000 draws of the whole inertias of seven bodies, with 76 coordinates, take
# 26.6 million matrices.
MAX_FACTORISED = 10_000_000
MIN_SWEEPS = 50

# Share of the way to a matrix that is not positive definite that one move may go.
INSIDE = 1.0 - 1e-6

# Eigenvalues of the correlation matrix below this share of the largest one count as zero.
RANK_TOLERANCE = 1e-12

# Coefficients of a bound below this share of the largest one do not limit a coordinate.
SMALLEST_COEFFICIENT = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class MatrixBound:
    """A symmetric matrix that is positive definite inside the bound.

    Attributes:
        at_mean: (d, d) the matrix at the mean of the distribution, positive definite.
        slopes: (p, d, d) its derivatives by the variables.
    """

    at_mean: Array
    slopes: Array


def draw_truncated_normal(
    mean: Array,
    covariance: Array,
    lower: Array,
    upper: Array,
    count: int,
    rng: np.random.Generator,
    *,
    matrices: Sequence[MatrixBound] = (),
) -> Array:
    """Draw from a normal distribution that is truncated at bounds.

    Args:
        mean: (p,) mean of the untruncated distribution, inside the bounds or on them.
        covariance: (p, p) covariance of the untruncated distribution; it may be singular.
        lower: (p,) lower bounds; may be infinite.
        upper: (p,) upper bounds; may be infinite.
        count: Number of draws n.
        rng: Source of random numbers.
        matrices: Matrices that are positive definite inside the bounds; default: none.

    Returns:
        (n, p) draws inside the bounds.
    """
    factor = _factor(covariance)
    bounds = _Bounds.near(mean, factor, lower, upper)
    cones = [_Cone.of(matrix, factor) for matrix in matrices]
    if not len(bounds.distance) and not cones:
        z = rng.standard_normal((count, factor.shape[1]))
    else:
        z = np.zeros((count, factor.shape[1]))
        for _ in range(_sweeps(z.size * len(cones))):
            _sweep(z, bounds, cones, rng)

    # Rounding may exceed a bound.
    return np.asarray(np.clip(mean + z @ factor.T, lower, upper))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Bounds:
    """The m bounds that draws can reach, as `normals @ z <= distance`.

    Attributes:
        normals: (m, k) coefficients of the k coordinates z.
        distance: (m,) distances from the mean, not negative.
    """

    normals: Array
    distance: Array

    @staticmethod
    def near(mean: Array, factor: Array, lower: Array, upper: Array) -> _Bounds:
        """The bounds within reach. All are in standard deviations of their variable.

        Args:
            mean: (p,) mean.
            factor: (p, k) factor of the covariance.
            lower: (p,) lower bounds.
            upper: (p,) upper bounds.
        """
        std = np.linalg.norm(factor, axis=1)
        moves = std > 0.0
        scale = np.where(moves, std, 1.0)
        unit = factor / scale[:, None]

        above = (upper - mean) / scale
        below = (mean - lower) / scale
        is_above, is_below = moves & (above < REACH), moves & (below < REACH)
        return _Bounds(
            normals=np.concatenate([unit[is_above], -unit[is_below]]),
            distance=np.concatenate([above[is_above], below[is_below]]),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Cone:
    """Where a matrix is positive definite, in the k coordinates z.

    Attributes:
        slopes: (k, d, d) derivatives of the matrix by the coordinates, in a basis in which it is
            the unit matrix at z = 0. This removes the units of its rows and columns.
    """

    slopes: Array

    @staticmethod
    def of(matrix: MatrixBound, factor: Array) -> _Cone:
        """The bound in the coordinates z.

        Args:
            matrix: The bound in the variables.
            factor: (p, k) factor of the covariance.
        """
        inverse = np.linalg.inv(np.linalg.cholesky(matrix.at_mean))
        slopes = np.tensordot(factor.T, matrix.slopes, axes=1)
        return _Cone(slopes=inverse @ slopes @ inverse.T)

    def at(self, z: Array) -> Array:
        """(n, d, d) matrices at (n, k) points."""
        return np.asarray(np.eye(self.slopes.shape[1]) + np.tensordot(z, self.slopes, axes=1))

    def room(self, matrices: Array, i: int) -> tuple[Array, Array]:
        """(n,) moves down, not positive, and up, not negative, that one coordinate may make.

        Args:
            matrices: (n, d, d) matrices at the present points.
            i: Index of the coordinate.
        """
        inverse = np.linalg.inv(np.linalg.cholesky(matrices))
        eigenvalues = np.linalg.eigvalsh(inverse @ self.slopes[i] @ inverse.transpose(0, 2, 1))
        with np.errstate(divide="ignore"):
            down = -INSIDE / np.maximum(eigenvalues[:, -1], 0.0)
            up = INSIDE / np.maximum(-eigenvalues[:, 0], 0.0)
        return down, up


def _sweeps(matrices: int) -> int:
    """Number of sweeps, `MIN_SWEEPS` or more, each of which factorises a number of matrices."""
    return int(np.clip(MAX_FACTORISED // max(matrices, 1), MIN_SWEEPS, SWEEPS))


def _factor(covariance: Array) -> Array:
    """(p, k) factor A of a covariance `A A'` of rank k."""
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))

    is_positive = eigenvalues > RANK_TOLERANCE * eigenvalues.max(initial=0.0)
    root = np.sqrt(eigenvalues[is_positive])
    return np.asarray(scale[:, None] * vectors[:, is_positive] * root)


def _sweep(z: Array, bounds: _Bounds, cones: Sequence[_Cone], rng: np.random.Generator) -> None:
    """Draw every coordinate anew, given the others.

    Args:
        z: (n, k) present points of the chains, which are changed in place.
        bounds: The bounds of single variables.
        cones: The bounds by matrices.
        rng: Source of random numbers.
    """
    distance = bounds.distance - z @ bounds.normals.T
    matrices = [cone.at(z) for cone in cones]
    for i in range(z.shape[1]):
        g = bounds.normals[:, i]
        room = distance + z[:, i : i + 1] * g

        # The present value is inside the bounds but for rounding.
        rises, falls = g > SMALLEST_COEFFICIENT, g < -SMALLEST_COEFFICIENT
        high = np.min(room[:, rises] / g[rises], axis=1, initial=np.inf)
        low = np.max(room[:, falls] / g[falls], axis=1, initial=-np.inf)
        high, low = np.maximum(high, z[:, i]), np.minimum(low, z[:, i])
        for cone, at in zip(cones, matrices, strict=True):
            down, up = cone.room(at, i)
            low, high = np.maximum(low, z[:, i] + down), np.minimum(high, z[:, i] + up)

        before = np.array(z[:, i])
        z[:, i] = _draw_between(low, high, rng)
        for cone, at in zip(cones, matrices, strict=True):
            at += (z[:, i] - before)[:, None, None] * cone.slopes[i]
        distance = room - z[:, i : i + 1] * g


def _draw_between(low: Array, high: Array, rng: np.random.Generator) -> Array:
    """(n,) draws from the standard normal distribution between bounds: (n,) each."""
    # The distribution function has all digits in the lower tail only, so that intervals in the
    # upper half are mirrored.
    is_mirrored = high > -low
    begin = np.where(is_mirrored, -high, low)
    end = np.where(is_mirrored, -low, high)

    p_begin, p_end = scipy.special.ndtr(begin), scipy.special.ndtr(end)
    u = rng.random(len(low))
    drawn = np.clip(scipy.special.ndtri(p_begin + u * (p_end - p_begin)), begin, end)
    return np.asarray(np.where(is_mirrored, -drawn, drawn))
