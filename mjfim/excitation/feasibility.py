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


# Factors on the deviation of all actuators, and on that of a single one in addition.
COMMON_FACTORS = (1.0, 0.97, 0.9, 0.8)
SINGLE_FACTORS = (0.94, 0.8, 0.64, 0.4, 0.2, 0.0)


def reduced_actuators(control: Array, centre: Array) -> Iterator[Iterator[Array]]:
    """Controls in which a single actuator deviates less from the centre than all others.

    A motion often leaves a limit by one joint only, and shrinking all actuators would lose most of
    the information.

    Args:
        control: (N, nu) control, which is infeasible [u-unit].
        centre: (nu,) control towards which it is shrunk [u-unit].

    Yields:
        For each common factor and each actuator: (N, nu) controls, the largest one first.
    """
    for common in COMMON_FACTORS:
        shrunk = centre + common * (control - centre)
        for actuator in range(control.shape[1]):
            yield _reductions(shrunk, centre, actuator)


def _reductions(control: Array, centre: Array, actuator: int) -> Iterator[Array]:
    """Controls in which one actuator deviates less from the centre."""
    for factor in SINGLE_FACTORS:
        reduced = control.copy()
        deviation = control[:, actuator] - centre[actuator]
        reduced[:, actuator] = centre[actuator] + factor * deviation
        yield reduced


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
