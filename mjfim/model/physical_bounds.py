"""Bounds that physics sets to parameters, which hold in every fit unless others are stated."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mjfim.model.parameters import Target
from mjfim.model.paths import ParameterPath

# Fields that cannot be negative, by kind of element. Bodies are not among them: their masses and
# inertias are kept physical together, see `ParameterWriter.unphysical_bodies`.
NOT_NEGATIVE = {
    "joint": ("damping", "frictionloss", "armature", "stiffness"),
    "tendon": ("damping", "frictionloss", "armature", "stiffness"),
    "geom": ("mass", "density", "size", "friction"),
    "option": ("density", "viscosity"),
}


def physical_bounds(targets: Iterable[Target]) -> tuple[float, float]:
    """Range of a parameter in which none of its targets is negative that cannot be.

    Args:
        targets: Numbers inside the model that the parameter sets, each to `scale * parameter +
            offset`.

    Returns:
        Lower and upper bound [parameter unit]; infinite where physics sets none.
    """
    low, high = -np.inf, np.inf
    for target in targets:
        path = ParameterPath.parse(target.path)
        if path.field not in NOT_NEGATIVE.get(path.kind, ()):
            continue

        # A coefficient of higher order may be negative while the whole force brakes: dry friction
        # that decreases with the speed has one.
        if path.kind == "joint" and path.component > 0:
            continue

        # The target is zero at this value of the parameter.
        zero = -target.offset / target.scale + 0.0
        if target.scale > 0.0:
            low = max(low, zero)
        else:
            high = min(high, zero)
    return low, high
