"""Time delay of the outputs: interpolation between samples as a linear operator, and its derivative by the delay."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mjfim.arrays import Array

NODES = 4  # Number of samples through which the cubic polynomial of the interpolation passes.


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputDelay:
    """Values `y(t - d)` from samples y_k by cubic Lagrange interpolation, of lower order below four samples.

    Before the first sample the first value is held, after the last sample the last one.

    Attributes:
        weights: (M, N+1) sparse interpolation weights; M = N+1 if values are wanted at the samples
            themselves.
        weight_slopes: (M, N+1) sparse derivative of the weights by d [1/s].
    """

    weights: Any
    weight_slopes: Any

    @staticmethod
    def on_grid(samples: int, delay: float, dt: float) -> OutputDelay:
        """Delayed values at the samples themselves.

        Args:
            samples: Number of samples N+1.
            delay: Delay d [s].
            dt: Sample period [s].

        Returns:
            The operator.
        """
        wanted = np.arange(samples, dtype=np.float64) - delay / dt
        return OutputDelay.at(wanted, samples, dt)

    @staticmethod
    def at(wanted: Array, samples: int, dt: float) -> OutputDelay:
        """Values at any times, for outputs that are read between the samples.

        Args:
            wanted: (M,) places `(t - d) / dt` in samples.
            samples: Number of samples N+1.
            dt: Sample period [s].

        Returns:
            The operator.
        """
        place = np.clip(wanted, 0.0, samples - 1.0)
        count = min(NODES, samples)

        # The nodes lie around the place, moved inwards at both ends.
        first = np.clip(np.floor(place).astype(int) - 1, 0, samples - count)
        nodes = first[:, None] + np.arange(count)
        value, slope = _lagrange(place[:, None] - first[:, None], count)

        # Where the first or last value is held, a change of the delay changes nothing.
        inside = (wanted >= 0.0) & (wanted <= samples - 1.0)
        slope *= np.where(inside, -1.0 / dt, 0.0)[:, None]

        rows = np.repeat(np.arange(len(wanted)), count)
        places = (rows, nodes.ravel())
        shape = (len(wanted), samples)
        return OutputDelay(
            weights=csr_array((value.ravel(), places), shape=shape),
            weight_slopes=csr_array((slope.ravel(), places), shape=shape),
        )

    def apply(self, values: Array) -> Array:
        """Delayed values.

        Args:
            values: (N+1, ...) samples.

        Returns:
            (M, ...) delayed values.
        """
        return _apply(self.weights, values)

    def derivative(self, values: Array) -> Array:
        """Derivative of the delayed values by the delay.

        Args:
            values: (N+1, ...) samples.

        Returns:
            (M, ...) derivative [unit of the values / s].
        """
        return _apply(self.weight_slopes, values)

    def apply_transposed(self, values: Array) -> Array:
        """Adjoint of `apply`.

        Args:
            values: (M, ...) covector of the delayed values.

        Returns:
            (N+1, ...) covector of the samples.
        """
        return _apply(self.weights.T, values)

    def derivative_transposed(self, values: Array) -> Array:
        """Adjoint of `derivative`.

        Args:
            values: (M, ...) covector of the derivative.

        Returns:
            (N+1, ...) covector of the samples.
        """
        return _apply(self.weight_slopes.T, values)


def _apply(operator: Any, values: Array) -> Array:
    """Apply a sparse operator (M, N+1) to the first axis of values: (N+1, ...)."""
    flat = operator @ values.reshape(len(values), -1)
    return np.asarray(flat.reshape(operator.shape[0], *values.shape[1:]))


def _lagrange(s: Array, count: int) -> tuple[Array, Array]:
    """Weights of the nodes 0, 1, ..., count - 1 at s: (n, 1), and their derivatives by s, both (n, count)."""
    value = np.ones((len(s), count))
    slope = np.zeros((len(s), count))
    for i in range(count):
        others = [j for j in range(count) if j != i]
        scale = np.prod([i - j for j in others])
        factors = np.concatenate([s - j for j in others], axis=1)
        value[:, i] = factors.prod(axis=1) / scale

        # Product rule: the sum over the factors that are left out.
        products = [np.delete(factors, k, axis=1).prod(axis=1) for k in range(count - 1)]
        slope[:, i] = sum(products) / scale
    return value, slope
