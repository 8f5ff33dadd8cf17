"""The verb `mjfim.design`: find the control that is most informative about the parameters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import ExperimentError
from mjfim.excitation.control_search import ControlSearch, choose
from mjfim.excitation.controls_within_limits import keeps_limits, limited_cost_of
from mjfim.excitation.design_report import DesignReport
from mjfim.excitation.designable import identifiability_along, require_designable
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.left_starts import starts_without_time
from mjfim.excitation.levels import DescentLevel, require_coarse_factor
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.release_search import ReleaseSearch
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.sample_workers import SampleWorkers
from mjfim.excitation.short_budget import allows_few_evaluations
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import require_feasible_start
from mjfim.experiment.schema import Experiment
from mjfim.information.identifiability import Identifiability
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import Design
from mjfim.records.events import DesignCallback, shown_progress


def design(
    experiment: Experiment,
    *,
    callback: DesignCallback | None = None,
    initial_control: Array | None = None,
    threads: int | None = None,
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Design:
    """Design the control that minimises the cost of the experiment within its limits.

    The cost is equation (3) of the paper. Ctrl-C, or a request by the token, ends the search with
    the best trajectory so far.

    Args:
        experiment: The experiment.
        callback: Called with a `DesignEvent` for every iterate.
        initial_control: (N, nu) control to begin with [u-unit]; default: the experiment's. The
            experiment's initial control remains the reference x_d of the tracking term.
        threads: Threads for simulations; default: one per core.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            runs several starts side by side: under hard limits, and without them if there is a
            start for each worker. It evaluates releases, and the samples of `[robust]`, side by
            side as well.
        stop: Token that ends the search early.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        The design.

    Raises:
        ExperimentError: The experiment or the initial control is faulty.
        UnidentifiableError: A parameter has no effect, or the initial control does not excite it.
        SimulationDivergedError: The simulation diverges along the initial control.
    """
    with (
        stop_on_interrupt(stop) as token,
        shown_progress("designing", callback, progress) as show,
    ):
        task = DesignTask.resolve(experiment, threads=threads)
        return design_task(
            task,
            callback=show,
            initial_control=initial_control,
            executor=executor,
            budget=design_budget(task, token),
        )


def design_budget(task: DesignTask, stop: StopToken | None = None) -> Budget:
    """Make the budget of a design.

    Args:
        task: The task, whose `[descent] seconds` limit the time.
        stop: Token that ends the design early.

    Returns:
        A budget that begins to count now.
    """
    seconds = task.experiment.descent.seconds
    return Budget(seconds=np.inf if seconds is None else seconds, stop=stop)


@one_blas_thread()
def design_task(
    task: DesignTask,
    *,
    callback: DesignCallback | None = None,
    initial_control: Array | None = None,
    executor: ExecutorLike | None = None,
    budget: Budget | None = None,
    identifiability: Identifiability | None = None,
) -> Design:
    """Design the control of a task that is resolved already. See `design`.

    Args:
        task: The task.
        callback: Called with a `DesignEvent` for every iterate.
        initial_control: (N, nu) control to begin with [u-unit]; default: the experiment's.
        executor: Runs several starts side by side.
        budget: Time of the design and the token that stops it; default: `[descent] seconds`.
        identifiability: What can be identified, as `designable` finds it, where that is known.

    Returns:
        The design.
    """
    budget = design_budget(task) if budget is None else budget

    # All parts of the design use the same processes, also those that replace killed ones.
    executor = None if executor is None else Workers.of(executor)
    if task.release is not None:
        return _design_release(task, task.release, budget, callback, executor)

    # Samples of a robust design are independent of each other, as starts are.
    if executor is not None and task.samples_of_parameters is not None:
        task = replace(task, sample_evaluation=SampleWorkers(executor, budget))

    _require_controls(task)
    require_feasible_start(task)
    require_coarse_factor(task)
    steps_before = task.plant.engine_steps

    # Evaluate the initial control and find the combinations that can be identified.
    begun = budget.seconds_used
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    evaluation_seconds = budget.seconds_used - begun
    if initial_control is not None:
        initial_control = _checked_control(task, initial_control)
    starts = list(initial_controls_of(task, initial_control))
    begin = _point_of_given(task, first, initial_control)
    if identifiability is None:
        identifiability = identifiability_along(task, begin)
        require_designable(task, identifiability)

    stage = DescentLevel(task, identifiability.basis)
    first, begin = stage.problem.reevaluated(first), stage.problem.reevaluated(begin)

    # Under hard limits, the design has to beat the initial control, scaled until it keeps them.
    limited = limited_cost_of(stage, first)
    outside = None if limited is None else limited.outside_start(task.control, budget)

    search = ControlSearch(
        stage=stage,
        first=first,
        executor=executor,
        budget=budget,
        limited=limited,
        outside=outside,
        is_brief=allows_few_evaluations(budget, evaluation_seconds),
        evaluation_seconds=evaluation_seconds,
    )
    results = consume(search.run(starts), callback)
    interrupted = budget.stop.requested

    # Steps on other plants, also those of workers, are counted by the runs.
    begins = [first] if initial_control is None else [first, begin]
    choice = choose(search, begins, results, interrupted)
    steps = task.plant.engine_steps - steps_before + sum(result.steps for result in results)
    report = DesignReport(
        stage=stage,
        identifiability=identifiability,
        initial=first,
        final=choice.point,
        scaled_start=None if outside is None else outside.record,
        remarks=() if interrupted else starts_without_time(task, starts, results),
    )
    return report.design(choice.best, choice.results, budget.seconds_used, steps, interrupted)


def _design_release(
    task: DesignTask,
    space: ReleaseSpace,
    budget: Budget,
    callback: DesignCallback | None,
    executor: ExecutorLike | None,
) -> Design:
    """Design the initial state of a motion whose control is given. See `design`."""
    require_feasible_start(task)
    require_coarse_factor(task)
    steps_before = task.plant.engine_steps

    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = identifiability_along(task, first)
    require_designable(task, identifiability)
    stage = DescentLevel(task, identifiability.basis)
    first = stage.problem.reevaluated(first)

    search = ReleaseSearch(stage, space, budget, callback, executor)
    found = search.run()
    interrupted = budget.stop.requested

    # The stated release stays where no better one within the limits was found.
    chosen, played = found.point, task
    if first.cost < chosen.cost and keeps_limits(limited_cost_of(stage), first):
        chosen = first
    elif chosen.trajectory is not None:
        played = task.released_as(chosen.trajectory.state[0])

    best = RunResult(
        name=found.found_by,
        control=task.control,
        cost=chosen.cost,
        status=found.status,
        slope=np.nan,
        history=found.history,
        point=chosen,
    )
    report = DesignReport(
        stage=stage,
        identifiability=identifiability,
        initial=first,
        final=chosen,
        played=played,
        remarks=tuple(space.edges(found.best.shares)),
    )
    steps = task.plant.engine_steps - steps_before
    made = report.design(best, (), budget.seconds_used, steps, interrupted)
    return replace(made, starts=found.starts)


def _require_controls(task: DesignTask) -> None:
    """Raise ExperimentError where the model has no actuators, so that there is no control."""
    if task.controls:
        return

    # An example for the first joint whose position is one number.
    joint = next((joint.position_column for joint in task.system.coordinates), "qpos:<joint>")
    raise ExperimentError(
        f"{task.experiment.source}: the model has no actuators, so there is no control to design. "
        "State in initial.free which initial state a design may choose, for example [initial] "
        f'free = {{ "{joint}" = [-1.0, 1.0] }}'
    )


def _checked_control(task: DesignTask, control: Array) -> Array:
    """A given initial control as an array of numbers; ExperimentError for a wrong shape."""
    control = np.asarray(control, dtype=np.float64)
    if control.shape != task.control.shape:
        raise ExperimentError(
            f"initial_control: shape {control.shape}; it must be (samples, actuators) = "
            f"{task.control.shape}"
        )

    return control


def _point_of_given(
    task: DesignTask, first: DesignPoint, initial_control: Array | None
) -> DesignPoint:
    """Evaluate the control with which the search begins; the initial control without another."""
    if initial_control is None:
        return first
    trajectory = task.plant.simulate(task.theta, initial_control)
    return task.problem.point(trajectory, CENTRAL_DIFFERENCES)
