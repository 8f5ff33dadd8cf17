"""All derivatives of a plant in one object.

Derivatives are differences of MuJoCo steps in tangent-space coordinates (`StateSpace`):
`rollout_derivatives` differentiates whole rollouts, `step_derivatives` single samples,
`mixed_derivatives` single samples twice. Where the plant is an arm or similar,
`closed_form_derivatives` takes their place in a design.
"""

from __future__ import annotations

from mjfim.plant.mixed_derivatives import MixedDerivatives
from mjfim.plant.rollout_derivatives import RolloutDerivatives


class Derivatives(RolloutDerivatives, MixedDerivatives):
    """Derivatives of a plant, most of them by differences of MuJoCo steps.

    Attributes:
        plant: The plant.
    """
