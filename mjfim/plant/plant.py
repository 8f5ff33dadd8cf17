"""The plant: discrete-time dynamics with outputs, and their derivatives."""

from __future__ import annotations

from typing import Self

import numpy as np

from mjfim.arrays import Array
from mjfim.plant.derivatives import Derivatives
from mjfim.plant.dynamics import Dynamics
from mjfim.records.trajectory import Trajectory


class Plant(Dynamics):
    """Dynamics with derivatives, see `Dynamics`."""

    @property
    def derivatives(self) -> Derivatives:
        """Derivatives of F and h, by differences of MuJoCo steps.

        They refer to this plant and are not kept, because the two would refer to each other: the
        memory of a plant that nothing uses any more is then free at once, without a search of
        Python's garbage collector.
        """
        return Derivatives(self, self._step_factors)

    def calibrated(
        self, theta: Array, trajectory: Trajectory, wanted: np.ndarray | None = None
    ) -> Self:
        """A plant with difference steps whose effect exceeds the round-off of a trajectory.

        Simulator and models are shared.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Trajectory on which the effect of every parameter is measured.
            wanted: (p,) True for the parameters whose effect is measured; None for all.

        Returns:
            The plant with longer difference steps for parameters that hardly move this trajectory,
            or the plant itself if a perturbed rollout diverges.
        """
        factors = self.derivatives.calibrated_step_factors(theta, trajectory, wanted)
        return self if factors is None else self.with_step_factors(factors)
