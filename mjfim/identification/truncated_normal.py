"""Draws from a normal distribution of several variables between bounds.

The draws are made by Gibbs sampling (Robert, Simulation of truncated normal variables, Statistics
and Computing, 1995) in coordinates in which the untruncated distribution is standard normal. There,
correlations slow nothing down, and without a bound in reach each sweep is an independent draw.
Every draw is the end of a chain of its own, so that the draws are independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array

# Bounds farther from the mean than this are left out [standard deviations]; the probability beyond
# them is 1e-15.
REACH = 8.0

# Sweeps of a chain over all coordinates.
SWEEPS = 200

# Eigenvalues of the correlation matrix below this share of the largest one count as zero.
RANK_TOLERANCE = 1e-12

# Coefficients of a bound below this share of the largest one do not limit a coordinate.
SMALLEST_COEFFICIENT = 1e-12


def draw_truncated_normal(
    mean: Array,
    covariance: Array,
    lower: Array,
    upper: Array,
    count: int,
    rng: np.random.Generator,
) -> Array:
    """Draw from a normal distribution that is truncated at bounds.

    Args:
        mean: (p,) mean of the untruncated distribution, inside the bounds or on them.
        covariance: (p, p) covariance of the untruncated distribution; it may be singular.
        lower: (p,) lower bounds; may be infinite.
        upper: (p,) upper bounds; may be infinite.
        count: Number of draws n.
        rng: Source of random numbers.

    Returns:
        (n, p) draws inside the bounds.
    """
    factor = _factor(covariance)
    bounds = _Bounds.near(mean, factor, lower, upper)
    if not len(bounds.distance):
        z = rng.standard_normal((count, factor.shape[1]))
    else:
        z = np.zeros((count, factor.shape[1]))
        for _ in range(SWEEPS):
            _sweep(z, bounds, rng)

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


def _factor(covariance: Array) -> Array:
    """(p, k) factor A of a covariance `A A'` of rank k."""
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))

    is_positive = eigenvalues > RANK_TOLERANCE * eigenvalues.max(initial=0.0)
    root = np.sqrt(eigenvalues[is_positive])
    return np.asarray(scale[:, None] * vectors[:, is_positive] * root)


def _sweep(z: Array, bounds: _Bounds, rng: np.random.Generator) -> None:
    """Draw every coordinate anew, given the others.

    Args:
        z: (n, k) present points of the chains, which are changed in place.
        bounds: The bounds.
        rng: Source of random numbers.
    """
    distance = bounds.distance - z @ bounds.normals.T
    for i in range(z.shape[1]):
        g = bounds.normals[:, i]
        room = distance + z[:, i : i + 1] * g

        # The present value is inside the bounds but for rounding.
        rises, falls = g > SMALLEST_COEFFICIENT, g < -SMALLEST_COEFFICIENT
        high = np.min(room[:, rises] / g[rises], axis=1, initial=np.inf)
        low = np.max(room[:, falls] / g[falls], axis=1, initial=-np.inf)
        high, low = np.maximum(high, z[:, i]), np.minimum(low, z[:, i])

        z[:, i] = _draw_between(low, high, rng)
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
