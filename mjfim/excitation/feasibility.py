"""Repair of infeasible controls: shrink them towards a centre until all constraints hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array

T = TypeVar("T")

# Factors on the deviation of a control from the centre, tried in this order. The first ones are
# close to 1, because most controls violate a limit by little.
SHRINK_FACTORS = np.concatenate([[1.0, 0.997, 0.99, 0.97, 0.94, 0.9], 0.8 ** np.arange(1, 24)])


def shrink_until_feasible(
    control: Array, centre: Array, evaluate: Callable[[Array], T | None]
) -> T | None:
    """Shrink a control about a centre until it is feasible.

    Args:
        control: (N, nu) control, which may be infeasible [u-unit].
        centre: (nu,) or (N, nu) control towards which it is shrunk [u-unit].
        evaluate: Returns the result for a feasible control, and None for an infeasible one.

    Returns:
        The result for the first factor that makes the control feasible; None where no factor does.
    """
    for factor in SHRINK_FACTORS:
        candidate = control if factor == 1.0 else centre + factor * (control - centre)

        result = evaluate(candidate)
        if result is not None:
            return result

    return None
