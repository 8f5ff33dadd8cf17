"""Optimality criteria phi of an information matrix I, their derivatives, and standard deviations.

A derivative has the form `M = dphi/dI = sum_r m_r w_r w_r'`. Nuisance parameters are eliminated by
the Schur complement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy

from mjfim.arrays import Array, record, scaled_to_unit_diagonal

# An information matrix is singular if the ratio of its smallest to its largest eigenvalue is at
# most this number.
SINGULAR_RATIO = 1e-14

# Eigenvectors whose weight is below this fraction of the largest weight are left out of a
# derivative.
NEGLIGIBLE_WEIGHT = 1e-9

# Singular values below this fraction of the largest one count as zero in a pseudo-inverse.
PSEUDO_INVERSE_CUTOFF = 1e-13


@record
class Criterion:
    """Value of a criterion phi and its derivative `M = sum_r weights_r directions_r directions_r'`.

    Attributes:
        value: phi; infinite if the information is singular.
        weights: (r,) weights m of the derivative.
        directions: (r, p) directions w of the derivative.
        eigenvalues: (p,) eigenvalues of the information, ascending.
        power: Exponent q of `(sum lambda^-q)^(1/q)`, whose first directions belong to the first
            eigenvalues; infinite for the other criteria.
    """

    value: float
    weights: Array
    directions: Array
    eigenvalues: Array
    power: float = np.inf


def _of_eigenvalues(
    information: Array,
    phi: Callable[[Array], tuple[float, Array]],
    *,
    power: float = np.inf,
    negligible_weight: float = 0.0,
) -> Criterion:
    """Criterion that depends on the eigenvalues alone.

    A singular matrix has the direction of the smallest eigenvalue, with the weight zero.

    Args:
        information: (p, p) information.
        phi: The criterion of p ascending eigenvalues, and its derivatives by the first ones of
            them. The first derivative has the largest absolute value.
        power: Exponent q of the smooth E-criterion.
        negligible_weight: Eigenvectors are left out whose weight, relative to the first one, is not
            above this number; 0 for none.
    """
    values, vectors = np.linalg.eigh(information)
    value, weights = np.inf, np.zeros(1)
    if is_regular := bool(values[0] > SINGULAR_RATIO * values[-1]):
        value, weights = phi(values)
    directions = vectors.T[: len(weights)]
    if is_regular and negligible_weight > 0.0:
        kept = np.abs(weights) > negligible_weight * np.abs(weights[0])
        weights, directions = weights[kept], directions[kept]
    return Criterion(
        value=float(value),
        weights=weights,
        directions=directions,
        eigenvalues=values,
        power=power if is_regular else np.inf,
    )


def e_optimality(information: Array) -> Criterion:
    """E-optimality, `1 / lambda_min`, with its derivative by Nelson's formula.

    Args:
        information: (p, p) information.
    """
    return _of_eigenvalues(
        information, lambda values: (1.0 / values[0], np.array([-(values[0] ** -2)]))
    )


def smooth_e_optimality(
    information: Array, power: float, negligible_weight: float = NEGLIGIBLE_WEIGHT
) -> Criterion:
    """Kiefer's criterion `(sum_i lambda_i^-q)^(1/q)`, which is smooth also at equal eigenvalues.

    It is at most `p^(1/q)` times 1/lambda_min, and approaches 1/lambda_min for large q.

    Args:
        information: (p, p) information.
        power: Exponent q.
        negligible_weight: Eigenvectors whose weight is below this fraction of the largest weight
            are left out of the derivative.
    """

    def phi(values: Array) -> tuple[float, Array]:
        """The criterion, with powers of a ratio: powers of the eigenvalues would overflow."""
        ratio = values[0] / values
        total = float(np.sum(ratio**power))
        weights = total ** (1.0 / power - 1.0) * ratio ** (power + 1.0) / values[0] ** 2
        return total ** (1.0 / power) / values[0], -weights

    return _of_eigenvalues(information, phi, power=power, negligible_weight=negligible_weight)


def a_optimality(information: Array) -> Criterion:
    """A-optimality, `trace I^-1`.

    Args:
        information: (p, p) information.
    """
    return _of_eigenvalues(
        information,
        lambda values: (np.sum(1.0 / values), -(values**-2.0)),
        negligible_weight=NEGLIGIBLE_WEIGHT,
    )


def d_optimality(information: Array) -> Criterion:
    """D-optimality, `-log det I`.

    Args:
        information: (p, p) information.
    """
    return _of_eigenvalues(information, lambda values: (-np.sum(np.log(values)), -1.0 / values))


def c_optimality(information: Array, contrast: Array) -> Criterion:
    """Sum of the variances of stated combinations, `trace C' I^-1 C`.

    Args:
        information: (p, p) information.
        contrast: C, (p, c) combinations of the parameters.
    """
    spectral = e_optimality(information)
    if np.isinf(spectral.value):
        return spectral

    Y = np.asarray(np.linalg.solve(information, contrast).T, dtype=np.float64)
    return replace(
        spectral, value=float(np.sum(Y * contrast.T)), weights=-np.ones(len(Y)), directions=Y
    )


# Criteria that depend on the information matrix alone, by their name in an experiment.
CRITERIA: dict[str, Callable[[Array], Criterion]] = {
    "E": e_optimality,
    "A": a_optimality,
    "D": d_optimality,
}


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
        information: (..., p, p) information [1 / (theta_i theta_j unit)].

    Returns:
        (..., p) standard deviations [theta-unit], all infinite if the information is singular.
    """
    scaled, scale = scaled_to_unit_diagonal(information)
    variances = np.sum(inverse_root(scaled) ** 2, axis=-1)
    return np.asarray(np.sqrt(np.nan_to_num(variances, nan=np.inf)) / scale)


# Number of groups of data whose scatter shows honest standard deviations where residuals are no
# white noise. A model that lacks a term errs alike in all rows of a kind: only few groups are
# independent (Ibragimov & Müller 2010).
GROUPS = 4


def without_chance(std: Array, freedom: int) -> Array:
    """Standard deviations without that part of their differences that chance explains.

    Their logarithms are shrunk to the mean (empirical Bayes, after James & Stein, Estimation with
    quadratic loss, 1961).

    Args:
        std: (k,) positive standard deviations.
        freedom: Degrees of freedom of each.
    """
    logs = np.log(std)
    chance = 0.25 * float(scipy.special.polygamma(1, 0.5 * freedom))
    kept = 1.0 - chance / max(float(logs.var()), chance)
    return np.asarray(np.exp(logs.mean() + kept * (logs - logs.mean())))


def inverse_root(information: Array) -> Array:
    """Matrices W with `W W'` the inverse of an information.

    Args:
        information: (..., p, p) information of unit diagonal.

    Returns:
        (..., p, p) matrices; NaN where the information is singular.
    """
    values, vectors = np.linalg.eigh(information)
    is_singular = values[..., 0] <= SINGULAR_RATIO * values[..., -1]
    usable = np.where(is_singular[..., None], np.nan, values)
    return np.asarray(vectors / np.sqrt(usable)[..., None, :])
