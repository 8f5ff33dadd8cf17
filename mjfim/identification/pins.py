"""Combinations of parameters that no recording determines, held at their values by weak rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.information.null_space import NullSpace
from mjfim.model.parameters import ParameterSet


@dataclass(frozen=True, kw_only=True, eq=False)
class Pins:
    """Rows that hold combinations of parameters which no recording determines.

    Attributes:
        rows: (k, p) coefficients of the combinations, each over the magnitude of the parameter.
        theta: (p,) parameters at which the combinations are held.
    """

    rows: Array
    theta: Array

    @classmethod
    def none(cls, parameters: ParameterSet) -> Pins:
        """No combination is held.

        Args:
            parameters: The parameters.
        """
        return cls(rows=np.zeros((0, len(parameters))), theta=np.array(parameters.guess))

    @classmethod
    def of(cls, parameters: ParameterSet, theta: Array, null_space: NullSpace) -> Pins:
        """Hold the directions about which there is no information.

        A pin has the weight of a prior whose standard deviation is the magnitude of the parameters.

        Args:
            parameters: The parameters.
            theta: (p,) parameters at which the combinations are held.
            null_space: Directions of theta about which there is no information.
        """
        magnitude = parameters.magnitude
        orthonormal = np.linalg.qr(null_space.directions / magnitude[:, None])[0]
        return cls(rows=orthonormal.T / magnitude, theta=np.array(theta))

    def residual(self, theta: Array) -> Array:
        """Differences of the combinations from their held values.

        Args:
            theta: (p,) parameters.

        Returns:
            (k,) differences.
        """
        return np.asarray(self.rows @ (theta - self.theta))

    def released(self) -> Pins:
        """These pins without any combination."""
        return Pins(rows=self.rows[:0], theta=self.theta)
