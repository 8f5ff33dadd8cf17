"""The verb `mjfim.design`: find the control that is most informative about the parameters."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from itertools import starmap
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import (
    ExperimentError,
    SimulationDivergedError,
    first_ones,
    listed,
)
from mjfim.excitation.evaluation import (
    design_warnings,
    evaluate_point,
    identifiability_along,
    point_at_stated_rate,
    require_designable,
)
from mjfim.excitation.initial_controls import (
    GIVEN,
    initial_controls_of,
    series_of,
)
from mjfim.excitation.limits.verification import all_violations_of, require_feasible_start, verify
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.prior_information import EarlierExperiments
from mjfim.excitation.rehearsal import rehearse_task, with_cures_tried
from mjfim.excitation.release import design_release
from mjfim.excitation.search.climb import Candidate
from mjfim.excitation.search.levels import DescentLevel, require_coarse_factor
from mjfim.excitation.search.search import Search
from mjfim.excitation.sensors import sensing_along
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import require_controls
from mjfim.experiment.schema import ExperimentLike, experiment_of
from mjfim.experiment.system import labels_of_system
from mjfim.information.criteria import shared
from mjfim.information.finite_steps import valley
from mjfim.information.identifiability import Identifiability
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread
from mjfim.parallel.budget import Budget, StopReason, StopToken, stop_on_interrupt
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import (
    Design,
    ScaledStart,
    StartResult,
    Status,
    improvement_per_iteration,
    is_playable,
    without_motions,
)
from mjfim.records.events import DesignCallback, DesignEvent, shown_progress
from mjfim.records.worth import Price

T = TypeVar("T")

# Largest number of searches for a reserve that suffices.
RESERVE_ROUNDS = 3

# Largest number of candidates, stopped on a coarse level, that are compared at the stated rate.
EVALUATED_STOPPED = 4


@checked
def design(
    experiment: ExperimentLike,
    *,
    seconds: float | None = None,
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
        experiment: The experiment, or the path of its file.
        seconds: Time of the search, to which rehearsals come [s]; default: that of the experiment.
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
        if seconds is not None:
            experiment = experiment_of(experiment).replace(descent={"seconds": seconds})
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
        callback: Called after every iterate.
        initial_control: (N, nu) control with which the search begins [u-unit].
        executor: Workers of the search.
        budget: Ends the search; None for the time of the experiment.
        identifiability: What can be identified; None where it is to be found.
    """
    budget = design_budget(task) if budget is None else budget
    # All parts of the design use the same processes, also those that replace killed ones.
    executor = Workers.of_any(executor)
    is_automatic = task.experiment.limits.reserve == "auto"
    rounds = RESERVE_ROUNDS if is_automatic else 1
    found: list[Design] = []
    reserve: dict[str, float] = {}

    for later in reversed(range(rounds)):
        if is_automatic:
            experiment = task.experiment.replace(limits={"reserve": reserve})
            task = replace(task, system=replace(task.system, experiment=experiment))
        part = budget if rounds == 1 else budget.share(0.5 if later else 1.0)
        best = _searched(task, callback, initial_control, executor, part, identifiability)
        if found:
            # The given control of a later search is the design of the one before.
            name = found[-1].found_by if best.found_by == GIVEN else best.found_by
            best = replace(best, found_by=name, steps=found[-1].steps + best.steps)
        found.append(replace(best, seconds=budget.seconds_used))
        # A good motion whose search was cut off at half of the time is improved.
        needed = {} if best.rehearsal is None else best.rehearsal.reserve
        if budget.stop.requested or not (needed or part.exhausted is StopReason.SECONDS):
            break
        if best.trajectory.ctrl.shape == task.control.shape:
            initial_control = best.trajectory.ctrl
        reserve |= needed
    # A later design knows what the robots need; after Ctrl-C it is not rehearsed, nor are cures.
    best = max(reversed(found), key=lambda each: each.rehearsal is not None and is_playable(each))
    if best.rehearsal is None or budget.stop.requested:
        return best
    played = task.released_as(best.trajectory.state[0])
    return replace(best, rehearsal=with_cures_tried(played, best.final, best.rehearsal))


