"""`mjfim.design`: find the control that reveals most, from one start or several, and say what came of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError, UnidentifiableError
from mjfim.excitation.constrained import Chase
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.evaluation import design_warnings, evaluate, point_at_stated_rate
from mjfim.excitation.initial_controls import InitialControl, initial_controls_of
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import COARSEST, Run, Stage, borne, coarse_level, descend
from mjfim.excitation.verification import require_feasible_start, verify
from mjfim.experiment.schema import Experiment
from mjfim.information.identifiability import PROBES, Identifiability
from mjfim.information.marginal import shared
from mjfim.information.smoothness import roughness
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.plant.derivatives import CENTRAL_DIFFERENCES
from mjfim.records.combinations import ParameterGroup, join_names
from mjfim.records.design import Design, HistoryRow, StartResult, Status

Monitor = Callable[[HistoryRow], None]
LONGER = (
    5,
    4,
    3,
    2,
)  # times that the timestep is longer on a coarse level under hard limits; the first that is borne
HALF = 2  # the same where samples become longer too
TOLERATED = 0.5  # relative change of the initial cost that it may make: all is optimised anew on the stated one


def design(
    experiment: Experiment,
    monitor: Monitor | None = None,
    start: Array | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
) -> Design:
    """Design the control that minimises eq. 3 of the paper, within the experiment's limits.

    monitor: called with every iterate;  start: (N, nu) control to start from instead of the experiment's initial one
    executor: of `concurrent.futures`, runs several starts under hard limits at once
    The initial control stays the reference x_d of the tracking term. Ctrl-C returns the best trajectory so far.
    Raises UnidentifiableError where the initial control excites nothing, ExperimentError for a faulty experiment.
    """
    task = DesignTask.resolve(experiment, threads=threads)
    return design_task(task, monitor, start, executor)


def design_task(
    task: DesignTask,
    monitor: Monitor | None = None,
    start: Array | None = None,
    executor: Executor | None = None,
) -> Design:
    """Design the control of a resolved task. See `design`."""
    require_feasible_start(task)
    clock, begun = time.perf_counter(), task.plant.engine_steps
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    if start is not None:
        start = np.asarray(start, dtype=np.float64)
        if start.shape != task.control.shape:
            raise ExperimentError(
                f"start: shape {start.shape}, wanted (samples, actuators) = {task.control.shape}"
            )
    starts = initial_controls_of(task, start)
    begin = (
        first
        if start is None
        else task.problem.point(task.plant.simulate(task.theta, start), CENTRAL_DIFFERENCES)
    )
    if first.information is None or begin.trajectory is None or begin.sensitivity is None:
        why = "when the parameters move a little along the initial control"
        if task.samples_of_parameters is not None:
            why += ", or at a parameter sample of [robust]; bounds keep samples where the model makes sense"
        raise SimulationDivergedError(f"the simulation diverges {why}")
    seen = task.observer.identifiability(begin.trajectory, begin.sensitivity)
    require_designable(task, seen)
    stage = Stage(task, seen.basis)
    first = stage.problem.reevaluated(first)
    runs: list[Run] = []
    with threadpool_limits(
        1, user_api="blas"
    ):  # small matrices: threads of BLAS only wait for each other
        rows = (
            _enclosed(stage, first, starts, executor, runs, clock)
            if task.is_limited
            else _free(stage, first, starts, runs, clock)
        )
        try:
            for row in rows:
                if monitor is not None:
                    monitor(row)
        except KeyboardInterrupt:
            rows.close()  # what a monitor interrupts is not yet told
            for run in runs[-1:]:
                run.status = Status.INTERRUPTED
    spent = task.plant.engine_steps - begun + sum(run.steps for run in runs)
    return _conclude(stage, seen, first, runs, time.perf_counter() - clock, spent)


def _free(
    stage: Stage,
    first: DesignPoint,
    starts: Iterable[InitialControl],
    runs: list[Run],
    clock: float,
    constraints: ConstraintSet | None = None,
) -> Generator[HistoryRow, None, None]:
    """Descents without a barrier, from every start while there is time; with a constraints, until one leaves it."""
    task = stage.task
    until = clock + (task.experiment.descent.seconds or np.inf)
    coarse = coarse_level(task, first, stage.basis)
    levels = (task,) if coarse is None else (coarse, task)
    begun = sum(level.plant.engine_steps for level in levels)
    for begin in starts:
        runs.append(Run(begin.name))
        elsewhere = sum(run.steps for run in runs)
        for row in descend(
            [Stage(level, stage.basis) for level in levels],
            begin.over_horizon,
            runs[-1],
            constraints,
        ):
            spent = sum(level.plant.engine_steps for level in levels) - begun
            told = replace(row, seconds=time.perf_counter() - clock, steps=spent)
            runs[-1].history += (told,)
            runs[-1].steps = 0 if coarse is None else coarse.plant.engine_steps - elsewhere
            yield told
            if time.perf_counter() > until:
                if runs[-1].status is Status.INTERRUPTED:
                    runs[-1].status = Status.MAX_ITERATIONS
                return
        if runs[-1].outside:
            return


def _enclosed(
    stage: Stage,
    first: DesignPoint,
    starts: Iterable[InitialControl],
    executor: Executor | None,
    runs: list[Run],
    clock: float,
) -> Generator[HistoryRow, None, None]:
    """Descents inside the limits. Where soft weights alone keep them, there is no barrier to begin with."""
    task, starts, elsewhere = stage.task, list(starts), 0
    if _weighted(task):
        yield from _free(stage, first, starts, runs, clock, constraint_set_of(task))
        if not runs[-1].outside:
            return
        left = runs.pop()
        starts, elsewhere = starts[len(runs) :], left.steps
        if left.control is not None:  # as far as it came without a barrier
            starts[0] = InitialControl(name=starts[0].name, control=left.control)
    free = task.relaxed()
    chases: list[Chase] = []
    multistart = Multistart(
        Stage(free, stage.basis), _easier(Stage(free, stage.basis)), executor, clock
    )
    try:
        yield from multistart.run(starts, chases)
        yield from multistart.prove(chases)
    finally:
        cut = any(chase.status is Status.INTERRUPTED for chase in chases)
        runs += [_settled(stage, chase, cut) for chase in chases]
        if runs:
            runs[0].steps += elsewhere


def _weighted(task: DesignTask) -> bool:
    """The weights alone bound the design, and nothing but ranges is asked for."""
    e = task.experiment
    hard = task.is_shaped or bool(e.limits.control_rate) or e.limits.clearance is not None
    return not hard and bool((task.control_weight > 0.0).all())


def _easier(fine: Stage) -> Stage | None:
    """A level with softened friction, with a longer timestep, or with longer samples where they are one timestep."""
    smooth = (
        replace(fine, task=fine.task.smoothed())
        if fine.task.system.variant.smoothing_speeds
        else fine
    )
    try:
        begin = smooth.problem.point(smooth.task.initial)
    except SimulationDivergedError:
        return None
    for factor in _factors(smooth.task):
        coarse = _coarser(smooth, begin, factor)
        if coarse is not None:
            return coarse
    return None if smooth is fine else smooth


def _factors(task: DesignTask) -> tuple[int, ...]:
    """Candidates for the timestep of a coarse level, the longest first."""
    stated = task.experiment.descent.coarse
    if stated != "auto":
        substeps = task.system.grid.substeps
        if substeps % stated and task.samples % stated:
            raise ExperimentError(
                f"{task.experiment.source}: descent.coarse: {stated} divides neither the {substeps} engine steps of a "
                f"sample nor the {task.samples} samples"
            )
        return () if stated == 1 else (stated,)
    return tuple(k for k in LONGER if task.system.grid.substeps % k == 0) or (HALF,)


def _coarser(stage: Stage, begin: DesignPoint, factor: int) -> Stage | None:
    """A level so many times coarser, if the model bears it. begin: the stage's initial point"""
    task = stage.task
    stretch = task.system.grid.substeps % factor == 0
    parts = [task.samples // count for count in (1, *task.experiment.descent.repeats)]
    if not (stretch or (all(N % factor == 0 for N in parts) and task.samples >= COARSEST * factor)):
        return None
    try:
        coarse = Stage(task.stretched(factor) if stretch else task.coarser(factor), stage.basis)
    except ExperimentError:
        return None
    return coarse if borne(coarse, begin, task.problem.size(begin), TOLERATED) else None


def _settled(stage: Stage, chase: Chase, cut: bool) -> Run:
    """What came of a start, on the plant as it is. cut: the multistart was, before anybody looked at it there"""
    run = Run(
        chase.name, None, chase.control, chase.status, chase.slope, chase.history, steps=chase.steps
    )
    if chase.control is not None:
        run.point = point_at_stated_rate(stage, chase.control)
    run.inside = np.isfinite(chase.cost)
    if cut:
        found = None if run.point is None else run.point.trajectory
        run.inside = found is not None and verify(stage.task, found).is_feasible
    return run


def _conclude(
    stage: Stage,
    seen: Identifiability,
    first: DesignPoint,
    runs: list[Run],
    seconds: float,
    steps: int,
) -> Design:
    task = stage.task
    if not runs:
        runs = [Run("initial control", status=Status.INTERRUPTED)]
    if runs[-1].point is None and runs[-1].control is not None:  # interrupted on the coarse level
        runs[-1].point = point_at_stated_rate(stage, runs[-1].control)
    best = min(runs, key=lambda run: (not run.inside, run.cost))
    interrupted = any(run.status is Status.INTERRUPTED for run in runs)
    if best.point is None and not interrupted:
        raise SimulationDivergedError("the simulation diverges from every start")
    chosen = (
        first
        if best.point is None or (best.cost > first.cost and not task.is_limited)
        else best.point
    )
    initial, final, information = (
        evaluate(stage, first),
        evaluate(stage, chosen),
        stage.problem.information,
    )
    found = verify(task, final.trajectory)
    clamped = saturated_actuators(task.system.model_at(task.theta), final.trajectory)
    rough = (
        None
        if interrupted
        else roughness(
            task.plant,
            task.system.noise,
            task.system.model_at(task.theta),
            task.theta,
            final.trajectory,
            chosen.sensitivity,
        )
    )
    status = Status.INTERRUPTED if interrupted else best.status
    if status.success and (rough is not None or clamped):
        status = Status.ROUGH
    if task.is_limited and not found.is_feasible and not interrupted:
        status = Status.INFEASIBLE
    return Design(
        status=status,
        parameters=task.parameters.names,
        theta=task.theta,
        initial=initial,
        final=final,
        history=best.history,
        slope=best.slope,
        steps=steps,
        seconds=seconds,
        limits=found.margins,
        usage=found.usage,
        warnings=tuple(design_warnings(final, found, task, clamped, rough)),
        found_by=best.name,
        starts=tuple(
            StartResult(
                name=r.name,
                cost=r.cost,
                status=r.status,
                iterations=r.history[-1].iteration if r.history else 0,
            )
            for r in runs
        ),
        nuisance=tuple(p.name for p in task.parameters.parameters if p.nuisance),
        combinations=tuple(str(group) for group in seen.groups_along_all),
        combined=seen.combinations(
            information,
            task.theta[task.parameters.interest],
            initial.information,
            final.information,
        ),
        prior=task.prior,
        data=shared(
            information.without_round_off(final.information - task.prior),
            task.parameters.prior_information,
            task.parameters.recording_specific,
        ),
    )


def designable(task: DesignTask) -> Identifiability:
    """Look along the initial control. Raises UnidentifiableError or SimulationDivergedError where no design can begin there."""
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    if first.trajectory is None or first.sensitivity is None:
        raise SimulationDivergedError(
            "the simulation diverges when the parameters move a little along the initial control"
        )
    seen = task.observer.identifiability(first.trajectory, first.sensitivity)
    require_designable(task, seen)
    return seen


def require_designable(task: DesignTask, seen: Identifiability) -> None:
    """Raise UnidentifiableError where a parameter changes nothing at all, or the start does not excite what others would.

    Members of a declared inertia may be invisible: the design then works on what is visible of them.
    """
    p = task.parameters
    wanted = [p.parameters[j] for j in p.interest]
    dead = [wanted[i].name for i in seen.along_all.silent if not wanted[i].group]
    if dead:
        raise UnidentifiableError(
            f"{_parameters(dead)} nothing in the measured outputs, neither along the initial control nor along "
            f"{PROBES} random ones; take {'it' if len(dead) == 1 else 'them'} out, or measure what shows the effect"
        )
    if task.contrast is not None:
        information = replace(task.information, basis=seen.basis)
        if not information.is_estimable(task.contrast).all():
            raise UnidentifiableError(
                "cost.combination or cost.subset asks for what cannot be identified; what can is: "
                + "; ".join(str(group) for group in seen.groups_along_all)
            )
    if not seen.along_all.basis.shape[1]:
        raise UnidentifiableError("none of the parameters shows in the measured outputs")
    if seen.along_trajectory.count > seen.along_all.count:
        unexcited = "; ".join(_plainly(group) for group in seen.groups_along_trajectory)
        raise UnidentifiableError(
            f"the start excites nothing along: {unexcited}. Another control would: "
            "start from one that moves those parameters' joints, a multisine for example"
        )


def _plainly(group: ParameterGroup) -> str:
    """A group that is not excited here, though it has an effect elsewhere."""
    return str(group) if group.combinations else join_names(group.members)


def _parameters(names: Sequence[str]) -> str:
    quoted = ", ".join(f"parameters.{name}" for name in names)
    return f"{quoted} {'changes' if len(names) == 1 else 'change'}"
