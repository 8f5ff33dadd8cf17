"""All derivatives of a plant in one object.

Every derivative is a difference of MuJoCo steps in tangent-space coordinates (`StateSpace`):
`rollout_derivatives` differentiates whole rollouts, `step_derivatives` single samples,
`mixed_derivatives` single samples twice.
"""

from __future__ import annotations

from mjfim.plant.mixed_derivatives import MixedDerivatives
from mjfim.plant.rollout_derivatives import RolloutDerivatives


class Derivatives(RolloutDerivatives, MixedDerivatives):
    """Derivatives of a plant by differences of MuJoCo steps.

    Attributes:
        plant: The plant.
    """
