"""The ten inertial parameters of a body in three parametrisations.

They are called central (that of MuJoCo), barycentric and log-Cholesky.

The pseudo-inertia `J = [[S, h], [h', m]]` holds the second moments S, the first moments h = m c
and the mass m about the origin of the body frame; the inertia is `I = tr(S) 1 - S`. A body is
physical when J is positive definite. The log-Cholesky parametrisation ensures this (Rucker &
Wensing, Smooth parameterization of rigid-body inertia, RA-L 2022): `J = U U'` with

    U = e^alpha [[e^d1,  s12,  s13, t1],
                 [   0, e^d2,  s23, t2],
                 [   0,    0, e^d3, t3],
                 [   0,    0,    0,  1]].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record

# Entries (row, column) of an inertia matrix in MJCF's order of `fullinertia`: xx yy zz xy xz yz.
INERTIA_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

# Rows and columns of these entries, (6,) each, for indexing a matrix.
INERTIA_ROWS, INERTIA_COLUMNS = np.array(INERTIA_ENTRIES).T

# A body counts as a point, a rod or a plate where the ratio of its smallest to its largest second
# moment is at most this.
DEGENERATE_RATIO = 1e-9


@record
class BodyInertia:
    """Mass, centre of mass and inertia of a rigid body, in the axes of the body frame.

    Attributes:
        mass: Mass [kg].
        com: (3,) centre of mass [m].
        inertia: (3, 3) inertia about the centre of mass [kg m²].
    """

    mass: float
    com: Array
    inertia: Array

    @staticmethod
    def from_principal(mass: float, com: Array, moments: Array, quaternion: Array) -> BodyInertia:
        """Build an inertia from MuJoCo's principal moments.

        Args:
            mass: Mass [kg].
            com: (3,) centre of mass [m].
            moments: (3,) principal moments [kg m²].
            quaternion: (4,) orientation (w, x, y, z) of the principal axes in the body frame.
        """
        R = scipy.spatial.transform.Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        inertia = R * np.asarray(moments) @ R.T
        return BodyInertia(mass=float(mass), com=np.array(com), inertia=inertia)

    def principal_axes(self) -> tuple[Array, Array]:
        """Principal moments and axes.

        Returns:
            (3,) principal moments [kg m²] in descending order, and the quaternion (w, x, y, z) of
            the principal axes, which are right-handed.
        """
        moments, R = np.linalg.eigh(self.inertia)
        moments = moments[::-1]
        R = np.ascontiguousarray(R[:, ::-1])

        if np.linalg.det(R) < 0.0:
            R[:, 2] *= -1.0
        # MuJoCo's own function takes a hundredth of the time of SciPy's.
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, R.ravel())
        return moments, quaternion

    @property
    def second_moments(self) -> Array:
        """(3, 3) second moments about the centre of mass, `tr(I)/2 1 - I` [kg m²]."""
        half_trace = 0.5 * np.trace(self.inertia)
        return np.asarray(half_trace * np.eye(3) - self.inertia)

    @property
    def gyration_radius(self) -> float:
        """Radius of gyration about the origin of the body frame [m]."""
        central = np.trace(self.second_moments) / self.mass
        return float(np.sqrt(central + self.com @ self.com))


def body_inertia(model: Any, body: int) -> BodyInertia:
    """Mass, centre of mass and inertia of a body in a model, by the body's number."""
    return BodyInertia.from_principal(
        model.body_mass[body],
        model.body_ipos[body],
        model.body_inertia[body],
        model.body_iquat[body],
    )


def to_central(body: BodyInertia) -> Array:
    """(10,) mass, centre of mass, and `fullinertia` about the centre of mass."""
    entries = _entries(body.inertia)
    return np.concatenate([[body.mass], body.com, entries])


def from_central(values: Array) -> BodyInertia:
    """Inverse of `to_central`. values: (10,)."""
    return BodyInertia(
        mass=float(values[0]), com=np.array(values[1:4]), inertia=_symmetric(values[4:])
    )


