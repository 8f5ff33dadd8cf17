"""Limits on norms of observed vectors: speeds, norms of forces and angles of rotation.

The barrier of a norm r = |y| between -c and c is an even function f(r), so that it is smooth in y
at r = 0 as well:

    gradient   f'(r) / r * y
    Hessian    f'(r) / r * (I - e e') + f''(r) e e'      with e = y / r

An angle a between 0 and pi has the norm r = sin(a/2), see `mjfim.model.limited_elements`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.cost_models import BarrierDerivatives, Bounds

# Norm over its bound below which the limits of the derivatives at zero hold; the error is the
# square of it.
NEARLY_ZERO = 1e-8


@dataclass(frozen=True, kw_only=True)
class Magnitude:
    """The norm of some observed numbers, or the angle whose half has this norm as its sine.

    Attributes:
        columns: Places of the c numbers among all observed numbers.
        is_angle: True for an angle.
    """

    columns: tuple[int, ...]
    is_angle: bool

    def value(self, observed: Array) -> Array:
        """The limited quantity, not negative.

        Args:
            observed: (..., w) observed numbers.

        Returns:
            (...) norms [unit of the numbers], or angles [rad].
        """
        norm = np.linalg.norm(observed[..., self.columns], axis=-1)
        if not self.is_angle:
            return np.asarray(norm)
        return np.asarray(2.0 * np.arcsin(np.minimum(norm, 1.0)))

    def norm_at(self, quantity: float) -> float:
        """The norm at a value of the quantity.

        Args:
            quantity: The limited quantity, at most pi where it is an angle.
        """
        return float(np.sin(0.5 * quantity)) if self.is_angle else quantity

    def barrier(
        self, observed: Array, upper: float, scale: float, *, delta: float, weight: float
    ) -> BarrierDerivatives:
        """Barrier of the norm with its derivatives by the observed numbers.

        Args:
            observed: (..., w) observed numbers.
            upper: Upper bound of the quantity.
            scale: Bound of the quantity before it was tightened.
            delta: Relative distance below which the barrier is relaxed.
            weight: Factor of the barrier of every vector.
        """
        highest, size = np.array([self.norm_at(upper)]), np.array([self.norm_at(scale)])
        bounds = Bounds(lower=-highest, upper=highest, scale=size)

        vectors = observed[..., self.columns]
        norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
        found = bounds.barrier(norm, delta, weight)

        # At zero, slope over norm tends to the curvature.
        is_zero = norm <= NEARLY_ZERO * size
        safe = np.where(is_zero, 1.0, norm)
        across = np.where(is_zero, found.curvature, found.slope / safe)
        direction = np.where(is_zero, 0.0, vectors / safe)

        outer = direction[..., :, None] * direction[..., None, :]
        identity = np.eye(len(self.columns))
        bend = (found.curvature - across)[..., None]
        return BarrierDerivatives(
            value=found.value,
            slope=across * vectors,
            curvature=across[..., None] * identity + bend * outer,
        )
