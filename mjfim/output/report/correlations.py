"""Correlations of estimates from their information or covariance."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.information.marginal import marginal


def correlation_of(information: Array, std: Array) -> Array:
    """Return the correlation matrix of estimates with a given information.

    Args:
        information: (p, p) Fisher information with priors [1 / (theta_i theta_j unit)].
        std: (p,) standard deviations [theta-unit]; not finite where a parameter is not identifiable
            alone.

    Returns:
        (p, p) correlations; NaN in the rows and columns of parameters that are not identifiable
        alone.
    """
    correlation = np.full(information.shape, np.nan)
    alone = np.flatnonzero(np.isfinite(std) & (std > 0.0))
    if not len(alone):
        return correlation

    # Parameters that are not identifiable alone are estimated, too.
    kept = marginal(information, np.zeros_like(information), alone)
    scaled, _ = scaled_to_unit_diagonal(kept)
    try:
        covariance = np.asarray(np.linalg.inv(scaled), dtype=np.float64)
    except np.linalg.LinAlgError:
        return correlation
    correlation[np.ix_(alone, alone)] = correlation_of_covariance(covariance)
    return correlation


def correlation_of_covariance(covariance: Array) -> Array:
    """Return the correlation matrix of a covariance matrix.

    Args:
        covariance: (p, p) covariance.

    Returns:
        (p, p) correlations, -1 to 1; NaN where a variance is not a positive number.
    """
    variances = np.diag(covariance)
    usable = np.isfinite(variances) & (variances > 0.0)
    spread = np.sqrt(np.where(usable, variances, np.nan))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.clip(covariance / np.outer(spread, spread), -1.0, 1.0))
