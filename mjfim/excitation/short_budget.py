"""Designs whose time allows few evaluations of the cost only.

An iteration of a descent costs several evaluations, so that the way from the initial control counts
more than the last digits of an optimum.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import TRIAL_SHARE, LimitedCost

# Number of evaluations in the time of a design below which it allows few of them.
FEW_EVALUATIONS = 20.0

# Ratio of the sizes of two successive trials when a control is enlarged.
ENLARGING = 1.25


def allows_few_evaluations(budget: Budget, evaluation: float) -> bool:
    """Check whether a budget allows few evaluations; never without a limit of time.

    Args:
        budget: Time of the whole design.
        evaluation: Time of one evaluation on the stated plant [s].
    """
    seconds = budget.deadline - budget.begun
    return bool(np.isfinite(seconds)) and seconds < FEW_EVALUATIONS * evaluation


def enlarged(limited: LimitedCost, control: Array, cost: float, budget: Budget) -> Array:
    """Enlarge a control about its centre, while it keeps all limits and its cost falls.

    A trial needs no derivatives of second order, and costs a part of an iteration.

    Args:
        limited: Cost of controls that keep all limits.
        control: (N, nu) the control [u-unit].
        cost: Its J.
        budget: Time of the whole design, of which a part is for trials.

    Returns:
        (N, nu) the enlarged control; the given one where it costs least.
    """
    centre = limited.level.task.centre
    while budget.exhausted is None and budget.used < TRIAL_SHARE:
        larger = np.asarray(centre + ENLARGING * (control - centre))
        trial = limited(larger)
        if not trial < cost:
            return control
        control, cost = larger, trial
    return control
