"""Several experiments about the same parameters, whose information adds up, designed together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import (
    ExperimentError,
    SimulationDivergedError,
    first_ones,
    listed,
)
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.task import DesignTask
from mjfim.excitation.task_parts import require_controls
from mjfim.experiment.schema import Experiment
from mjfim.information.marginal import shared
from mjfim.parallel import ExecutorLike, Workers
from mjfim.parallel.budget import StopToken, stop_on_interrupt
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import Design
from mjfim.records.events import DesignCallback, shown_progress


def design_jointly(
    experiments: Sequence[Experiment],
    *,
    callback: DesignCallback | None = None,
    rounds: int = 5,
    tolerance: float = 1e-3,
    threads: int | None = None,
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> tuple[Design, ...]:
    """Design several experiments in turn, each given the information of the others.

    The designs depend on each other only through the sum of their information. Where no single
    design can be improved, all of them together cannot be improved to first order either.

    Args:
        experiments: Two or more experiments that state identical parameters in one order.
        callback: Called with a `DesignEvent` for every iterate of every design.
        rounds: Largest number of times that every experiment is designed.
        tolerance: Relative improvement of the criterion in one round below which the search ends.
        threads: Threads for simulations; default: one per core.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. Each
            design runs its starts side by side.
        stop: Token that ends the search with the best designs so far, as Ctrl-C does.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        One design per experiment. `final.information` of each contains the information of all
        experiments. Deviations of the initial state are separate parameters of each experiment;
        all other nuisance parameters are common.

    Raises:
        ExperimentError: There are fewer than two experiments, or their parameters differ. See also
            `design`.
    """
    with (
        stop_on_interrupt(stop) as token,
        shown_progress("designing", callback, progress) as show,
    ):
        tasks = [DesignTask.resolve(experiment, threads=threads) for experiment in experiments]
        _require_common_parameters(tasks)
        for task in tasks:
            require_controls(task.system, "the joint design")

        information = [_initial_information(task) for task in tasks]
        designs: list[Design | None] = [None] * len(tasks)
        finished: list[Design] = []
        last = np.inf
        workers = Workers.of_any(executor)

        for _ in range(rounds):
            for i, task in enumerate(tasks):
                # After a request to stop, only experiments without any design are still designed;
                # their designs end immediately.
                earlier = designs[i]
                if token.requested and earlier is not None:
                    continue

                others = information[:i] + information[i + 1 :]
                added = sum(others, start=np.zeros_like(information[i]))
                design = design_task(
                    task.restated(task.experiment, added_information=added),
                    callback=show,
                    initial_control=None if earlier is None else earlier.trajectory.ctrl,
                    executor=workers,
                    budget=design_budget(task, token),
                )
                information[i] = design.data
                designs[i] = design

            # The criterion of the last design takes the information of all others into account.
            finished = [design for design in designs if design is not None]
            reached = finished[-1].final.criterion
            if token.requested or last - reached <= tolerance * abs(reached):
                break
            last = reached

        return tuple(finished)


def _require_common_parameters(tasks: Sequence[DesignTask]) -> None:
    """Raise ExperimentError where there are fewer than two tasks, or their parameters differ."""
    names = [task.parameters.names for task in tasks]
    if len(tasks) < 2 or any(other != names[0] for other in names):
        stated = first_ones([listed(each) for each in names], "; ")
        raise ExperimentError(
            "design_jointly takes two or more experiments with the same parameters in one order: "
            f"{stated}"
        )


def _initial_information(task: DesignTask) -> Array:
    """Information of the initial control about the parameters that all experiments share.

    Returns:
        (p, p) information [1 / theta-unit^2].

    Raises:
        SimulationDivergedError: The simulation diverges along the initial control.
    """
    point = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError(
            "the simulation diverges when the parameters change slightly along the initial control"
        )

    # The initial control may excite some combinations only; the others carry no information.
    excited = task.identifiability_test.along(task.initial, point.sensitivity).along_trajectory
    basis = excited.basis if excited.count else None
    information = replace(task.information, basis=basis)

    return shared(
        information.without_round_off(point.information - task.information.prior),
        task.parameters.prior_information,
        task.parameters.recording_specific,
    )
