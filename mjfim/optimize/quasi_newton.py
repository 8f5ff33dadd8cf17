"""The two-loop recursion of limited-memory BFGS.

Source: Nocedal & Wright, Numerical Optimization, algorithm 7.4.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class CurvaturePair:
    """A step and the change of the gradient along it.

    Attributes:
        s: (...) step.
        y: (...) change of the gradient along the step.
        curvature: Product s'y, which is positive.
    """

    s: Array
    y: Array
    curvature: float

    @staticmethod
    def where_convex(s: Array, y: Array, tolerance: float) -> CurvaturePair | None:
        """The pair of a step and a change of the gradient, if its curvature is clearly positive.

        Args:
            s: (...) step.
            y: (...) change of the gradient along the step.
            tolerance: Smallest curvature, relative to the norms of s and y.

        Returns:
            The pair or None.
        """
        found = convex_pairs(s[None], y[None], tolerance)
        return found[0] if found else None


def convex_pairs(s: Array, y: Array, tolerance: float) -> list[CurvaturePair]:
    """The pairs of steps and changes of the gradient whose curvature is clearly positive.

    Args:
        s: (p, ...) steps.
        y: (p, ...) changes of the gradient along these steps.
        tolerance: Smallest curvature, relative to the norms of s and y.

    Returns:
        The pairs, in the same order.
    """
    steps = s.reshape(len(s), -1)
    changes = y.reshape(len(y), -1)
    curvatures = np.einsum("pi,pi->p", steps, changes)
    norms = np.linalg.norm(steps, axis=1) * np.linalg.norm(changes, axis=1)
    is_convex = curvatures > tolerance * norms
    return [
        CurvaturePair(s=s[i], y=y[i], curvature=float(curvatures[i]))
        for i in np.flatnonzero(is_convex)
    ]


def inverse_hessian_product(
    g: Array, pairs: Sequence[CurvaturePair], initial: Callable[[Array], Array]
) -> Array:
    """Product of the BFGS approximation of the inverse Hessian with a vector.

    Args:
        g: (...) vector, usually a gradient, or m vectors: (m, ...).
        pairs: Curvature pairs, the oldest first.
        initial: Product of the initial inverse Hessian with vectors of the shape of g.

    Returns:
        (...) or (m, ...) the product.
    """
    if not pairs:
        return initial(g)

    # A product of the rows with a vector has the shape (m,), or is a number for a single row.
    size = pairs[0].s.size
    rows = g.reshape(*g.shape[: g.ndim - pairs[0].s.ndim], size)

    alphas = []
    for pair in reversed(pairs):
        alpha = (rows @ pair.s.reshape(size) / pair.curvature)[..., None]
        rows = rows - alpha * pair.y.reshape(size)
        alphas.append(alpha)

    rows = initial(rows.reshape(g.shape)).reshape(rows.shape)

    for pair, alpha in zip(pairs, reversed(alphas), strict=True):
        beta = (rows @ pair.y.reshape(size) / pair.curvature)[..., None]
        rows = rows + (alpha - beta) * pair.s.reshape(size)

    return rows.reshape(g.shape)