def _searched(
    task: DesignTask,
    callback: DesignCallback | None,
    initial_control: Array | None,
    executor: ExecutorLike | None,
    budget: Budget,
    identifiability: Identifiability | None,
) -> Design:
    """Design the control of a task whose reserve is known."""
    if not task.controls and task.release is None:
        # An example for the first joint whose position is one number.
        joint = next((joint.position_column for joint in task.system.coordinates), "qpos:<joint>")
        raise ExperimentError(
            f"{task.experiment.source}: the model has no actuators, so there is no control to "
            "design. State in initial.free which initial state a design may choose, for example "
            f'[initial] free = {{ "{joint}" = [-1.0, 1.0] }}'
        )
    require_feasible_start(task)
    require_coarse_factor(task)
    steps_before = task.plant.engine_steps

    # Evaluate the initial control and find the combinations that can be identified.
    begun = budget.seconds_used
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    evaluation_seconds = budget.seconds_used - begun
    begin, starts = first, list[Candidate]()
    if task.release is None:
        if initial_control is not None:
            initial_control = np.asarray(initial_control, dtype=np.float64)
            if initial_control.shape != task.control.shape:
                raise ExperimentError(
                    f"initial_control: shape {initial_control.shape}; it must be (samples, "
                    f"actuators) = {task.control.shape}"
                )
            moved = task.plant.simulate(task.theta, initial_control)
            begin = task.problem.point(moved, CENTRAL_DIFFERENCES)
        starts = list(initial_controls_of(task, initial_control))
    if identifiability is None:
        identifiability = identifiability_along(task, begin)
        require_designable(task, identifiability)
    stage = DescentLevel(task, identifiability.basis)
    first, begin = stage.problem.reevaluated(first), stage.problem.reevaluated(begin)
    scaled_start, remarks = None, tuple[str, ...]()
    if task.release is not None:
        winner, point, rows, remarks = design_release(
            stage, task.release, first, budget, callback, executor
        )
        steps = task.plant.engine_steps - steps_before
    else:
        search = Search(
            stage=stage,
            first=first,
            executor=executor,
            budget=budget,
            evaluation_seconds=evaluation_seconds,
        )
        steps_before = task.plant.engine_steps - steps_before
        # A stated time that is left is used for series.
        rng = np.random.default_rng(task.experiment.descent.seed)
        further = () if np.isinf(budget.seconds_left) else series_of(task, rng)
        results = consume(search.run(starts, further), callback)
        if not search.grounds.is_limited:
            results = _with_stops_evaluated(stage, results)
        winner, point = _chosen(search, results, [first, begin])
        rows = [result.start_result for result in results]
        if not budget.stop.requested:
            remarks = _without_time(task, starts, results)
        steps, scaled_start = steps_before + search.steps, search.scaled_start
    return _record(
        stage,
        identifiability,
        initial=first,
        final=point,
        winner=winner,
        starts=rows,
        budget=budget,
        steps=steps,
        remarks=remarks,
        scaled_start=scaled_start,
    )


def _record(
    stage: DescentLevel,
    identifiability: Identifiability,
    *,
    initial: DesignPoint,
    final: DesignPoint,
    winner: Candidate,
    starts: Sequence[StartResult],
    budget: Budget,
    steps: int,
    remarks: tuple[str, ...],
    scaled_start: ScaledStart | None,
) -> Design:
    """The record of a design, with its warnings.

    Args:
        stage: The stated level.
        identifiability: The combinations that can be identified.
        initial: The initial control, evaluated.
        final: The designed control, evaluated.
        winner: The candidate that gave the design.
        starts: Result of every initial control.
        budget: Budget of the search.
        steps: Engine steps of the search.
        remarks: Warnings that belong to the search.
        scaled_start: The largest share of an initial control outside limits that keeps them.
    """
    seconds, interrupted = budget.seconds_used, budget.stop.requested
    task, information = stage.task, stage.problem.information
    before, after = evaluate_point(stage, initial), evaluate_point(stage, final)
    played = task.released_as(after.trajectory.state[0]) if final is not initial else task

    # The limits, on the model as the user wrote it.
    found = verify(played, after.trajectory)
    clamped = saturated_actuators(task.system.model_at(task.theta), after.trajectory)

    # After Ctrl-C a rehearsal would take too long.
    rehearsal = None if interrupted else rehearse_task(played, after)
    worth, robots = None, None
    if not interrupted:
        robots = valley(
            [(task.plant, before.trajectory), (played.plant, after.trajectory)],
            task.system.noise,
            task.theta,
            information=before.information,
            prior=information.prior,
            # The designed motion tells robots apart by what it determines.
            std=np.where(np.isfinite(after.std), before.std, 0.0),
        )
        sensing = sensing_along(played, final, identifiability)
        worth = sensing.worth("the design", task.horizon)
        worth = replace(worth, prices=tuple(starmap(Price.of_limit, winner.prices.items())))
    status = Status.INTERRUPTED if interrupted else winner.ended
    if task.is_limited and not found.is_feasible and not interrupted:
        status = Status.INFEASIBLE

    parameters = task.parameters
    data = shared(
        information.without_round_off(after.information - task.prior),
        parameters.prior_information,
        parameters.recording_specific,
    )
    history, motions = without_motions(winner.history)
    return Design(
        status=status,
        parameters=parameters.names,
        theta=task.theta,
        initial=before,
        final=after,
        history=history,
        slope=winner.slope,
        steps=steps,
        seconds=seconds,
        limits=found.margins,
        usage=found.usage,
        initial_violations=all_violations_of(task, before.trajectory),
        scaled_start=scaled_start,
        warnings=(*design_warnings(after, found, task, clamped), *remarks),
        found_by=winner.name,
        starts=tuple(starts),
        nuisance=tuple(p.name for p in parameters.parameters if p.nuisance),
        combinations=tuple(str(group) for group in identifiability.groups_along_all),
        combined=identifiability.combinations(
            information, task.theta[parameters.interest], before.information, after.information
        ),
        prior=task.prior,
        data=data,
        labels=labels_of_system(task.system),
        sizes=parameters.sizes(task.theta),
        motions=motions,
        improvement=improvement_per_iteration(history, stage.problem.size(final)),
        rehearsal=rehearsal,
        worth=worth,
        valley=robots,
        inflation=task.inflation,
    )


