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
from functools import cache, cached_property

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
        return self._changed(d).gradient

    def hessian(self, d: Array) -> Array:
        """Second derivative of the model.

        Args:
            d: (m,) coordinates of B.

        Returns:
            (m, m) derivative of the gradient by the coordinates.
        """
        return self._changed(d).hessian

    def value(self, d: Array) -> float:
        """Change of the model from the point about which it was made.

        Args:
            d: (m,) coordinates of B.

        Returns:
            h(d) - h(0).
        """
        return self._changed(d).value - self._changed(np.zeros_like(d)).value

    @cached_property
    def _logs(self) -> Array:
        """(r, r) diagonal matrix of the logarithms of the eigenvalues over the smallest one."""
        return np.diag(np.log(self.eigenvalues / self.eigenvalues[0]))

    def _changed(self, d: Array) -> _ChangedLogs:
        """Eigenvalues of the changed logarithm at coordinates d: (m,)."""
        changed = self._logs + symmetric_matrix(d, len(self.eigenvalues))
        logs, vectors = np.linalg.eigh(changed)
        return _ChangedLogs(logs=logs, vectors=vectors, power=self.power, weight=self.weight)

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
        here = self._changed(d0)
        for _ in range(MAX_NEWTON_STEPS):
            g = y + L.T @ here.gradient
            if np.abs(g).max() <= NEWTON_TOLERANCE * max(1.0, np.abs(y).max()):
                break

            H = np.eye(len(y)) + L.T @ here.hessian @ L
            step = -np.linalg.solve(0.5 * (H + H.T), g)
            y, here = self._line_search(y, here, step, float(g @ step), L, d0)

        return here.gradient

    def _line_search(
        self, y: Array, here: _ChangedLogs, step: Array, slope: float, L: Array, d0: Array
    ) -> tuple[Array, _ChangedLogs]:
        """Halve a step until the proximal objective falls sufficiently.

        The objective is the model at `d0 + L y` plus `1/2 |y|^2`.

        Args:
            y: (m,) point at which the step begins.
            here: The model at this point.
            step: (m,) Newton step.
            slope: Directional derivative of the objective along the step, negative.
            L: (m, m) square root of spread.
            d0: (m,) centre of the proximal term.

        Returns:
            The point after the step, and the model there.
        """
        before = here.value + 0.5 * float(y @ y)
        fraction = 1.0
        while True:
            new = y + fraction * step
            there = self._changed(d0 + L @ new)
            after = there.value + 0.5 * float(new @ new)
            if after <= before + SUFFICIENT_DECREASE * fraction * slope:
                return new, there

            fraction *= 0.5
            if fraction <= MIN_NEWTON_FRACTION:
                return new, there


@dataclass(frozen=True, kw_only=True, eq=False)
class _ChangedLogs:
    """The model of a logarithm of the information that has changed.

    Attributes:
        logs: (r,) eigenvalues of the changed logarithm, ascending, up to a constant.
        vectors: (r, r) their eigenvectors, in columns.
        power: Power q of the smooth E-criterion.
        weight: Weight of the criterion in the cost.
    """

    logs: Array
    vectors: Array
    power: float
    weight: float

    @cached_property
    def _exponentials(self) -> Array:
        """(r,) `exp(-q log)` of the eigenvalues over that of the smallest one.

        The smallest eigenvalue is factored out, so that they neither overflow nor vanish.
        """
        return np.asarray(np.exp(-self.power * (self.logs - self.logs[0])))

    @cached_property
    def _shares(self) -> Array:
        """(r,) shares of the eigenvalues in the sum of exponentials."""
        return np.asarray(self._exponentials / self._exponentials.sum())

    @cached_property
    def value(self) -> float:
        """The model, up to a constant."""
        log_sum = np.log(self._exponentials.sum()) / self.power - self.logs[0]
        return self.weight * float(log_sum)

    @cached_property
    def gradient(self) -> Array:
        """(m,) derivative by the coordinates of B."""
        P = (self.vectors * self._shares) @ self.vectors.T
        return -self.weight * symmetric_coordinates(P)

    @cached_property
    def hessian(self) -> Array:
        """(m, m) second derivative by the coordinates of B.

        The derivative of the matrix exponential has divided differences of the exponentials as its
        entries, in the basis of the eigenvectors (Daleckii & Krein).
        """
        # The divided difference of two shares is the larger one times a factor that is q where the
        # eigenvalues are equal.
        distance = np.abs(self.logs[:, None] - self.logs)
        is_equal = self.power * distance < EQUAL_EIGENVALUES
        safe = np.where(is_equal, 1.0, distance)
        factor = np.where(is_equal, self.power, -np.expm1(-self.power * distance) / safe)
        divided = np.maximum(self._shares[:, None], self._shares) * factor

        units = self.vectors.T @ symmetric_units(len(self.logs)) @ self.vectors
        curvature = np.einsum("aij,ij,bij->ab", units, divided, units)
        slopes = np.einsum("aii,i->a", units, self._shares)
        return np.asarray(self.weight * (curvature - self.power * np.outer(slopes, slopes)))


@cache
def symmetric_units(r: int) -> Array:
    """Symmetric matrices whose coordinates are the unit vectors.

    Args:
        r: Size of the matrices.

    Returns:
        (m, r, r) matrices, m = r (r + 1) / 2; the array is shared and cannot be written.
    """
    rows, columns = np.triu_indices(r)
    entries = np.where(rows == columns, 1.0, 1.0 / SQRT_2)

    units = np.zeros((len(rows), r, r))
    each = np.arange(len(rows))
    units[each, rows, columns] = entries
    units[each, columns, rows] = entries
    units.flags.writeable = False
    return units


def symmetric_matrix(d: Array, r: int) -> Array:
    """Symmetric matrix of given coordinates.

    Args:
        d: (m,) coordinates, m = r (r + 1) / 2.
        r: Size of the matrix.

    Returns:
        (r, r) matrix.
    """
    return np.asarray((d @ symmetric_units(r).reshape(-1, r * r)).reshape(r, r))


def symmetric_coordinates(full: Array) -> Array:
    """Coordinates of a symmetric matrix, such that their scalar product is that of matrices.

    Args:
        full: (r, r) symmetric matrix.

    Returns:
        (m,) coordinates: diagonal entries, and sqrt(2) times the entries above the diagonal, row by
        row.
    """
    r = len(full)
    return np.asarray(symmetric_units(r).reshape(-1, r * r) @ full.reshape(r * r))


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
