"""Pseudo-inertias of bodies, and the distance of two of them.

The distance of the pseudo-inertias C and P is the length of the shortest curve of positive definite
matrices between them,

    d(C, P)² = 1/2 |log(V⁻¹ P V⁻ᵀ)|²,   C = V Vᵀ,

with the Frobenius norm. It depends neither on the unit of length or mass nor on the frame of the
body, and physical inertias are infinitely far from those that no body has (Lee & Park, A geometric
algorithm for robust multibody inertial parameter identification, RA-L 2018). For a body that is s
times as heavy, the logarithm has log s on its diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.model.inertia import INERTIA_COLUMNS, INERTIA_ROWS

# Number of different entries of a symmetric 4 x 4 matrix.
ENTRIES = 10

# Rows and columns of these entries; those off the diagonal stand for two, so that the sum of their
# squares is the square of the norm.
_ROWS, _COLUMNS = np.triu_indices(4)
_FACTORS = np.where(_ROWS == _COLUMNS, 1.0, np.sqrt(2.0))

# Smallest relative difference of two eigenvalues whose logarithms are subtracted.
DISTINCT = 1e-6


# ---- pseudo-inertias and their coordinates


def logcholesky_factor(values: Array) -> Array:
    """Triangular factor U of the pseudo-inertia `U Uᵀ`.

    Args:
        values: (10,) log-Cholesky coordinates alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3.

    Returns:
        (4, 4) upper triangular factor.
    """
    alpha, d, (s12, s23, s13), t = values[0], values[1:4], values[4:7], values[7:]
    U = np.diag([*np.exp(d), 1.0])
    U[0, 1], U[1, 2], U[0, 2] = s12, s23, s13
    U[:3, 3] = t
    return np.asarray(np.exp(alpha) * U)


def logcholesky_derivatives(values: Array) -> Array:
    """Derivatives of the pseudo-inertia by log-Cholesky coordinates.

    Args:
        values: (10,) log-Cholesky coordinates.

    Returns:
        (10, 4, 4) derivatives.
    """
    factor = logcholesky_factor(values)
    change = np.zeros((ENTRIES, 4, 4))
    change[0] = factor
    scale = np.exp(values[0])
    for i in range(3):
        change[1 + i, i, i] = scale * np.exp(values[1 + i])
        change[7 + i, i, 3] = scale
    for k, (row, column) in enumerate(((0, 1), (1, 2), (0, 2))):
        change[4 + k, row, column] = scale

    one_side = change @ factor.T
    return np.asarray(one_side + np.swapaxes(one_side, 1, 2))


def barycentric_of(pseudo_inertia: Array) -> Array:
    """Barycentric coordinates of pseudo-inertias, in which these are linear.

    Args:
        pseudo_inertia: (..., 4, 4) symmetric matrices.

    Returns:
        (..., 10) mass, first moments and entries of the inertia about the origin.
    """
    S = pseudo_inertia[..., :3, :3]
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None]
    diagonal = np.eye(3)[INERTIA_ROWS, INERTIA_COLUMNS]
    inertia = trace * diagonal - S[..., INERTIA_ROWS, INERTIA_COLUMNS]
    mass, moments = pseudo_inertia[..., 3:, 3], pseudo_inertia[..., :3, 3]
    return np.concatenate([mass, moments, inertia], axis=-1)


def pseudo_inertia_of(barycentric: Array) -> Array:
    """Pseudo-inertias of barycentric coordinates; the inverse of `barycentric_of`.

    Args:
        barycentric: (..., 10) mass, first moments and entries of the inertia about the origin.

    Returns:
        (..., 4, 4) symmetric matrices.
    """
    found = np.zeros((*barycentric.shape[:-1], 4, 4))
    entries = barycentric[..., 4:]
    half_trace = 0.5 * entries[..., :3].sum(axis=-1, keepdims=True)
    second = half_trace * np.eye(3)[INERTIA_ROWS, INERTIA_COLUMNS] - entries
    found[..., INERTIA_ROWS, INERTIA_COLUMNS] = second
    found[..., INERTIA_COLUMNS, INERTIA_ROWS] = second
    found[..., :3, 3] = found[..., 3, :3] = barycentric[..., 1:4]
    found[..., 3, 3] = barycentric[..., 0]
    return found


# Derivatives of the pseudo-inertia by barycentric coordinates, (10, 4, 4).
BARYCENTRIC_DERIVATIVES = pseudo_inertia_of(np.eye(ENTRIES))


def is_positive_definite(pseudo_inertia: Array) -> bool:
    """Whether a pseudo-inertia: (4, 4) is that of a body with a volume."""
    scale = np.sqrt(np.abs(np.diag(pseudo_inertia)))
    if not (np.isfinite(pseudo_inertia).all() and (scale > 0.0).all()):
        return False
    try:
        np.linalg.cholesky(pseudo_inertia / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return False
    return True


# ---- distance


@dataclass(frozen=True, kw_only=True, eq=False)
class InertiaDifference:
    """Logarithm of a pseudo-inertia relative to another one, as the residuals of a prior.

    Attributes:
        residual: (10,) entries of the logarithm; the sum of their squares is `2 d²`.
        jacobian: (10, n) their derivatives by n coordinates.
    """

    residual: Array
    jacobian: Array


def inertia_difference(
    pseudo_inertia: Array, derivatives: Array, reference: Array
) -> InertiaDifference:
    """Difference of a pseudo-inertia from a reference.

    Args:
        pseudo_inertia: (4, 4) the pseudo-inertia.
        derivatives: (n, 4, 4) its derivatives by n coordinates.
        reference: (10,) log-Cholesky coordinates of the reference.
    """
    inverse = np.linalg.inv(logcholesky_factor(reference))
    relative = inverse @ pseudo_inertia @ inverse.T
    eigenvalues, axes = np.linalg.eigh(relative)
    eigenvalues = np.maximum(eigenvalues, np.finfo(float).tiny)
    logarithms = np.log(eigenvalues)

    # Derivative of the logarithm of a symmetric matrix in the axes of its eigenvectors (Daleckii &
    # Krein 1965).
    ratio = _divided_differences(eigenvalues, logarithms)
    moves = axes.T @ inverse @ derivatives @ inverse.T @ axes
    changes = axes @ (ratio * moves) @ axes.T
    return InertiaDifference(
        residual=_entries((axes * logarithms) @ axes.T), jacobian=_entries(changes).T
    )


def _divided_differences(values: Array, logarithms: Array) -> Array:
    """(4, 4) differences of logarithms over those of the values, or derivatives."""
    difference = values[:, None] - values
    mean = 0.5 * (values[:, None] + values)
    is_distinct = np.abs(difference) > DISTINCT * mean
    quotient = (logarithms[:, None] - logarithms) / np.where(is_distinct, difference, 1.0)
    return np.where(is_distinct, quotient, 1.0 / mean)


def _entries(matrix: Array) -> Array:
    """(..., 10) entries of symmetric matrices (..., 4, 4), with the norm of the matrix."""
    return np.asarray(_FACTORS * matrix[..., _ROWS, _COLUMNS])
