"""Steps of the finite differences from which the derivatives of a plant are computed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mjfim.arrays import Array
from mjfim.records.trajectory import Trajectory

if TYPE_CHECKING:
    from mjfim.plant.plant import Plant

# Smallest divisor; it prevents a division by zero.
TINY = 1e-300


class DifferenceSteps:
    """A plant with the magnitudes to which the steps of its differences are relative.

    Attributes:
        plant: The plant.
    """

    def __init__(self, plant: Plant, step_factors: Array | None = None) -> None:
        """Set the plant and the factors of its difference steps.

        Args:
            plant: The plant.
            step_factors: (p,) factors by which the difference steps of the parameters are
                lengthened; None takes 1.
        """
        self.plant = plant
        self._step_factors = (
            np.ones(len(plant.parameters)) if step_factors is None else step_factors
        )

    @property
    def parameter_scale(self) -> Array:
        """(p,) magnitude of each parameter, to which its steps are relative [theta-unit]."""
        return np.asarray(self.plant.parameters.magnitude * self._step_factors)

    def difference_sizes(self, trajectory: Trajectory) -> Array:
        """Magnitudes of state and control along a trajectory, to which steps are relative.

        They are the largest values along the trajectory, or the natural sizes of the model where it
        hardly moves. A rotation has the magnitude 1.

        Args:
            trajectory: The trajectory.

        Returns:
            (nx+nu,) magnitudes [x-unit, u-unit].
        """
        return self.plant.sizes.along(trajectory)

    def direction_step(self, relative_step: float, relative_direction: Array, w: Array) -> float:
        """Step along (psi w, w).

        It is relative to the larger of the two parts.

        Args:
            relative_step: The step where the larger part is 1.
            relative_direction: (..., nx) direction psi w, divided by the sizes of the state.
            w: (p,) direction of the parameters [theta-unit].
        """
        in_model = self.plant.parameters.changes_model
        relative = np.where(in_model, np.abs(w / self.parameter_scale), 0.0).max(initial=0.0)
        largest = max(np.abs(relative_direction).max(initial=0.0), relative, TINY)
        return float(relative_step / largest)
