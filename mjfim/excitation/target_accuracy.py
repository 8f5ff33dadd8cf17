"""Target standard deviations of the parameters, and how far a result is from them."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, UnidentifiableError, first_ones, listed
from mjfim.excitation.task import DesignTask
from mjfim.records.design import Design

# Longest list of identifiable combinations in a message [characters].
LONGEST_COMBINATIONS = 150


def target_accuracies(task: DesignTask) -> Array:
    """Collect the target standard deviations that the experiment states.

    Args:
        task: The task.

    Returns:
        (p,) standard deviations [theta-unit], infinite for a parameter without a target.

    Raises:
        ExperimentError: No parameter states a target.
    """
    stated = [None if q.nuisance else q.wanted for q in task.parameters.parameters]
    if not any(stated):
        tables = task.experiment.parameters.items()
        name = next((n for n, table in tables if table.inertial is None), "<name>")
        raise ExperimentError(
            f"{task.experiment.source}: no parameter states which standard deviation is wanted; "
            f"state it in the parameter's unit, for example parameters.{name}.wanted = 0.01"
        )
    return np.array([np.inf if value is None else value for value in stated])


def largest_ratio_to_target(std: Array, wanted: Array) -> tuple[float, int]:
    """Compute the largest ratio of a standard deviation to its target.

    Args:
        std: (p,) standard deviations [theta-unit].
        wanted: (p,) targets, infinite where there is none [theta-unit].

    Returns:
        The ratio, at most 1 where all targets are reached, and the index of its parameter.
    """
    ratio = np.where(np.isfinite(wanted), std / wanted, 0.0)
    return float(ratio.max()), int(np.argmax(ratio))


def require_reachable(task: DesignTask, design: Design, wanted: Array) -> None:
    """Require that repetitions of a design can reach every target.

    Args:
        task: The task.
        design: A design of the task.
        wanted: (p,) targets, infinite where there is none [theta-unit].

    Raises:
        UnidentifiableError: A parameter with a target cannot be identified by itself.
    """
    unreachable = np.flatnonzero(np.isfinite(wanted) & ~np.isfinite(design.final.std))
    if not len(unreachable):
        return

    names = listed([task.parameters.names[j] for j in unreachable])

    # A single combination of very many parameters is not shown.
    known, words = "", first_ones(design.combinations, "; ", LONGEST_COMBINATIONS)
    if design.combinations:
        known = f": {words}"
    if len(words) > 2 * LONGEST_COMBINATIONS:
        known = " (`mjfim check` shows the combinations that it does identify)"

    raise UnidentifiableError(
        f"{task.experiment.source}: no standard deviation of {names} can be reached, because this "
        f"experiment does not identify every parameter by itself{known}. Remove one of them, give "
        "it a prior, or measure another quantity"
    )
