"""Levenberg-Marquardt steps over priors that are not linear along a step.

The linearised rows of the data are kept, and the curved rows, such as those of the distance of an
inertia from another one, are linearised anew within the step. This costs no simulation, and it is
needed where the curved rows keep a step inside a region, as physical inertias do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.condensed_least_squares import (
    Condensed,
    Step,
    bounded_least_squares,
    triangle,
)

# Largest number of linearisations of the curved rows within a step.
MAX_LINEARISATIONS = 60

# Decrease of the cost, relative to that since the begin of the step, below which a step has ended.
LEAST_DECREASE = 1e-6

# Halvings of a part of a step that leaves the region or raises the cost.
MAX_HALVINGS = 30

# Rows `[J, r]` at the end of a step of the common unknowns: (c,), with derivatives by that step;
# None where the step leaves the region in which they exist.
CurvedRows = Callable[[Array], Array | None]


def step_over_curved_rows(
    condensed: Condensed,
    curved: CurvedRows,
    damping: float,
    scale: Array,
    lower: Array,
    upper: Array,
) -> Step:
    """Minimiser of the damped linearised cost, whose common rows are curved.

    Args:
        condensed: The linearisation, with the common rows at the begin of the step.
        curved: The common rows along the step.
        damping: Damping factor.
        scale: (n+c,) scale of every unknown.
        lower: (c,) lower bounds of the step of the common unknowns, at most 0.
        upper: (c,) upper bounds of the step of the common unknowns, at least 0.

    Returns:
        The step with its predicted decrease.
    """
    data = triangle(condensed.damped_rows(damping, scale))
    at = np.zeros(condensed.common_count)
    rows = condensed.common_rows
    first = cost = _half_squares(data[:, -1]) + _half_squares(rows[:, -1])

    for _ in range(MAX_LINEARISATIONS):
        # Rows are written as functions of the whole step.
        of_step = np.column_stack([rows[:, :-1], rows[:, -1] - rows[:, :-1] @ at])
        joined = triangle(np.concatenate([data, of_step]))
        wanted = bounded_least_squares(joined[:, :-1], -joined[:, -1], lower, upper)

        part = wanted - at
        for _ in range(MAX_HALVINGS):
            found = curved(at + part)
            found_cost = np.inf
            if found is not None:
                residual = data[:, :-1] @ (at + part) + data[:, -1]
                found_cost = _half_squares(residual) + _half_squares(found[:, -1])
            if found is not None and found_cost < cost:
                break
            part = 0.5 * part
        else:
            break

        at, rows, decrease, cost = at + part, found, cost - found_cost, found_cost
        if decrease <= LEAST_DECREASE * (first - cost):
            break
    return _evaluated(condensed, at, rows, damping, scale)


def _evaluated(
    condensed: Condensed, common: Array, rows: Array, damping: float, scale: Array
) -> Step:
    """The step of all unknowns, with the decrease of the curved rows: (l, c+1) at its end."""
    step = condensed.step_to(common, damping, scale)
    linear = condensed.common_rows
    residual = linear[:, -1] + linear[:, :-1] @ common
    missed = _half_squares(rows[:, -1]) - _half_squares(residual)
    return replace(step, predicted_decrease=step.predicted_decrease - missed)


def _half_squares(residual: Array) -> float:
    """Half of the sum of squares."""
    return 0.5 * float(residual @ residual)
