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
        curvature = float(np.vdot(s, y))
        if curvature > tolerance * np.linalg.norm(s) * np.linalg.norm(y):
            return CurvaturePair(s=s, y=y, curvature=curvature)

        return None


def inverse_hessian_product(
    g: Array, pairs: Sequence[CurvaturePair], initial: Callable[[Array], Array]
) -> Array:
    """Product of the BFGS approximation of the inverse Hessian with a vector.

    Args:
        g: (...) vector, usually a gradient.
        pairs: Curvature pairs, the oldest first.
        initial: Product of the initial inverse Hessian with a vector of the shape of g.

    Returns:
        (...) the product.
    """
    alphas = []
    for pair in reversed(pairs):
        alpha = np.vdot(pair.s, g) / pair.curvature
        g = g - alpha * pair.y
        alphas.append(alpha)

    product = initial(g)

    for pair, alpha in zip(pairs, reversed(alphas), strict=True):
        beta = np.vdot(pair.y, product) / pair.curvature
        product = product + pair.s * (alpha - beta)

    return product
