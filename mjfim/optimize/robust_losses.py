"""Robust losses of whitened residuals.

Names and formulas are those of `scipy.optimize.least_squares`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from mjfim.arrays import Array

# Smallest threshold [standard deviations] above which a residual counts as an outlier; normal noise
# rarely exceeds it.
MIN_OUTLIER_THRESHOLD = 3.0

# Smallest squared residual in a weight, because zero has no negative power.
SMALLEST_SQUARE = 1e-300


@dataclass(frozen=True, kw_only=True)
class RobustLoss:
    """Loss `scale^2 rho((r / scale)^2)` of a whitened residual r.

    Attributes:
        kind: Function rho. With `linear`, the loss is the square; `huber`, `soft_l1` and `cauchy`
            grow more slowly.
        scale: Residual [standard deviations] above which the loss clearly differs from the square.
    """

    kind: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    scale: float = 3.0

    @property
    def outlier_threshold(self) -> float:
        """Size above which a residual counts as an outlier [standard deviations].

        It is infinite for the loss `linear`.
        """
        return np.inf if self.kind == "linear" else max(self.scale, MIN_OUTLIER_THRESHOLD)

    @property
    def inlier_mean_square(self) -> float:
        """Mean square of standard normal residuals that are not outliers."""
        if self.kind == "linear":
            return 1.0

        # Variance of the normal distribution truncated at both sides.
        limit = self.outlier_threshold
        inside = 1.0 - 2.0 * scipy.special.ndtr(-limit)
        density = np.exp(-0.5 * limit**2) / np.sqrt(2.0 * np.pi)
        return float(1.0 - 2.0 * limit * density / inside)

    def value(self, r: Array) -> float:
        """Sum of the loss over residuals.

        Args:
            r: (...) whitened residuals.

        Returns:
            The sum.
        """
        if self.kind == "linear":
            return float(np.sum(r**2))

        z = (r / self.scale) ** 2
        if self.kind == "huber":
            rho = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
        elif self.kind == "soft_l1":
            rho = 2.0 * (np.sqrt(1.0 + z) - 1.0)
        else:
            rho = np.log1p(z)

        return float(self.scale**2 * rho.sum())

    def weight(self, r: Array) -> Array:
        """Weights of the rows in iteratively reweighted least squares.

        Args:
            r: (...) whitened residuals.

        Returns:
            (...) square roots of the derivative of rho, between 0 and 1.
        """
        z = (r / self.scale) ** 2
        if self.kind == "huber":
            return np.asarray(np.minimum(1.0, np.maximum(z, SMALLEST_SQUARE) ** -0.25))
        if self.kind == "soft_l1":
            return np.asarray((1.0 + z) ** -0.25)
        if self.kind == "cauchy":
            return np.asarray((1.0 + z) ** -0.5)

        return np.ones_like(r)
