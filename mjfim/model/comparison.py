"""Comparison of compiled models: whether everything that determines the motion agrees."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.model.inertia import BodyInertia, body_inertia
from mjfim.model.paths import MODEL_ARRAYS

# Relative difference of numbers that is rounding.
ROUNDING = 1e-12

# Prefixes of the arrays that determine the motion, and of those among them that only speed it up,
# follow from others, or are compared as matrices.
COMPARED = (
    *("body_", "jnt_", "dof_", "qpos", "actuator_", "tendon_", "pair_friction", "pair_solref"),
    *("site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "geom_friction"),
    "geom_solref",
)
NOT_COMPARED = (
    *("body_bvh", "body_simple", "body_sameframe", "body_margin", "body_inertia", "body_iquat"),
    *("body_invweight0", "dof_simplenum"),
)

# Relative difference below which numbers count as equal: of the number itself, and of the largest
# one of its array.
TOLERANCE = 1e-9

# Arrays of MjModel that hold mass, place, axes and moments of the inertia of bodies.
INERTIAL = ("body_ipos", "body_mass", "body_iquat", "body_inertia")


def same_dynamics(a: Any, b: Any) -> bool:
    """Whether everything that determines the motion agrees in two MjModels."""
    return not differences(a, b, TOLERANCE)


def differences(a: Any, b: Any, tolerance: float) -> list[str]:
    """The arrays that determine the motion and differ between two models."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_COMPARED)]
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in names}
    pairs |= {n: (getattr(a.opt, n), getattr(b.opt, n)) for n in MODEL_ARRAYS["option"]}
    found = [name for name, (x, y) in pairs.items() if not _is_equal(x, y, tolerance)]
    return found if same_inertias(a, b, tolerance) else [*found, "body_inertia"]


def same_inertias(a: Any, b: Any, tolerance: float) -> bool:
    """Whether all bodies of two models have the same inertias, with axes named in any order."""
    return a.nbody == b.nbody and not any(
        differ_in_inertia(a, b, i, tolerance) for i in range(a.nbody)
    )


def _is_equal(x: Any, y: Any, tolerance: float) -> bool:
    """Whether two arrays have the same shape and nearly the same numbers, in any unit."""
    x, y = np.asarray(x), np.asarray(y)
    if np.array_equal(x, y):
        return True
    if x.shape != y.shape:
        return False
    largest = float(np.abs(y[np.isfinite(y)]).max(initial=0.0))
    rounding = largest * max(ROUNDING, tolerance * tolerance)
    return bool(np.isclose(x, y, rtol=tolerance, atol=rounding).all())


def differ_in_inertia(a: Any, b: Any, body: int, tolerance: float) -> bool:
    """Whether a body has different inertias in two models, by a share of its mass and size."""
    pairs = [(getattr(a, array)[body], getattr(b, array)[body]) for array in INERTIAL]
    if all(np.array_equal(*pair) for pair in pairs):
        return False
    return not same_inertia(body_inertia(a, body), body_inertia(b, body), tolerance)


def same_inertia(a: BodyInertia, b: BodyInertia, tolerance: float = ROUNDING) -> bool:
    """Whether two inertias differ by at most a share of the mass and the size of the body."""
    if not (a.mass > 0.0 and b.mass > 0.0):
        return a.mass == b.mass
    radius, trace = b.gyration_radius, float(np.trace(b.inertia))
    return (
        abs(a.mass - b.mass) <= tolerance * b.mass
        and bool((np.abs(a.com - b.com) <= tolerance * radius).all())
        and bool((np.abs(a.inertia - b.inertia) <= tolerance * trace).all())
    )
