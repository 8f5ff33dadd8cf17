"""Marginal information: the Schur complement of the nuisance parameters, and standard deviations."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal


def marginal(information: Array, prior: Array, kept: np.ndarray) -> Array:
    """(k, k) information about the kept parameters once the others, known by their prior, are estimated as well."""
    rest = np.setdiff1d(np.arange(len(information)), kept)
    own = information[np.ix_(kept, kept)]
    if len(rest):
        cross, known = information[np.ix_(kept, rest)], (information + prior)[np.ix_(rest, rest)]
        own = own - cross @ np.linalg.pinv(known, rcond=1e-13, hermitian=True) @ cross.T
    return np.asarray(own)


def shared(information: Array, prior: Array, private: np.ndarray) -> Array:
    """(p, p) information about what several experiments have in common: private: (p,) parameters are marginalised.

    prior: (p, p), what is known of the private ones
    """
    if not private.any():
        return information
    kept = np.flatnonzero(~private)
    out = np.zeros_like(information)
    out[np.ix_(kept, kept)] = marginal(information, prior, kept)
    return out


def standard_deviations(information: Array) -> Array:
    """(p,) Cramer-Rao standard deviations; infinite where the information is singular."""
    scaled, scale = scaled_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] <= 1e-14 * values[-1]:
        return np.full(len(scale), np.inf)
    return np.asarray(np.sqrt(np.sum(vectors**2 / values, axis=1)) / scale)
