"""Errors of the sensors: relative errors of their scales, and constant biases.

A measured output is `(1 + s) h(x, u, theta) + b`, with s and b linear in theta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Scale errors and biases of the ny outputs as functions of the p parameters.

    Attributes:
        scale: (ny, p) derivative of the relative scale errors s by theta [1 / theta-unit].
        bias: (ny, p) derivative of the biases b by theta [y-unit / theta-unit].
    """

    scale: Array
    bias: Array

    @staticmethod
    def of(parameters: ParameterSet, ny: int) -> Calibration:
        """Errors that some parameters stand for.

        Args:
            parameters: The parameters.
            ny: Number of outputs.
        """
        return Calibration(
            scale=parameters.scale_derivative(ny), bias=parameters.bias_derivative(ny)
        )

    @property
    def scales(self) -> bool:
        """Whether a parameter is the scale error of an output."""
        return bool(self.scale.any())

    def factor(self, theta: Array) -> Array:
        """Factors 1 + s of the outputs.

        Args:
            theta: (..., p) parameters [theta-unit].

        Returns:
            (..., ny) factors.
        """
        return np.asarray(1.0 + theta @ self.scale.T)

    def measured(self, h: Array, theta: Array) -> Array:
        """Outputs with their errors.

        Args:
            h: (..., ny) outputs of the model [y-unit].
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny) outputs [y-unit].
        """
        return np.asarray(self.factor(theta) * h + self.bias @ theta)

    def scaled(self, derivative: Array, theta: Array) -> Array:
        """Derivatives of the outputs by states, controls or directions of theta.

        Args:
            derivative: (..., ny, n) derivatives of the outputs of the model.
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny, n) derivatives of the outputs with their scales.
        """
        if not self.scales:
            return derivative
        return np.asarray(self.factor(theta)[:, None] * derivative)

    def by_theta(self, h: Array, derivative: Array, theta: Array) -> Array:
        """Derivatives of the outputs with their errors by theta.

        Args:
            h: (..., ny) outputs of the model [y-unit].
            derivative: (..., ny, p) derivatives of the outputs of the model by theta.
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny, p) derivatives [y-unit / theta-unit].
        """
        total = self.scaled(derivative, theta) + self.bias
        return total + h[..., None] * self.scale if self.scales else total
