"""Optimality criteria of an information matrix and their derivatives `M = dphi/dI = sum_r m_r w_r w_r'`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

# Smallest eigenvalue over the largest one, at and below which an information matrix counts as
# singular.
SINGULAR_RATIO = 1e-14

# Weight of an eigenvector in a derivative, relative to the largest one, below which it is left out.
NEGLIGIBLE_WEIGHT = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Criterion:
    """Value of a criterion phi and its derivative `M = sum_r weights_r directions_r directions_r'`.

    Attributes:
        value: phi; infinite where the information is singular.
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


def _spectrum(information: Array) -> tuple[Array, Array, bool]:
    """Ascending eigenvalues (p,), eigenvectors (p, p) as columns, and whether the matrix is regular."""
    values, vectors = np.linalg.eigh(information)
    return values, vectors, bool(values[0] > SINGULAR_RATIO * values[-1])


def _singular(values: Array, vectors: Array) -> Criterion:
    """The infinite criterion of a singular matrix, with the direction of its smallest eigenvalue and no weight."""
    return Criterion(
        value=np.inf, weights=np.zeros(1), directions=vectors[:, :1].T, eigenvalues=values
    )


def e_optimality(information: Array) -> Criterion:
    """E-optimality, `1 / lambda_min`, with its derivative by Nelson's formula.

    Args:
        information: (p, p) information.
    """
    values, vectors, regular = _spectrum(information)
    if not regular:
        return _singular(values, vectors)

    return Criterion(
        value=float(1.0 / values[0]),
        weights=np.array([-(values[0] ** -2)]),
        directions=vectors[:, :1].T,
        eigenvalues=values,
    )


def smooth_e_optimality(
    information: Array, power: float, negligible_weight: float = NEGLIGIBLE_WEIGHT
) -> Criterion:
    """Kiefer's criterion `(sum_i lambda_i^-q)^(1/q)`: differentiable where eigenvalues meet, 1/lambda_min as q grows.

    It is at most `p^(1/q)` times 1/lambda_min.

    Args:
        information: (p, p) information.
        power: Exponent q.
        negligible_weight: Weight of an eigenvector, relative to the largest one, below which it is
            left out of the derivative.
    """
    values, vectors, regular = _spectrum(information)
    if not regular:
        return _singular(values, vectors)

    # Powers of the ratio, not of the eigenvalues, which would overflow.
    ratio = values[0] / values
    total = float(np.sum(ratio**power))
    weights = total ** (1.0 / power - 1.0) * ratio ** (power + 1.0) / values[0] ** 2
    kept = weights > negligible_weight * weights[0]

    return Criterion(
        value=total ** (1.0 / power) / values[0],
        weights=-weights[kept],
        directions=vectors.T[kept],
        eigenvalues=values,
        power=power,
    )


def a_optimality(information: Array) -> Criterion:
    """A-optimality, `trace I^-1`.

    Args:
        information: (p, p) information.
    """
    values, vectors, regular = _spectrum(information)
    if not regular:
        return _singular(values, vectors)

    weights = values**-2.0
    kept = weights > NEGLIGIBLE_WEIGHT * weights[0]
    return Criterion(
        value=float(np.sum(1.0 / values)),
        weights=-weights[kept],
        directions=vectors.T[kept],
        eigenvalues=values,
    )


def d_optimality(information: Array) -> Criterion:
    """D-optimality, `-log det I`.

    Args:
        information: (p, p) information.
    """
    values, vectors, regular = _spectrum(information)
    if not regular:
        return _singular(values, vectors)

    return Criterion(
        value=float(-np.sum(np.log(values))),
        weights=-1.0 / values,
        directions=vectors.T,
        eigenvalues=values,
    )


def c_optimality(information: Array, contrast: Array) -> Criterion:
    """The summed variance of stated combinations, `trace C' I^-1 C`.

    Args:
        information: (p, p) information.
        contrast: C, (p, c) combinations of the parameters.
    """
    values, vectors, regular = _spectrum(information)
    if not regular:
        return _singular(values, vectors)

    Y = np.asarray(np.linalg.solve(information, contrast).T, dtype=np.float64)
    return Criterion(
        value=float(np.sum(Y * contrast.T)),
        weights=-np.ones(len(Y)),
        directions=Y,
        eigenvalues=values,
    )


# Criteria of an information matrix alone, by the name that an experiment states.
CRITERIA: dict[str, Callable[[Array], Criterion]] = {
    "E": e_optimality,
    "A": a_optimality,
    "D": d_optimality,
}
