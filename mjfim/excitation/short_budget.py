"""Designs under hard limits whose time allows few evaluations of the cost only.

An iteration of a descent costs several evaluations, so that the way from the initial control counts
more than the last digits of an optimum. Two kinds of designs take account of that: those with a
barrier and a coarse level whose timestep or samples are longer spend most of the time there, see
`Multistart`, and those without a barrier and without a coarse level begin with an enlarged control.
Other designs are as with more time, for example those that go through several coarser levels, and
those with a barrier and `coarse = 1`; only the check whether derivatives may mislead is left out
wherever a barrier is needed.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import TRIAL_SHARE, LimitedCost

# Number of evaluations in the time of a design below which it allows few of them.
FEW_EVALUATIONS = 20.0

# Largest ratio of the times of an evaluation with central differences, as a design begins with, and
# of one with forward differences.
CENTRAL_RATIO = 2.0

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


def still_allows_few_evaluations(budget: Budget, evaluation: float) -> bool:
    """Check this again, when the work that is done once, such as a start of workers, is done.

    Args:
        budget: Time of the whole design.
        evaluation: Time of one evaluation with forward differences on the stated plant [s].
    """
    return allows_few_evaluations(budget, CENTRAL_RATIO * evaluation)


def enlarged(limited: LimitedCost, control: Array, cost: float, budget: Budget) -> Array:
    """Enlarge a control about its centre, while it keeps all limits and its cost falls.

    A trial needs no derivatives of second order, and costs a part of an iteration. A single one is
    done where it shows that the time is enough for many evaluations.

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
        begun = budget.seconds_used
        trial = limited(larger)
        if not trial < cost:
            return control
        control, cost = larger, trial

        if not still_allows_few_evaluations(budget, budget.seconds_used - begun):
            return control
    return control
