"""Densities and quantiles of distributions, without `scipy.stats`.

That package takes longer to import than all pictures of a result take to draw.
"""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array


def normal_density(x: Array, mean: float = 0.0, std: float = 1.0) -> Array:
    """Return the density of a normal distribution.

    Args:
        x: (n,) places [unit of the quantity].
        mean: Mean.
        std: Standard deviation, positive.

    Returns:
        (n,) densities [1/unit].
    """
    deviations = (x - mean) / std
    return np.asarray(np.exp(-0.5 * deviations**2) / (np.sqrt(2.0 * np.pi) * std))


def chi_squared_quantiles(shares: tuple[float, float], freedom: float) -> tuple[float, float]:
    """Return two quantiles of a chi-squared distribution.

    Args:
        shares: Probabilities that a value lies below each (0..1).
        freedom: Degrees of freedom, positive.
    """
    low, high = 2.0 * scipy.special.gammaincinv(0.5 * freedom, np.array(shares))
    return float(low), float(high)
