"""The prior that the inertias of the model, for example from CAD, are for a fit.

A body whose whole inertia is unknown has the rows

    r = e(log(V⁻¹ P V⁻ᵀ)) / sigma,   C = V Vᵀ,

with the pseudo-inertia C of the model, that of the estimate P, and the ten entries e of a symmetric
matrix. Half of the sum of their squares is the distance d(C, P)² / sigma²
(`mjfim/model/inertia.py`). The prior is weak: it decides only what the recordings hardly
determine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.linear_coordinates import UnknownBody, unknown_bodies
from mjfim.model.parameters import ParameterSet


@dataclass(frozen=True, kw_only=True, eq=False)
class CadPrior:
    """Priors on the inertias of some bodies.

    Attributes:
        bodies: The bodies, each with the standard deviation of its prior.
        count: Number p of parameters.
    """

    bodies: tuple[UnknownBody, ...]
    count: int

    @staticmethod
    def of(parameters: ParameterSet) -> CadPrior:
        """The priors of an experiment.

        Args:
            parameters: The p parameters.
        """
        known = [body for body in unknown_bodies(parameters) if body.cad_sigma is not None]
        return CadPrior(bodies=tuple(known), count=len(parameters))

    @property
    def columns(self) -> np.ndarray:
        """Indices in theta of all coordinates with such a prior, ascending."""
        places = [body.columns for body in self.bodies]
        return np.sort(np.concatenate([np.zeros(0, dtype=np.intp), *places]))

    def of_bodies(self, is_wanted: np.ndarray) -> CadPrior:
        """The priors on the bodies whose coordinates are wanted.

        Args:
            is_wanted: (p,) True for wanted parameters.
        """
        wanted = tuple(body for body in self.bodies if is_wanted[body.columns].all())
        return CadPrior(bodies=wanted, count=self.count)

    def rows(self, theta: Array) -> Array:
        """Rows of the least-squares problem.

        Args:
            theta: (p,) parameters [theta-unit].

        Returns:
            (10 b, p+1) rows `[J, r]` of b bodies, with residuals in standard deviations; residuals
            are infinite where an inertia is too large for the computer.
        """
        blocks = [np.zeros((0, self.count + 1))]
        for body in self.bodies:
            found = body.difference(theta[body.columns])
            rows = np.zeros((len(found.residual), self.count + 1))
            rows[:, body.columns] = found.jacobian
            rows[:, -1] = found.residual
            blocks.append(rows / body.prior_sigma)
        return np.concatenate(blocks)

    def information(self, theta: Array) -> Array:
        """(p, p) information of the priors about the parameters at theta: (p,)."""
        J = self.rows(theta)[:, :-1]
        return np.asarray(J.T @ J)