def to_barycentric(body: BodyInertia) -> Array:
    """(10,) mass, first moments m c, and inertia about the origin of the body frame.

    The dynamics are linear in these coordinates.
    """
    first_moments = body.mass * body.com
    about_origin = body.inertia + _steiner(body.mass, body.com)
    return np.concatenate([[body.mass], first_moments, _entries(about_origin)])


def from_barycentric(values: Array) -> BodyInertia:
    """Inverse of `to_barycentric`. values: (10,)."""
    mass = float(values[0])
    com = values[1:4] / values[0]
    inertia = _symmetric(values[4:]) - _steiner(mass, com)
    return BodyInertia(mass=mass, com=com, inertia=inertia)


def to_logcholesky(body: BodyInertia) -> Array:
    """(10,) alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3.

    Raises:
        ValueError: The body is a point, a rod or a plate, whose pseudo-inertia is singular.
    """
    per_mass = body.second_moments / body.mass
    spread = np.linalg.eigvalsh(per_mass)
    if not spread[0] > DEGENERATE_RATIO * max(spread[2], 1e-300):
        raise ValueError(
            "its inertia is that of a point, a rod or a plate (two principal moments add up to "
            "the third)"
        )

    # The upper triangular factor U, with U U' = per_mass, is the flipped Cholesky factor of the
    # flipped matrix.
    flipped = np.linalg.cholesky(per_mass[::-1, ::-1])
    U = flipped[::-1, ::-1]

    alpha = 0.5 * np.log(body.mass)
    d = np.log(np.diag(U))
    s = [U[0, 1], U[1, 2], U[0, 2]]
    return np.concatenate([[alpha], d, s, body.com])


def from_logcholesky(values: Array) -> BodyInertia:
    """Inverse of `to_logcholesky`; the result is physical for any values: (10,)."""
    U = _unit_factor(values)[:3, :3]

    # U is scaled by e^alpha, so that the mass is e^(2 alpha).
    mass = float(np.exp(2.0 * values[0]))
    com = np.array(values[7:])

    second_moments = mass * (U @ U.T)
    inertia = np.trace(second_moments) * np.eye(3) - second_moments
    return BodyInertia(mass=mass, com=com, inertia=inertia)


def _entries(matrix: Array) -> Array:
    """(6,) entries xx yy zz xy xz yz of a symmetric matrix (3, 3)."""
    return np.asarray(matrix[INERTIA_ROWS, INERTIA_COLUMNS])


def _symmetric(entries: Array) -> Array:
    """(3, 3) symmetric matrix of its entries (6,) xx yy zz xy xz yz."""
    matrix = np.empty((3, 3))
    matrix[INERTIA_ROWS, INERTIA_COLUMNS] = entries
    matrix[INERTIA_COLUMNS, INERTIA_ROWS] = entries
    return matrix


def _steiner(mass: float, com: Array) -> Array:
    """(3, 3) inertia about the origin of a point mass, by the parallel axis theorem [kg m²].

    Args:
        mass: The mass [kg].
        com: (3,) its position [m].
    """
    squared = com @ com
    return mass * (squared * np.eye(3) - np.outer(com, com))


