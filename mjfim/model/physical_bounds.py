"""Bounds that physics sets to parameters, which hold in every fit unless others are stated."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from mjfim.model.control_laws import FIELDS as LAW_FIELDS
from mjfim.model.parameters import Target
from mjfim.model.paths import ParameterPath

# Fields that cannot be negative, by kind of element. Bodies are not among them: their masses and
# inertias are kept physical together, see `ParameterWriter.unphysical_bodies`.
NOT_NEGATIVE = {
    "joint": ("damping", "frictionloss", "armature", "stiffness"),
    "tendon": ("damping", "frictionloss", "armature", "stiffness"),
    "geom": ("mass", "density", "size", "friction"),
    "pair": ("friction",),
    "option": ("density", "viscosity"),
    "controller": tuple(name for name in LAW_FIELDS if name not in ("saturation", "integral")),
}


def physical_bounds(targets: Iterable[Target]) -> tuple[float, float]:
    """Range of a parameter in which all of its targets are physical.

    Args:
        targets: Numbers inside the model that the parameter sets, each to `scale * parameter +
            offset`.

    Returns:
        Lower and upper bound [parameter unit]; infinite where physics sets none.
    """
    low, high = -np.inf, np.inf
    for target in targets:
        # Values of the parameter at which the target is at its bounds.
        ends = [
            (bound - target.offset) / target.scale + 0.0 if np.isfinite(bound) else bound
            for bound in _bounds_of(target)
        ]
        if target.scale < 0.0:
            infinite = [-end if np.isinf(end) else end for end in ends]
            ends = infinite[::-1]
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _bounds_of(target: Target) -> tuple[float, float]:
    """Smallest and largest physical value of a target [unit of the number]."""
    if target.term is not None:
        return target.term.bounds

    path = ParameterPath.parse(target.path)
    if path.field not in NOT_NEGATIVE.get(path.kind, ()):
        return -np.inf, np.inf

    # A coefficient of higher order may be negative while the whole force brakes: dry friction that
    # decreases with the speed has one.
    if path.kind == "joint" and path.component > 0:
        return -np.inf, np.inf
    return 0.0, np.inf
