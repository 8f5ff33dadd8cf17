"""Measurement noise: its covariance over the outputs, when each output is sampled, and the whitening by both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from mjfim.arrays import Array


@dataclass(frozen=True, eq=False)
class Noise:
    """Gaussian, white in time, correlated between outputs of one sample.

    covariance: (ny, ny);  strides: (ny,) every strides[i]-th sample holds output i (k = 0, the start, is not measured)
    Outputs that are correlated share their stride.
    """

    covariance: Array
    strides: np.ndarray

    @staticmethod
    def independent(sigma: Sequence[float] | Array, stride: int = 1) -> Noise:
        """Uncorrelated outputs of standard deviations sigma: (ny,), all sampled alike."""
        return Noise(np.diag(np.asarray(sigma, dtype=np.float64) ** 2), np.full(len(sigma), stride))

    @cached_property
    def sigma(self) -> Array:
        """(ny,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def correlated(self) -> bool:
        """True where outputs are correlated."""
        return bool(np.count_nonzero(self.covariance) > len(self.covariance))

    @cached_property
    def factor(self) -> Array:
        """(ny, ny) lower L with `L L' = covariance`."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def precision(self) -> Array:
        """(ny, ny) inverse of the covariance."""
        return np.asarray(np.linalg.inv(self.covariance))

    def every_sample(self, stride: int) -> Noise:
        """The same information per second on another grid, where every output is measured at every sample.

        stride: of the measurement rate to which information is related
        """
        slower = np.sqrt(self.strides / stride)
        return Noise(self.covariance * np.outer(slower, slower), np.ones_like(self.strides))

    def measured(self, N: int) -> Array:
        """(N+1, ny) 1 where an output is measured, else 0."""
        k = np.arange(N + 1)[:, None]
        return np.asarray((k % self.strides == 0) & (k > 0), dtype=np.float64)

    def whiten(self, values: Array) -> Array:
        """`L^-1 y` over the axis of outputs. values: (N+1, ny, ...)"""
        if not self.correlated:
            return np.asarray(values / self.sigma.reshape(-1, *[1] * (values.ndim - 2)))
        rows = np.moveaxis(values, 1, 0)
        flat = solve_triangular(self.factor, rows.reshape(len(rows), -1), lower=True)
        return np.asarray(np.moveaxis(flat.reshape(rows.shape), 0, 1))

    def rows(self, values: Array) -> Array:
        """Whitened measured values one after the other, (n, ...), from (N+1, ny, ...)."""
        return np.asarray(self.whiten(values)[self.measured(len(values) - 1) > 0])

    def whiten_present(self, values: Array, present: np.ndarray) -> Array:
        """Whitened values where present: (N+1, ny), (n, ...); what is missing is marginalised out."""
        if not self.correlated:
            return np.asarray(self.whiten(values)[present])
        out = np.zeros(values.shape)
        for pattern in np.unique(present, axis=0):
            hit = (present == pattern).all(axis=1)
            if pattern.any():
                some = Noise(self.covariance[np.ix_(pattern, pattern)], self.strides[pattern])
                out[np.ix_(hit, pattern)] = some.whiten(values[np.ix_(hit, pattern)])
        return np.asarray(out[present])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """(count, ny) noise."""
        return np.asarray(rng.standard_normal((count, len(self.factor))) @ self.factor.T)