@record
class InertiaParametrisation:
    """Ten coordinates that describe the inertia of a body.

    Attributes:
        names: Names of the ten coordinates.
        units: Their units.
        coordinates: (10,) coordinates of a body's inertia.
        inertia: Inverse of `coordinates`.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    coordinates: Callable[[BodyInertia], Array]
    inertia: Callable[[Array], BodyInertia]

    def magnitudes(self, body: BodyInertia) -> Array:
        """(10,) natural magnitudes of a change of the coordinates [units of the coordinates]."""
        mass = body.mass
        radius = body.gyration_radius
        by_unit = {
            "kg": mass,
            "kg m": mass * radius,
            "kg m²": mass * radius**2,
            "m": radius,
            "": 1.0,
        }
        return np.array([by_unit[unit] for unit in self.units])


# Names of the six entries of an inertia matrix, in the order of INERTIA_ENTRIES.
ENTRY_NAMES = ("xx", "yy", "zz", "xy", "xz", "yz")

# All parametrisations by the name that experiment files and parameter paths use.
INERTIA_PARAMETRISATIONS = {
    "central": InertiaParametrisation(
        names=("mass", "cx", "cy", "cz", *(f"I{entry}" for entry in ENTRY_NAMES)),
        units=("kg", "m", "m", "m", *["kg m²"] * 6),
        coordinates=to_central,
        inertia=from_central,
    ),
    "barycentric": InertiaParametrisation(
        names=("mass", "mx", "my", "mz", *(f"J{entry}" for entry in ENTRY_NAMES)),
        units=("kg", "kg m", "kg m", "kg m", *["kg m²"] * 6),
        coordinates=to_barycentric,
        inertia=from_barycentric,
    ),
    "logcholesky": InertiaParametrisation(
        names=("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3"),
        units=("", "", "", "", *["m"] * 6),
        coordinates=to_logcholesky,
        inertia=from_logcholesky,
    ),
}


# Number of different entries of a symmetric 4 x 4 matrix.
PSEUDO_ENTRIES = 10

# Rows and columns of these entries; those off the diagonal stand for two, so that the sum of their
# squares is the square of the norm.
_PSEUDO_ROWS, _PSEUDO_COLUMNS = np.triu_indices(4)
_FACTORS = np.where(_PSEUDO_ROWS == _PSEUDO_COLUMNS, 1.0, np.sqrt(2.0))

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
    return np.asarray(np.exp(values[0]) * _unit_factor(values))


def _unit_factor(values: Array) -> Array:
    """(4, 4) the factor of a body with the mass 1."""
    U = np.diag([*np.exp(values[1:4]), 1.0])
    U[0, 1], U[1, 2], U[0, 2] = values[4:7]
    U[:3, 3] = values[7:]
    return U


def logcholesky_derivatives(values: Array) -> Array:
    """Derivatives of the pseudo-inertia by log-Cholesky coordinates.

    Args:
        values: (10,) log-Cholesky coordinates.

    Returns:
        (10, 4, 4) derivatives.
    """
    factor = logcholesky_factor(values)
    change = np.zeros((PSEUDO_ENTRIES, 4, 4))
    change[0] = factor
    scale = np.exp(values[0])
    for i in range(3):
        change[1 + i, i, i] = scale * np.exp(values[1 + i])
        change[7 + i, i, 3] = scale
    for k, (row, column) in enumerate(((0, 1), (1, 2), (0, 2))):
        change[4 + k, row, column] = scale

    one_side = change @ factor.T
    return one_side + np.swapaxes(one_side, 1, 2)


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
BARYCENTRIC_DERIVATIVES = pseudo_inertia_of(np.eye(PSEUDO_ENTRIES))


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


def inertia_difference(
    pseudo_inertia: Array, derivatives: Array, reference: Array
) -> tuple[Array, Array]:
    """Logarithm of a pseudo-inertia relative to another one, as the residuals of a prior.

    Args:
        pseudo_inertia: (4, 4) the pseudo-inertia.
        derivatives: (n, 4, 4) its derivatives by n coordinates.
        reference: (10,) log-Cholesky coordinates of the reference.

    Returns:
        (10,) entries of the logarithm, the sum of whose squares is `2 d²`, and their (10, n)
        derivatives.
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
    return _norm_entries((axes * logarithms) @ axes.T), _norm_entries(changes).T


def _divided_differences(values: Array, logarithms: Array) -> Array:
    """(4, 4) differences of logarithms over those of the values, or derivatives."""
    difference = values[:, None] - values
    mean = 0.5 * (values[:, None] + values)
    is_distinct = np.abs(difference) > DISTINCT * mean
    quotient = (logarithms[:, None] - logarithms) / np.where(is_distinct, difference, 1.0)
    return np.where(is_distinct, quotient, 1.0 / mean)


def _norm_entries(matrix: Array) -> Array:
    """(..., 10) entries of symmetric matrices (..., 4, 4), with the norm of the matrix."""
    return _FACTORS * matrix[..., _PSEUDO_ROWS, _PSEUDO_COLUMNS]
