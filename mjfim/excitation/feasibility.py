"""Repair of infeasible controls: shrink them towards a centre until all constraints hold."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array

T = TypeVar("T")

# Factors on the deviation of a control from the centre, tried in this order. The first ones are
# close to 1, because most controls violate a limit by little. The last ones are for narrow limits.
SHRINK_FACTORS = np.concatenate(
    [[1.0, 0.997, 0.99, 0.97, 0.94, 0.9], 0.8 ** np.arange(1, 24), [2e-3, 5e-4, 1e-4, 1e-5]]
)


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


def shrink_about_each(
    control: Array, centres: Iterable[Array], evaluate: Callable[[Array], T | None]
) -> Iterator[T]:
    """Shrink a control about several centres, one after the other.

    Args:
        control: (N, nu) control, which may be infeasible [u-unit].
        centres: (nu,) or (N, nu) controls towards which it is shrunk [u-unit].
        evaluate: Returns the result for a feasible control, and None for an infeasible one.

    Yields:
        The result for every centre about which the control can be made feasible.
    """
    for centre in centres:
        result = shrink_until_feasible(control, centre, evaluate)
        if result is not None:
            yield result
