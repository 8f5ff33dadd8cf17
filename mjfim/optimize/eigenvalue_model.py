"""A model of the smooth E-criterion that includes the interaction of close eigenvalues.

With the r smallest eigenvalues Lambda and their eigenvectors w_i, a step s changes the information
by `B_ij = d(w_i' I w_j).s`, also off the diagonal. The model assumes that `log I` is linear in s:

    h(s) = 1/q log tr exp(-q (log Lambda + B(s))).

It is exact to first order and convex. Its curvature is large where eigenvalues meet, like that of
the criterion. Larger eigenvalues are left out. If the model held them constant, it would stop a
step where the smallest eigenvalues reach them, although the larger ones change as well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array

# Weight of off-diagonal entries in the coordinates of a symmetric matrix; these entries count twice
# in the scalar product of matrices.
SQRT_2 = np.sqrt(2.0)

# Largest number of Newton steps of the proximal problem.
MAX_NEWTON_STEPS = 50

# Gradient of the proximal problem, relative to its solution, below which it is solved.
NEWTON_TOLERANCE = 1e-10

# Smallest accepted share of the predicted decrease of a Newton step (Armijo's rule).
SUFFICIENT_DECREASE = 1e-4

# Shortest fraction of a Newton step.
MIN_NEWTON_FRACTION = 1e-8

# Step of the central differences of the gradient, for power 1.
DIFFERENCE_STEP = 1e-5

# Relative distance of two eigenvalues below which their divided difference is the derivative.
EQUAL_EIGENVALUES = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class EigenvalueModel:
    """The model about a point, in the m = r (r + 1) / 2 coordinates of B.

    Attributes:
        eigenvalues: (r,) smallest eigenvalues of the information, ascending.
        power: Power q of the smooth E-criterion.
        weight: Weight of the criterion in the cost.
        a: (m, N+1, nx) derivative of each coordinate by the state: of `B_ii`, and of `sqrt(2) B_ij`
            for i < j.
        b: (m, N, nu) derivative of each coordinate by the control.
    """

    eigenvalues: Array
    power: float
    weight: float
    a: Array
    b: Array

    def gradient(self, d: Array) -> Array:
        """Gradient of the model.

        Args:
            d: (m,) coordinates of B.

        Returns:
            (m,) derivative by the coordinates.
        """
        return self._value_and_gradient(d)[1]

    def value(self, d: Array) -> float:
        """Change of the model from the point about which it was made.

        Args:
            d: (m,) coordinates of B.

        Returns:
            h(d) - h(0).
        """
        zero = np.zeros_like(d)
        return self._value_and_gradient(d)[0] - self._value_and_gradient(zero)[0]

    def _value_and_gradient(self, d: Array) -> tuple[float, Array]:
        """The model, up to a constant, and its gradient: (m,), at coordinates d: (m,)."""
        logs = np.log(self.eigenvalues / self.eigenvalues[0])
        changed = np.diag(logs) + symmetric_matrix(d, len(logs))
        changed_logs, vectors = np.linalg.eigh(changed)
        smallest = changed_logs[0]

        # The smallest eigenvalue is factored out, so that the exponentials neither overflow nor
        # vanish.
        exponentials = np.exp(-self.power * (changed_logs - smallest))
        total = exponentials.sum()
        log_sum = float(np.log(total) / self.power - smallest)

        shares = exponentials / total
        P = (vectors * shares) @ vectors.T
        return self.weight * log_sum, -self.weight * symmetric_coordinates(P)

    def minimising_gradient(self, d0: Array, spread: Array) -> Array:
        """Gradient of the model at the minimum of `h(d) + 1/2 (d - d0)' spread^-1 (d - d0)`.

        With the returned gradient w, the minimum is `d = d0 - spread w`. Newton's method is applied
        to y in `d = d0 + L y`, with `L L' = spread`, which also works where spread is singular.

        Args:
            d0: (m,) centre of the proximal term.
            spread: (m, m) positive semidefinite matrix.

        Returns:
            (m,) the gradient w.
        """
        values, vectors = np.linalg.eigh(spread)
        L = vectors * np.sqrt(np.maximum(values, 0.0))

        y = np.zeros(len(d0))
        for _ in range(MAX_NEWTON_STEPS):
            g = y + L.T @ self.gradient(d0 + L @ y)
            if np.abs(g).max() <= NEWTON_TOLERANCE * max(1.0, np.abs(y).max()):
                break

            H = np.eye(len(y)) + L.T @ self._hessian(d0 + L @ y) @ L
            step = -np.linalg.solve(0.5 * (H + H.T), g)
            y = self._line_search(y, step, float(g @ step), L, d0)

        return self.gradient(d0 + L @ y)

    def _line_search(self, y: Array, step: Array, slope: float, L: Array, d0: Array) -> Array:
        """(m,) point after a step that is halved until the proximal objective falls sufficiently.

        Args:
            y: (m,) point at which the step begins.
            step: (m,) Newton step.
            slope: Directional derivative of the objective along the step, negative.
            L: (m, m) square root of spread.
            d0: (m,) centre of the proximal term.
        """
        here = self._proximal_objective(y, L, d0)
        fraction = 1.0
        while fraction > MIN_NEWTON_FRACTION:
            there = self._proximal_objective(y + fraction * step, L, d0)
            if there <= here + SUFFICIENT_DECREASE * fraction * slope:
                break
            fraction *= 0.5

        return y + fraction * step

    def _proximal_objective(self, y: Array, L: Array, d0: Array) -> float:
        """The model at `d0 + L y` plus `1/2 |y|^2`."""
        return self._value_and_gradient(d0 + L @ y)[0] + 0.5 * float(y @ y)

    def _hessian(self, d: Array) -> Array:
        """(m, m) Hessian at d: (m,), by central differences of the gradient.

        Differences are fast enough, because there are few coordinates.
        """
        h = DIFFERENCE_STEP / max(1.0, self.power)
        rows = []
        for move in h * np.eye(len(d)):
            change = self.gradient(d + move) - self.gradient(d - move)
            rows.append(change / (2.0 * h))
        return np.stack(rows)


def symmetric_matrix(d: Array, r: int) -> Array:
    """Symmetric matrix of given coordinates.

    Args:
        d: (m,) coordinates, m = r (r + 1) / 2.
        r: Size of the matrix.

    Returns:
        (r, r) matrix.
    """
    rows, columns = np.triu_indices(r)
    entries = d * np.where(rows == columns, 1.0, 1.0 / SQRT_2)

    full = np.zeros((r, r))
    full[rows, columns] = entries
    full[columns, rows] = entries
    return full


def symmetric_coordinates(full: Array) -> Array:
    """Coordinates of a symmetric matrix, such that their scalar product is that of matrices.

    Args:
        full: (r, r) symmetric matrix.

    Returns:
        (m,) coordinates: diagonal entries, and sqrt(2) times the entries above the diagonal, row by
        row.
    """
    rows, columns = np.triu_indices(len(full))
    return np.asarray(full[rows, columns] * np.where(rows == columns, 1.0, SQRT_2))


def divided_log_differences(values: Array) -> Array:
    """Divided differences of the logarithm of eigenvalues.

    They turn the change of a matrix into the change of its logarithm.

    Args:
        values: (r,) positive eigenvalues.

    Returns:
        (r, r) `(log a - log b) / (a - b)` of every pair of eigenvalues, 1 / a where they are equal.
    """
    ratio = values[:, None] / values
    equal = np.abs(ratio - 1.0) < EQUAL_EIGENVALUES
    safe = np.where(equal, 2.0, ratio)
    return np.where(equal, 1.0, np.log(safe) / (safe - 1.0)) / values
