"""Priors of a fit to the equation of motion, as rows of its least-squares problem."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.linear_coordinates import LinearCoordinates
from mjfim.model.parameters import ParameterSet

# Standard deviation of a weak prior about the start, in sizes of a coordinate. It holds what the
# recordings do not determine.
HOLD_SIGMA = 100.0


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationPriors:
    """Priors on the linear coordinates.

    Attributes:
        parameters: The p parameters.
        coordinates: Their linear coordinates.
        active: Indices of the parameters that the equations contain.
        start: (p,) linear coordinates at which the search starts.
    """

    parameters: ParameterSet
    coordinates: LinearCoordinates
    active: np.ndarray
    start: Array

    def all(self, x: Array) -> tuple[Array, Array]:
        """Rows of all priors.

        Args:
            x: (p,) linear coordinates.

        Returns:
            (l,) residuals and (l, p) their derivatives.
        """
        stated, weak = self.stated(x), self.weak(x)
        return np.concatenate([stated[0], weak[0]]), np.concatenate([stated[1], weak[1]])

    def stated(self, x: Array) -> tuple[Array, Array]:
        """Rows of the priors of the experiment, as those of `all`."""
        rows = self.parameters.prior_rows
        if not len(rows):
            return np.zeros(0), np.zeros((0, len(x)))
        residual = rows @ (self.coordinates.theta(x) - self.parameters.guess)
        return residual, rows @ self.coordinates.derivative(x)

    def weak(self, x: Array) -> tuple[Array, Array]:
        """Rows of weak priors about the model's inertias and about the start, as those of `all`."""
        residuals, rows = [], []
        plain = np.ones(len(x), dtype=bool)
        for body in self.coordinates.bodies:
            plain[body.columns] = False
            sigma = body.prior_sigma
            found = body.linear_difference(x[body.columns])
            own = np.zeros((len(found.residual), len(x)))
            own[:, body.columns] = found.jacobian / sigma
            rows.append(own)
            residuals.append(found.residual / sigma)

        held = np.intersect1d(np.flatnonzero(plain), self.active)
        weight = 1.0 / (HOLD_SIGMA * self.coordinates.sizes[held])
        residuals.append(weight * (x - self.start)[held])
        rows.append(np.eye(len(x))[held] * weight[:, None])
        return np.concatenate(residuals), np.concatenate(rows)
