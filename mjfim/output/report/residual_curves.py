"""Autocorrelation and spectrum of the residuals of one output, over all recordings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import NORMAL_95, Array
from mjfim.identification.lagged_products import lagged_products
from mjfim.output.distributions import chi_squared_quantiles
from mjfim.records.estimate import Estimate

# Largest number of lags of an autocorrelation.
MAX_LAGS = 100

# Largest number of residuals in one segment of an averaged periodogram (Welch's method).
SEGMENT_LENGTH = 256

# Fewest residuals of a recording that are tested.
MIN_RESIDUALS = 16


@dataclass(frozen=True, eq=False, kw_only=True)
class Residuals:
    """Residuals of one output in units of its noise, by recording.

    Rows count as evenly spaced at each recording's mean rate.

    Attributes:
        parts: (n,) residuals over sigma of each recording that is long enough.
        rate: Mean rate of their rows [Hz].
    """

    parts: tuple[Array, ...]
    rate: float

    @classmethod
    def of(cls, estimate: Estimate, column: int) -> Residuals:
        """Take the residuals of an estimate.

        Args:
            estimate: The estimate.
            column: Number of the output.
        """
        sigma = estimate.sigma.get(estimate.recordings[0].outputs[column], 1.0)
        parts, rates = [], []
        for recording, predicted in zip(estimate.recordings, estimate.predicted, strict=True):
            residual = (recording.y[:, column] - predicted[:, column]) / sigma
            measured = np.isfinite(residual)
            count = int(np.count_nonzero(measured))
            if count >= MIN_RESIDUALS:
                t = recording.t[measured]
                parts.append(residual[measured])
                rates.append((count - 1) / float(t[-1] - t[0]))
        return cls(parts=tuple(parts), rate=float(np.mean(rates)) if rates else 0.0)

    @property
    def count(self) -> int:
        """Number of all residuals."""
        return sum(len(part) for part in self.parts)

    def autocorrelation(self) -> tuple[Array, Array, float]:
        """Return lags (l,) [rows], autocorrelations (l,), and the bound of 95 % of white noise."""
        shortest = min(len(part) for part in self.parts)
        lags = min(MAX_LAGS, shortest // 2)
        products = np.zeros(lags + 1)
        for part in self.parts:
            products += lagged_products(part, lags)

        bound = NORMAL_95 / np.sqrt(self.count)
        values = products[1:] / max(float(products[0]), np.finfo(float).tiny)
        return np.arange(1.0, lags + 1.0), values, float(bound)

    def spectrum(self) -> tuple[Array, Array, tuple[float, float]]:
        """Return frequencies [Hz], power over that of white noise, and its range of 95 %."""
        from mjfim.output.welch import density_of

        # At least four segments of the shortest recording make the curve smooth.
        shortest = min(len(part) for part in self.parts)
        length = max(min(SEGMENT_LENGTH, shortest // 4), MIN_RESIDUALS // 2)
        total, segments = np.zeros(length // 2 + 1), 0
        frequencies = np.zeros(0)
        for part in self.parts:
            # Welch's segments overlap by half.
            own = max(2 * len(part) // length - 1, 1)
            frequencies, power = density_of(part, self.rate, length)
            total += own * power
            segments += own

        # White noise of unit variance has the density 2 / rate on one side. The first and the last
        # frequency have half of it and are left out.
        relative = 0.5 * self.rate * total / segments
        freedom = 2.0 * segments
        low, high = chi_squared_quantiles((0.025, 0.975), freedom)
        return frequencies[1:-1], relative[1:-1], (low / freedom, high / freedom)
