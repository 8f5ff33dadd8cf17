"""Optimality criteria of an information matrix and their derivatives `M = dphi/dI = sum_r m_r w_r w_r'`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

SINGULAR = 1e-14
NEGLIGIBLE = 1e-9  # of the largest weight


@dataclass(frozen=True, eq=False)
class Criterion:
    """Value of phi and its derivative `M = sum_r weights_r directions_r directions_r'`.

    weights: (r,);  directions: (r, p);  eigenvalues: (p,) ascending
    power: q of `(sum lambda^-q)^(1/q)`, whose first directions belong to the first eigenvalues; infinite for other criteria
    """

    value: float
    weights: Array
    directions: Array
    eigenvalues: Array
    power: float = np.inf


def _spectrum(information: Array) -> tuple[Array, Array, bool]:
    values, vectors = np.linalg.eigh(information)
    return values, vectors, bool(values[0] > SINGULAR * values[-1])


def _blind(values: Array, vectors: Array) -> Criterion:
    return Criterion(np.inf, np.zeros(1), vectors[:, :1].T, values)


def e_optimality(information: Array) -> Criterion:
    """`1 / lambda_min`, by Nelson's formula. information: (p, p)."""
    values, vectors, sound = _spectrum(information)
    if not sound:
        return _blind(values, vectors)
    return Criterion(
        float(1.0 / values[0]), np.array([-(values[0] ** -2)]), vectors[:, :1].T, values
    )


def smooth_e_optimality(information: Array, power: float, faint: float = NEGLIGIBLE) -> Criterion:
    """`(sum_i lambda_i^-q)^(1/q)`, Kiefer's criterion: differentiable where eigenvalues meet, 1/lambda_min as q grows.

    At most `p^(1/q)` times 1/lambda_min. Every eigenvector of more than faint weight is among the directions.
    """
    values, vectors, sound = _spectrum(information)
    if not sound:
        return _blind(values, vectors)
    ratio = values[0] / values
    total = float(np.sum(ratio**power))
    weights = total ** (1.0 / power - 1.0) * ratio ** (power + 1.0) / values[0] ** 2
    kept = weights > faint * weights[0]
    return Criterion(
        total ** (1.0 / power) / values[0], -weights[kept], vectors.T[kept], values, power
    )


def a_optimality(information: Array) -> Criterion:
    """`trace I^-1`."""
    values, vectors, sound = _spectrum(information)
    if not sound:
        return _blind(values, vectors)
    weights = values**-2.0
    kept = weights > NEGLIGIBLE * weights[0]
    return Criterion(float(np.sum(1.0 / values)), -weights[kept], vectors.T[kept], values)


def d_optimality(information: Array) -> Criterion:
    """`-log det I`."""
    values, vectors, sound = _spectrum(information)
    if not sound:
        return _blind(values, vectors)
    return Criterion(float(-np.sum(np.log(values))), -1.0 / values, vectors.T, values)


def c_optimality(information: Array, contrast: Array) -> Criterion:
    """`trace C' I^-1 C`, the summed variance of stated combinations. contrast: C, (p, c)."""
    values, vectors, sound = _spectrum(information)
    if not sound:
        return _blind(values, vectors)
    Y = np.asarray(np.linalg.solve(information, contrast).T, dtype=np.float64)
    return Criterion(float(np.sum(Y * contrast.T)), -np.ones(len(Y)), Y, values)


CRITERIA: dict[str, Callable[[Array], Criterion]] = {
    "E": e_optimality,
    "A": a_optimality,
    "D": d_optimality,
}
