"""Marginal information by the Schur complement of nuisance parameters, and standard deviations."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.information.criteria import SINGULAR_RATIO

# Singular values below this fraction of the largest one count as zero in a pseudo-inverse.
PSEUDO_INVERSE_CUTOFF = 1e-13


def marginal(information: Array, prior: Array, kept: np.ndarray) -> Array:
    """Information about several parameters if the others are estimated, too.

    Args:
        information: (p, p) information of the data [1 / (theta_i theta_j unit)].
        prior: (p, p) prior information, of which only the block of the other parameters is used.
        kept: (k,) indices of the parameters that are kept.

    Returns:
        (k, k) Schur complement [1 / (theta_i theta_j unit)].
    """
    others = np.setdiff1d(np.arange(len(information)), kept)
    among_kept = information[np.ix_(kept, kept)]
    if not len(others):
        return np.asarray(among_kept)

    cross = information[np.ix_(kept, others)]
    among_others = (information + prior)[np.ix_(others, others)]
    inverse = np.linalg.pinv(among_others, rcond=PSEUDO_INVERSE_CUTOFF, hermitian=True)
    return np.asarray(among_kept - cross @ inverse @ cross.T)


def shared(information: Array, prior: Array, private: np.ndarray) -> Array:
    """Information about the parameters that several experiments have in common.

    Args:
        information: (p, p) information of one experiment [1 / (theta_i theta_j unit)].
        prior: (p, p) prior information, of which only the block of the private parameters is used.
        private: (p,) True for parameters with another value in each experiment; they are
            marginalised.

    Returns:
        (p, p) information, zero in the rows and columns of the private parameters.
    """
    if not private.any():
        return information

    kept = np.flatnonzero(~private)
    out = np.zeros_like(information)
    out[np.ix_(kept, kept)] = marginal(information, prior, kept)
    return out


def standard_deviations(information: Array) -> Array:
    """Cramer-Rao standard deviations.

    Args:
        information: (p, p) information [1 / (theta_i theta_j unit)].

    Returns:
        (p,) standard deviations [theta-unit], all infinite if the information is singular.
    """
    scaled, scale = scaled_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] <= SINGULAR_RATIO * values[-1]:
        return np.full(len(scale), np.inf)

    variances = np.sum(vectors**2 / values, axis=1)
    return np.asarray(np.sqrt(variances) / scale)
