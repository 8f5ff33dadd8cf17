"""Time delay of the outputs.

It is interpolation between samples, written as a linear operator, with its derivative by the delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array

# Number of samples through which the cubic polynomial of the interpolation passes.
NODES = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class OutputDelay:
    """Values `y(t - d)` from samples y_k, by cubic Lagrange interpolation.

    The order is lower where there are fewer than four samples. Before the first sample the first
    value is held, after the last sample the last one.

    Attributes:
        nodes: (M, n) ascending indices of the samples that each value is made of; M = N+1 if values
            are wanted at the samples themselves.
        node_weights: (M, n) interpolation weights of these samples.
        node_slopes: (M, n) derivative of the weights by d [1/s].
        samples: Number of samples N+1.
    """

    nodes: np.ndarray
    node_weights: Array
    node_slopes: Array
    samples: int

    @cached_property
    def weights(self) -> Any:
        """(M, N+1) sparse interpolation weights."""
        return self._sparse(self.node_weights)

    @cached_property
    def weight_slopes(self) -> Any:
        """(M, N+1) sparse derivative of the weights by d [1/s]."""
        return self._sparse(self.node_slopes)

    def _sparse(self, of_nodes: Array) -> Any:
        """(M, N+1) sparse operator with these numbers at the nodes: (M, n).

        All rows have the same number of nodes, so that the operator needs no sorting.
        """
        rows, count = of_nodes.shape
        row_starts = np.arange(rows + 1) * count
        return scipy.sparse.csr_array(
            (of_nodes.ravel(), self.nodes.ravel(), row_starts), shape=(rows, self.samples)
        )

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
        """Delayed values at any times, for outputs that are measured between the samples.

        Args:
            wanted: (M,) places `(t - d) / dt` in samples.
            samples: Number of samples N+1.
            dt: Sample period [s].

        Returns:
            The operator.
        """
        place = np.clip(wanted, 0.0, samples - 1.0)
        count = min(NODES, samples)

        # No node lies after the sample at or behind the place: a controller feeds the noise of a
        # measurement back into the later samples, and a slope from these would be correlated with
        # that noise. At both ends, the nodes are shifted to existing samples.
        first = np.clip(np.ceil(place).astype(int) - (count - 1), 0, samples - count)
        nodes = first[:, None] + np.arange(count)
        value, slope = _lagrange(place[:, None] - first[:, None], count)

        # Where the first or last value is held, a change of the delay changes nothing.
        inside = (wanted >= 0.0) & (wanted <= samples - 1.0)
        slope *= np.where(inside, -1.0 / dt, 0.0)[:, None]

        return OutputDelay(nodes=nodes, node_weights=value, node_slopes=slope, samples=samples)

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
    rows = values.reshape(len(values), -1)
    applied = operator @ rows

    shape = (operator.shape[0], *values.shape[1:])
    return np.asarray(applied.reshape(shape))


def _lagrange(s: Array, count: int) -> tuple[Array, Array]:
    """Lagrange weights of equidistant nodes.

    Args:
        s: (n, 1) places, in units of the distance between two nodes.
        count: Number of nodes; they are at 0, 1, 2 and so on.

    Returns:
        (n, count) weights, and (n, count) their derivatives by s.
    """
    # Values of all nodes are contiguous here, because NumPy is slow along short rows.
    value = np.ones((count, len(s)))
    slope = np.zeros((count, len(s)))
    for i in range(count):
        others = [j for j in range(count) if j != i]
        scale = math.prod(i - j for j in others)
        factors = [s[:, 0] - j for j in others]
        value[i] = math.prod(factors, start=value[i]) / scale

        # The product rule: a sum of products, each without one of the factors.
        for k in range(count - 1):
            slope[i] += math.prod(factors[:k] + factors[k + 1 :])
        slope[i] /= scale
    return value.T, slope.T
