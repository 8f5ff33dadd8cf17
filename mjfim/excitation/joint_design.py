"""Several experiments about the same parameters, whose information adds up, designed together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.design import Monitor, design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.information.marginal import shared
from mjfim.plant.derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import Design


def design_jointly(
    experiments: Sequence[Experiment],
    monitor: Monitor | None = None,
    rounds: int = 5,
    tolerance: float = 1e-3,
    threads: int | None = None,
) -> tuple[Design, ...]:
    """Design each experiment in turn, given what the others tell, until none improves the criterion by more than tolerance.

    The designs depend on each other through the sum of their information alone, so where no single one can improve, none
    of them together can to first order. `final.information` of each design holds all of it; deviations of the start are
    each experiment's own, all other nuisance is common. The experiments state the same parameters in the same order;
    raises ExperimentError where they do not. See also `design`.
    """
    tasks = [DesignTask.resolve(experiment, threads=threads) for experiment in experiments]
    names = [task.parameters.names for task in tasks]
    if len(tasks) < 2 or any(own != names[0] for own in names):
        told = "; ".join(", ".join(own) for own in names)
        raise ExperimentError(
            f"design_jointly takes two or more experiments with the same parameters in one order: {told}"
        )
    tells = [_data(task) for task in tasks]
    controls: list[Array | None] = [None] * len(tasks)
    designs: list[Design] = []
    last = np.inf
    for _ in range(rounds):
        designs = []
        for i, task in enumerate(tasks):
            others = sum(
                (tells[j] for j in range(len(tasks)) if j != i), start=np.zeros_like(tells[0])
            )
            found = design_task(
                task.restated(task.experiment, added_information=others), monitor, controls[i]
            )
            controls[i] = found.trajectory.ctrl
            tells[i] = found.data
            designs.append(found)
        reached = designs[-1].final.criterion
        if last - reached <= tolerance * abs(reached):
            break
        last = reached
    return tuple(designs)


def _data(task: DesignTask) -> Array:
    """What the initial control tells about the parameters that all experiments share."""
    point = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError(
            "the simulation diverges when the parameters move a little along the initial control"
        )
    seen = task.observer.identifiability(task.initial, point.sensitivity)
    information = replace(
        task.information, basis=seen.along_trajectory.basis if seen.along_trajectory.count else None
    )
    p = task.parameters
    return shared(
        information.without_round_off(point.information - task.information.prior),
        p.prior_information,
        p.recording_specific,
    )
