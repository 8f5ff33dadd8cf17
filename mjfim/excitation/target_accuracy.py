"""The standard deviations that the user aims at, and how far a result is from them."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, UnidentifiableError
from mjfim.excitation.task import DesignTask
from mjfim.records.design import Design


def target_accuracies(task: DesignTask) -> Array:
    """(p,) standard deviations aimed at, infinite where none is. Raises ExperimentError where no parameter states one."""
    stated = [None if q.nuisance else q.wanted for q in task.parameters.parameters]
    if not any(stated):
        name = next(
            (n for n, spec in task.experiment.parameters.items() if spec.inertial is None),
            "<name>",
        )
        raise ExperimentError(
            f"{task.experiment.source}: no parameter states which standard deviation is wanted; state it in the "
            f"parameter's unit, for example parameters.{name}.wanted = 0.01"
        )
    return np.array([np.inf if value is None else value for value in stated])


def largest_ratio_to_target(std: Array, wanted: Array) -> tuple[float, int]:
    """Largest standard deviation over the wanted one, at most 1 where all are reached, and whose it is. Both (p,)."""
    share = np.where(np.isfinite(wanted), std / wanted, 0.0)
    return float(share.max()), int(np.argmax(share))


def require_reachable(task: DesignTask, design: Design, wanted: Array) -> None:
    """Raise UnidentifiableError where a wanted parameter cannot be told alone, however often a design is repeated."""
    lost = np.flatnonzero(np.isfinite(wanted) & ~np.isfinite(design.final.std))
    if len(lost):
        names = ", ".join(task.parameters.names[j] for j in lost)
        known = f": {'; '.join(design.combinations)}" if design.combinations else ""
        raise UnidentifiableError(
            f"{task.experiment.source}: no standard deviation of {names} can be reached, because this experiment does not "
            f"tell every parameter alone{known}. Take one of them out, give it a prior, or measure something else"
        )
