"""Inertial parameters of a body in three charts: central (MuJoCo's), barycentric, log-Cholesky. Arrays only.

The pseudo-inertia `J = [[S, h], [h', m]]` holds the second moments S, the first moments h = m c and the mass about the body
frame's origin; `I = tr(S) 1 - S`. A body is physical when J is positive definite, which `J = U U'` with
`U = e^alpha [[e^d1, s12, s13, t1], [0, e^d2, s23, t2], [0, 0, e^d3, t3], [0, 0, 0, 1]]` always is
(Rucker & Wensing, Smooth parameterization of rigid-body inertia, RA-L 2022).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from mjfim.arrays import Array

PAIRS = (
    (0, 0),
    (1, 1),
    (2, 2),
    (0, 1),
    (0, 2),
    (1, 2),
)  # xx yy zz xy xz yz, MJCF's order of fullinertia


INERTIA_ROWS, INERTIA_COLUMNS = np.array(PAIRS).T


DEGENERATE = 1e-9


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass [kg], centre of mass (3,) [m] and inertia (3, 3) about it [kg m²], in the axes of the body frame."""

    mass: float
    com: Array
    inertia: Array

    @staticmethod
    def principal(mass: float, com: Array, moments: Array, quaternion: Array) -> Inertial:
        """From MuJoCo's principal moments (3,) and their frame (w, x, y, z)."""
        R = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        return Inertial(float(mass), np.array(com), R * np.asarray(moments) @ R.T)

    def axes(self) -> tuple[Array, Array]:
        """Principal moments (3,), descending, and their frame as a quaternion (w, x, y, z)."""
        moments, R = np.linalg.eigh(self.inertia)
        moments, R = moments[::-1], R[:, ::-1]
        if np.linalg.det(R) < 0.0:
            R = R * np.array([1.0, 1.0, -1.0])
        return moments, Rotation.from_matrix(R).as_quat(scalar_first=True)

    @property
    def second(self) -> Array:
        """(3, 3) central second moments, `tr(I)/2 1 - I` [kg m²]."""
        return np.asarray(0.5 * np.trace(self.inertia) * np.eye(3) - self.inertia)

    @property
    def radius(self) -> float:
        """Radius of gyration about the body frame's origin [m]."""
        return float(np.sqrt(np.trace(self.second) / self.mass + self.com @ self.com))


def central(body: Inertial) -> Array:
    """(10,) mass, centre of mass, fullinertia about it."""
    return np.concatenate([[body.mass], body.com, body.inertia[INERTIA_ROWS, INERTIA_COLUMNS]])


def from_central(v: Array) -> Inertial:
    """Inverse of `central`."""
    return Inertial(float(v[0]), np.array(v[1:4]), _symmetric(v[4:]))


def barycentric(body: Inertial) -> Array:
    """(10,) mass, first moments m c, inertia about the body frame's origin: the dynamics are linear in them."""
    about = body.inertia + body.mass * (
        body.com @ body.com * np.eye(3) - np.outer(body.com, body.com)
    )
    return np.concatenate([[body.mass], body.mass * body.com, about[INERTIA_ROWS, INERTIA_COLUMNS]])


def from_barycentric(v: Array) -> Inertial:
    """Inverse of `barycentric`."""
    mass, com = float(v[0]), v[1:4] / v[0]
    about = _symmetric(v[4:])
    return Inertial(mass, com, about - mass * (com @ com * np.eye(3) - np.outer(com, com)))


def logcholesky(body: Inertial) -> Array:
    """(10,) alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3. Raises ValueError where the body is a point, a rod or a plate."""
    per_mass = body.second / body.mass
    spread = np.linalg.eigvalsh(per_mass)
    if not spread[0] > DEGENERATE * max(spread[2], 1e-300):
        raise ValueError(
            "its inertia is that of a point, a rod or a plate (two principal moments add up to the third)"
        )
    flipped = np.linalg.cholesky(per_mass[::-1, ::-1])
    U = flipped[::-1, ::-1]  # upper triangular, U U' = per_mass
    d = np.log(np.diag(U))
    return np.concatenate([[0.5 * np.log(body.mass)], d, [U[0, 1], U[1, 2], U[0, 2]], body.com])


def from_logcholesky(v: Array) -> Inertial:
    """Inverse of `logcholesky`; physical for every v."""
    U = np.diag(np.exp(v[1:4]))
    U[0, 1], U[1, 2], U[0, 2] = v[4], v[5], v[6]
    mass = float(np.exp(2.0 * v[0]))
    second = mass * (U @ U.T)
    return Inertial(mass, np.array(v[7:]), np.trace(second) * np.eye(3) - second)


def _symmetric(v: Array) -> Array:
    out = np.empty((3, 3))
    out[INERTIA_ROWS, INERTIA_COLUMNS] = out[INERTIA_COLUMNS, INERTIA_ROWS] = v
    return out


@dataclass(frozen=True)
class InertiaParametrisation:
    """Ten coordinates of a body's inertia: their names and units, and the way there and back."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    of: Callable[[Inertial], Array]
    back: Callable[[Array], Inertial]

    def size(self, body: Inertial) -> Array:
        """(10,) magnitudes that a change of each coordinate is naturally compared with."""
        m, r = body.mass, body.radius
        powers = {"kg": m, "kg m": m * r, "kg m²": m * r**2, "m": r, "": 1.0}
        return np.array([powers[unit] for unit in self.units])


TENSOR = ("xx", "yy", "zz", "xy", "xz", "yz")
INERTIA_PARAMETRISATIONS = {
    "central": InertiaParametrisation(
        ("mass", "cx", "cy", "cz", *(f"I{t}" for t in TENSOR)),
        ("kg", "m", "m", "m", *["kg m²"] * 6),
        central,
        from_central,
    ),
    "barycentric": InertiaParametrisation(
        ("mass", "mx", "my", "mz", *(f"J{t}" for t in TENSOR)),
        ("kg", "kg m", "kg m", "kg m", *["kg m²"] * 6),
        barycentric,
        from_barycentric,
    ),
    "logcholesky": InertiaParametrisation(
        ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3"),
        ("", "", "", "", "m", "m", "m", "m", "m", "m"),
        logcholesky,
        from_logcholesky,
    ),
}
