"""Measurement noise: covariance of the outputs, sampling of the measurements, and whitening."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from mjfim.arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Noise:
    """Gaussian noise, white in time, correlated between the outputs of one sample.

    Attributes:
        covariance: (ny, ny) covariance [y-unit y-unit].
        strides: (ny,) strides; every strides[i]-th sample measures output i, except the initial
            state k = 0. Correlated outputs share their stride.
    """

    covariance: Array
    strides: np.ndarray

    @staticmethod
    def independent(sigma: Sequence[float] | Array, stride: int = 1) -> Noise:
        """Noise of uncorrelated outputs that are measured at the same samples.

        Args:
            sigma: (ny,) standard deviations [y-unit].
            stride: Stride of all outputs.

        Returns:
            The noise.
        """
        covariance = np.diag(np.asarray(sigma, dtype=np.float64) ** 2)
        return Noise(covariance=covariance, strides=np.full(len(sigma), stride))

    @cached_property
    def sigma(self) -> Array:
        """(ny,) standard deviations [y-unit]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @cached_property
    def correlated(self) -> bool:
        """True if any two outputs are correlated."""
        return bool(np.count_nonzero(self.covariance) > len(self.covariance))

    @cached_property
    def factor(self) -> Array:
        """(ny, ny) lower triangular L with `L L' = covariance` [y-unit]."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def precision(self) -> Array:
        """(ny, ny) inverse of the covariance [1 / y-unit y-unit]."""
        return np.asarray(np.linalg.inv(self.covariance))

    def at_every_sample(self, stride: int) -> Noise:
        """Noise on a grid that measures every output at every sample.

        The information per second is equal to that of this noise.

        Args:
            stride: Stride of the measurement rate to which information is related.

        Returns:
            The noise on the other grid.
        """
        scale = np.sqrt(self.strides / stride)
        return Noise(
            covariance=self.covariance * np.outer(scale, scale), strides=np.ones_like(self.strides)
        )

    def measured(self, N: int) -> Array:
        """Mask of the measured samples.

        Args:
            N: Number of control samples.

        Returns:
            (N+1, ny) 1 where an output is measured, else 0.
        """
        k = np.arange(N + 1)[:, None]
        return np.asarray((k % self.strides == 0) & (k > 0), dtype=np.float64)

    def whiten(self, values: Array) -> Array:
        """Whitened values `L^-1 y`.

        Args:
            values: (N+1, ny, ...) values [y-unit].

        Returns:
            (N+1, ny, ...) whitened values.
        """
        if not self.correlated:
            return np.asarray(values / self.sigma.reshape(-1, *[1] * (values.ndim - 2)))

        rows = np.moveaxis(values, 1, 0)
        flat = scipy.linalg.solve_triangular(self.factor, rows.reshape(len(rows), -1), lower=True)
        return np.asarray(np.moveaxis(flat.reshape(rows.shape), 0, 1))

    def whitened_rows(self, values: Array) -> Array:
        """Whitened values of all measurements, one after the other.

        Args:
            values: (N+1, ny, ...) values [y-unit].

        Returns:
            (n, ...) whitened values of the n measurements.
        """
        return np.asarray(self.whiten(values)[self.measured(len(values) - 1) > 0])

    def whiten_present(self, values: Array, present: np.ndarray) -> Array:
        """Whitened values of the measurements that are present; missing ones are marginalised out.

        Args:
            values: (N+1, ny, ...) values [y-unit].
            present: (N+1, ny) True where a measurement is present.

        Returns:
            (n, ...) whitened values of the n measurements that are present.
        """
        if not self.correlated:
            return np.asarray(self.whiten(values)[present])

        # The marginal covariance, and with it the factor, depends on which outputs are present at a
        # sample. All samples with an equal pattern are whitened together.
        whitened = np.zeros(values.shape)
        for pattern in np.unique(present, axis=0):
            if not pattern.any():
                continue
            samples = (present == pattern).all(axis=1)
            marginal = Noise(
                covariance=self.covariance[np.ix_(pattern, pattern)], strides=self.strides[pattern]
            )
            block = np.ix_(samples, pattern)
            whitened[block] = marginal.whiten(values[block])
        return np.asarray(whitened[present])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw noise.

        Args:
            count: Number of samples.
            rng: Random generator.

        Returns:
            (count, ny) noise [y-unit].
        """
        return np.asarray(rng.standard_normal((count, len(self.factor))) @ self.factor.T)