def _chosen(
    search: Search, results: Sequence[Candidate], begins: Sequence[DesignPoint]
) -> tuple[Candidate, DesignPoint]:
    """Choose the best candidate, and the point of the design.

    The beginning counts where no candidate is better, if it keeps the limits. Where nothing keeps
    them, the candidate that came nearest to an optimum is shown.

    Args:
        search: The search.
        results: The candidates that were begun.
        begins: The initial control and the one with which the search began.
    """
    is_limited, interrupted = search.grounds.is_limited, search.budget.stop.requested
    nothing = Candidate(
        name="initial control", control=search.stage.task.control, status=Status.INTERRUPTED
    )
    best = min(results, key=lambda result: (result.cost, result.rank), default=nothing)
    point = best.point
    if is_limited:
        shown = best.over_horizon if best.best is None else best.best
        point = point_at_stated_rate(search.stage, shown) if results else None
    cost = np.inf if point is None or best.best is None else point.cost
    cheaper = [begin for begin in begins if begin.cost <= cost and search.keeps_limits(begin)]
    if cheaper:
        begin = min(cheaper, key=lambda each: each.cost)
        status = Status.BEST_SEEN if best.ended is Status.INFEASIBLE else best.ended
        return replace(best, status=status, best=search.stage.task.control), begin
    if point is not None and point.trajectory is not None:
        return best, point

    if not interrupted:
        task = search.stage.task
        control = best.over_horizon if best.best is None else best.best
        raise SimulationDivergedError(
            f"{task.experiment.source}: no initial control leads to a motion within the limits; "
            f"the simulation diverges from the best one, {best.name}: "
            f"{task.plant.why_diverged(task.theta, control)}"
        )
    return best, begins[0]


def _with_stops_evaluated(stage: DescentLevel, results: Sequence[Candidate]) -> list[Candidate]:
    """Evaluate the best candidates that were stopped on a coarse level, at the stated rate."""
    stopped = [each for each in results if each.best is None and each.history]
    stopped = sorted(stopped, key=lambda each: each.history[-1].cost)[:EVALUATED_STOPPED]
    found = list(results)
    for each in stopped:
        point = point_at_stated_rate(stage, each.over_horizon)
        if point is not None:
            found[found.index(each)] = each.improved(each.over_horizon, point)
    return found


def _without_time(
    task: DesignTask, starts: Sequence[Candidate], results: Sequence[Candidate]
) -> tuple[str, ...]:
    """Say which initial controls were left out, because the time was too short for them."""
    begun = {result.name for result in results}
    left = [start.name for start in starts if start.name not in begun]
    seconds = task.experiment.descent.seconds
    if not left or not begun or seconds is None:
        return ()
    return (
        f"{len(left)} of {len(starts)} initial controls were left out ({listed(left)}), because "
        f"{seconds:g} s are too short to optimise from all of them; for more of them, raise "
        "descent.seconds or use more workers",
    )


def consume(
    events: Generator[DesignEvent, None, T], callback: Callable[[DesignEvent], None] | None
) -> T:
    """Run a search to its end, with a callback for every event; return its result."""
    try:
        while True:
            try:
                event = next(events)
            except StopIteration as end:
                result: T = end.value
                return result
            if callback is not None:
                callback(event)
    finally:
        # A callback that raises an error ends the search, with all moves in other processes.
        events.close()


@checked
def design_jointly(
    experiments: Sequence[ExperimentLike],
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
                    task.restated(task.experiment, added=EarlierExperiments(information=added)),
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
    # The initial control may excite some combinations only; the others carry no information.
    excited = identifiability_along(task, point).along_trajectory
    assert point.information is not None
    basis = excited.basis if excited.count else None
    information = replace(task.information, basis=basis)

    return shared(
        information.without_round_off(point.information - task.information.prior),
        task.parameters.prior_information,
        task.parameters.recording_specific,
    )
