"""Outputs that lag by a time delay: interpolation between samples as a linear operator, and its derivative by the delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mjfim.arrays import Array


@dataclass(frozen=True, eq=False)
class OutputDelay:
    """`y(t_k - d)` from samples y_k by cubic Lagrange interpolation (of lower order below 4 samples).

    What was before the start is the start.

    shift: (M, N+1) sparse;  slope: (M, N+1) sparse, its derivative by d [1/s];  M = N+1 where every sample is wanted
    """

    shift: Any
    slope: Any

    @staticmethod
    def on_grid(samples: int, delay: float, dt: float) -> OutputDelay:
        """samples: N+1;  delay: d [s];  dt: sample period [s]"""
        return OutputDelay.at(np.arange(samples, dtype=np.float64) - delay / dt, samples, dt)

    @staticmethod
    def at(wanted: Array, samples: int, dt: float) -> OutputDelay:
        """Of outputs that were read at other times. wanted: (M,) t/dt - d/dt in samples;  samples: N+1"""
        place = np.clip(wanted, 0.0, samples - 1.0)
        count = min(4, samples)
        first = np.clip(np.floor(place).astype(int) - 1, 0, samples - count)
        nodes = first[:, None] + np.arange(count)
        value, slope = _lagrange(place[:, None] - first[:, None], count)
        inside = (wanted >= 0.0) & (wanted <= samples - 1.0)
        slope *= np.where(inside, -1.0 / dt, 0.0)[:, None]
        rows = np.repeat(np.arange(len(wanted)), count)
        return OutputDelay(
            *(
                csr_array((w.ravel(), (rows, nodes.ravel())), shape=(len(wanted), samples))
                for w in (value, slope)
            )
        )

    def apply(self, values: Array) -> Array:
        """Lagged values, (M, ...). values: (N+1, ...)"""
        return _apply(self.shift, values)

    def derivative(self, values: Array) -> Array:
        """Derivative of the lagged values by the delay. values: (N+1, ...)"""
        return _apply(self.slope, values)

    def apply_transposed(self, values: Array) -> Array:
        """Adjoint of `apply`."""
        return _apply(self.shift.T, values)

    def derivative_transposed(self, values: Array) -> Array:
        """Adjoint of `derivative`."""
        return _apply(self.slope.T, values)


def _apply(operator: Any, values: Array) -> Array:
    return np.asarray(operator @ values.reshape(len(values), -1)).reshape(
        operator.shape[0], *values.shape[1:]
    )


def _lagrange(s: Array, count: int) -> tuple[Array, Array]:
    """Weights of the nodes 0, 1, ..., count - 1 at s: (n, 1), and their derivatives by s, both (n, count)."""
    value, slope = np.ones((len(s), count)), np.zeros((len(s), count))
    for i in range(count):
        others = [j for j in range(count) if j != i]
        scale = np.prod([i - j for j in others])
        factors = np.concatenate([s - j for j in others], axis=1)
        value[:, i] = factors.prod(axis=1) / scale
        slope[:, i] = (
            sum(np.delete(factors, k, axis=1).prod(axis=1) for k in range(count - 1)) / scale
        )
    return value, slope
