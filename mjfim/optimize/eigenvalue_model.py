"""A model of the smooth E-criterion that knows how eigenvalues repel and turn into each other. Arrays only.

With r of the smallest eigenvalues and their vectors w_i, the information moves along a step s by `B_ij = d(w_i' I w_j).s`,
off the diagonal too. The model takes `log I` as linear,

    h(s) = 1/q log tr exp(-q (log Lambda + B(s))),

exact to first order, convex, and stiff exactly where the criterion is: where eigenvalues meet. The others are left out:
holding them still would stop a step where the smallest ones reach them, though they move as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

SQUARE = np.sqrt(2.0)


STEPS, SOLVED = 50, 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class EigenvalueModel:
    """The model about a point, in m = r (r + 1) / 2 coordinates of B.

    eigenvalues: (r,), ascending;  power: q;  weight: of the criterion in the cost
    a: (m, N+1, nx), b: (m, N, nu) slopes of the coordinates, those of `B_ii` and of `sqrt(2) B_ij` for i < j
    """

    eigenvalues: Array
    power: float
    weight: float
    a: Array
    b: Array

    def gradient(self, d: Array) -> Array:
        """(m,) derivative of the model at coordinates d: (m,)."""
        return self._weigh(d)[1]

    def value(self, d: Array) -> float:
        """h at coordinates d: (m,), less its value at 0."""
        return self._weigh(d)[0] - self._weigh(np.zeros_like(d))[0]

    def _weigh(self, d: Array) -> tuple[float, Array]:
        q, logs = self.power, np.log(self.eigenvalues / self.eigenvalues[0])
        moved, vectors = np.linalg.eigh(np.diag(logs) + symmetric_matrix(d, len(logs)))
        weights = np.exp(-q * (moved - moved[0]))
        total = weights.sum()
        P = (vectors * (weights / total)) @ vectors.T
        return self.weight * float(
            np.log(total) / q - moved[0]
        ), -self.weight * symmetric_coordinates(P)

    def minimising_gradient(self, d0: Array, spread: Array) -> Array:
        """The gradient w at the minimum of `h(d) + 1/2 (d - d0)' spread^-1 (d - d0)`: there `d = d0 - spread w`.

        Newton's method in `d = d0 + L y`, `L L' = spread`. spread: (m, m), positive semidefinite
        """
        values, vectors = np.linalg.eigh(spread)
        L = vectors * np.sqrt(np.maximum(values, 0.0))
        y = np.zeros(len(d0))
        for _ in range(STEPS):
            g = y + L.T @ self.gradient(d0 + L @ y)
            if np.abs(g).max() <= SOLVED * max(1.0, np.abs(y).max()):
                break
            H = np.eye(len(y)) + L.T @ self._hessian(d0 + L @ y) @ L
            step = -np.linalg.solve(0.5 * (H + H.T), g)
            here, length = self._pulled(y, L, d0), 1.0
            while (
                self._pulled(y + length * step, L, d0) > here + 1e-4 * length * float(g @ step)
                and length > 1e-8
            ):
                length *= 0.5
            y = y + length * step
        return self.gradient(d0 + L @ y)

    def _pulled(self, y: Array, L: Array, d0: Array) -> float:
        return self._weigh(d0 + L @ y)[0] + 0.5 * float(y @ y)

    def _hessian(self, d: Array) -> Array:
        """(m, m) by differences of the gradient, in so few coordinates the cheapest way."""
        step = 1e-5 / max(1.0, self.power)
        moves = step * np.eye(len(d))
        return np.stack(
            [(self.gradient(d + move) - self.gradient(d - move)) / (2.0 * step) for move in moves]
        )


def symmetric_matrix(d: Array, r: int) -> Array:
    """(r, r) symmetric matrix of coordinates (m,)."""
    full = np.zeros((r, r))
    rows, columns = np.triu_indices(r)
    scale = np.where(rows == columns, 1.0, 1.0 / SQUARE)
    full[rows, columns] = d * scale
    full[columns, rows] = d * scale
    return full


def symmetric_coordinates(full: Array) -> Array:
    """(m,) coordinates of a symmetric matrix (r, r), such that their scalar product is that of matrices."""
    rows, columns = np.triu_indices(len(full))
    return np.asarray(full[rows, columns] * np.where(rows == columns, 1.0, SQUARE))


def divided_log_differences(values: Array) -> Array:
    """(r, r) divided differences of the logarithm: what turns a change of I into one of log I."""
    ratio = values[:, None] / values
    near = np.abs(ratio - 1.0) < 1e-6
    safe = np.where(near, 2.0, ratio)
    return np.where(near, 1.0, np.log(safe) / (safe - 1.0)) / values
