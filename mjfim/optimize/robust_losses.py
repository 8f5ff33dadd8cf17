"""Losses of whitened residuals, by the names and formulas of `scipy.optimize.least_squares`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import norm

from mjfim.arrays import Array

RARE = 3.0  # standard deviations


@dataclass(frozen=True)
class Loss:
    """`scale^2 rho((r / scale)^2)`; scale: standard deviations at which it leaves the square."""

    kind: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    scale: float = 3.0

    @property
    def outlier(self) -> float:
        """Standard deviations beyond which a residual says nothing of the noise: normal noise is hardly ever there."""
        return np.inf if self.kind == "linear" else max(self.scale, RARE)

    @property
    def inliers(self) -> float:
        """Mean square of standard normal residuals that are no outliers."""
        if self.kind == "linear":
            return 1.0
        return float(
            1.0 - 2.0 * self.outlier * norm.pdf(self.outlier) / (1.0 - 2.0 * norm.sf(self.outlier))
        )

    def value(self, r: Array) -> float:
        """Sum over residuals of any shape."""
        z = (r / self.scale) ** 2
        if self.kind == "linear":
            return float(np.sum(r**2))
        if self.kind == "huber":
            rho = np.where(z <= 1.0, z, 2.0 * np.sqrt(z) - 1.0)
        elif self.kind == "soft_l1":
            rho = 2.0 * (np.sqrt(1.0 + z) - 1.0)
        else:
            rho = np.log1p(z)
        return float(self.scale**2 * rho.sum())

    def weight(self, r: Array) -> Array:
        """Root of the derivative of rho: what each row is multiplied with (iterated reweighting)."""
        z = (r / self.scale) ** 2
        if self.kind == "huber":
            return np.asarray(np.minimum(1.0, np.maximum(z, 1e-300) ** -0.25))
        if self.kind == "soft_l1":
            return np.asarray((1.0 + z) ** -0.25)
        if self.kind == "cauchy":
            return np.asarray((1.0 + z) ** -0.5)
        return np.ones_like(r)
