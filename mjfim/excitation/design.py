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
from mjfim.excitation.constraints import Fence, fence_of
from mjfim.excitation.evaluation import evaluate, fine_point, warnings_of
from mjfim.excitation.initial_controls import Start, starts_of
from mjfim.excitation.multistart import Contest
from mjfim.excitation.objective import Point
from mjfim.excitation.unconstrained import COARSEST, Run, Stage, borne, coarse_level, descend
from mjfim.excitation.verification import audit, require_inside
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import Setup
from mjfim.information.identifiability import PROBES, Survey, survey
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
    experiment: Experiment | Setup,
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
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment, threads)
    require_inside(setup)
    clock, begun = time.perf_counter(), setup.plant.engine_steps
    first = setup.problem.point(setup.initial, CENTRAL_DIFFERENCES)
    if start is not None:
        start = np.asarray(start, dtype=np.float64)
        if start.shape != setup.control.shape:
            raise ExperimentError(
                f"start: shape {start.shape}, wanted (samples, actuators) = {setup.control.shape}"
            )
    starts = starts_of(setup, start)
    begin = (
        first
        if start is None
        else setup.problem.point(setup.plant.simulate(setup.theta, start), CENTRAL_DIFFERENCES)
    )
    if first.information is None or begin.trajectory is None or begin.sensitivity is None:
        why = "when the parameters move a little along the initial control"
        if setup.pool is not None:
            why += ", or at a parameter sample of [robust]; bounds keep samples where the model makes sense"
        raise SimulationDivergedError(f"the simulation diverges {why}")
    seen = survey(setup, begin.trajectory, begin.sensitivity)
    require_designable(setup, seen)
    stage = Stage(setup, seen.basis)
    first = stage.problem.judged(first)
    runs: list[Run] = []
    with threadpool_limits(
        1, user_api="blas"
    ):  # small matrices: threads of BLAS only wait for each other
        rows = (
            _enclosed(stage, first, starts, executor, runs, clock)
            if setup.enforced
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
    spent = setup.plant.engine_steps - begun + sum(run.steps for run in runs)
    return _conclude(stage, seen, first, runs, time.perf_counter() - clock, spent)


def _free(
    stage: Stage,
    first: Point,
    starts: Iterable[Start],
    runs: list[Run],
    clock: float,
    fence: Fence | None = None,
) -> Generator[HistoryRow, None, None]:
    """Descents without a barrier, from every start while there is time; with a fence, until one leaves it."""
    setup = stage.setup
    until = clock + (setup.experiment.descent.seconds or np.inf)
    coarse = coarse_level(setup, first, stage.basis)
    levels = (setup,) if coarse is None else (coarse, setup)
    begun = sum(level.plant.engine_steps for level in levels)
    for begin in starts:
        runs.append(Run(begin.name))
        elsewhere = sum(run.steps for run in runs)
        for row in descend(
            [Stage(level, stage.basis) for level in levels], begin.whole, runs[-1], fence
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
    first: Point,
    starts: Iterable[Start],
    executor: Executor | None,
    runs: list[Run],
    clock: float,
) -> Generator[HistoryRow, None, None]:
    """Descents inside the limits. Where soft weights alone keep them, there is no barrier to begin with."""
    setup, starts, elsewhere = stage.setup, list(starts), 0
    if _weighted(setup):
        yield from _free(stage, first, starts, runs, clock, fence_of(setup))
        if not runs[-1].outside:
            return
        left = runs.pop()
        starts, elsewhere = starts[len(runs) :], left.steps
        if left.control is not None:  # as far as it came without a barrier
            starts[0] = Start(starts[0].name, left.control)
    free = setup.free()
    chases: list[Chase] = []
    contest = Contest(Stage(free, stage.basis), _easier(Stage(free, stage.basis)), executor, clock)
    try:
        yield from contest.run(starts, chases)
        yield from contest.prove(chases)
    finally:
        cut = any(chase.status is Status.INTERRUPTED for chase in chases)
        runs += [_settled(stage, chase, cut) for chase in chases]
        if runs:
            runs[0].steps += elsewhere


def _weighted(setup: Setup) -> bool:
    """The weights alone bound the design, and nothing but ranges is asked for."""
    e = setup.experiment
    hard = setup.shaped or bool(e.limits.control_rate) or e.limits.clearance is not None
    return not hard and bool((setup.control_weight > 0.0).all())


def _easier(fine: Stage) -> Stage | None:
    """A level with softened friction, with a longer timestep, or with longer samples where they are one timestep."""
    smooth = replace(fine, setup=fine.setup.softened()) if fine.setup.level.soft else fine
    try:
        begin = smooth.problem.point(smooth.setup.initial)
    except SimulationDivergedError:
        return None
    for factor in _factors(smooth.setup):
        coarse = _coarser(smooth, begin, factor)
        if coarse is not None:
            return coarse
    return None if smooth is fine else smooth


def _factors(setup: Setup) -> tuple[int, ...]:
    """Candidates for the timestep of a coarse level, the longest first."""
    stated = setup.experiment.descent.coarse
    if stated != "auto":
        if setup.substeps % stated and setup.samples % stated:
            raise ExperimentError(
                f"{setup.experiment.source}: descent.coarse: {stated} divides neither the {setup.substeps} engine steps of a "
                f"sample nor the {setup.samples} samples"
            )
        return () if stated == 1 else (stated,)
    return tuple(k for k in LONGER if setup.substeps % k == 0) or (HALF,)


def _coarser(stage: Stage, begin: Point, factor: int) -> Stage | None:
    """A level so many times coarser, if the model bears it. begin: the stage's initial point"""
    setup = stage.setup
    stretch = setup.substeps % factor == 0
    parts = [setup.samples // count for count in (1, *setup.experiment.descent.repeats)]
    if not (
        stretch or (all(N % factor == 0 for N in parts) and setup.samples >= COARSEST * factor)
    ):
        return None
    try:
        coarse = Stage(setup.stretched(factor) if stretch else setup.coarser(factor), stage.basis)
    except ExperimentError:
        return None
    return coarse if borne(coarse, begin, setup.problem.size(begin), TOLERATED) else None


def _settled(stage: Stage, chase: Chase, cut: bool) -> Run:
    """What came of a start, on the plant as it is. cut: the contest was, before anybody looked at it there"""
    run = Run(
        chase.name, None, chase.control, chase.status, chase.slope, chase.history, steps=chase.steps
    )
    if chase.control is not None:
        run.point = fine_point(stage, chase.control)
    run.inside = np.isfinite(chase.cost)
    if cut:
        found = None if run.point is None else run.point.trajectory
        run.inside = found is not None and audit(stage.setup, found).kept
    return run


def _conclude(
    stage: Stage, seen: Survey, first: Point, runs: list[Run], seconds: float, steps: int
) -> Design:
    setup = stage.setup
    if not runs:
        runs = [Run("initial control", status=Status.INTERRUPTED)]
    if runs[-1].point is None and runs[-1].control is not None:  # interrupted on the coarse level
        runs[-1].point = fine_point(stage, runs[-1].control)
    best = min(runs, key=lambda run: (not run.inside, run.cost))
    interrupted = any(run.status is Status.INTERRUPTED for run in runs)
    if best.point is None and not interrupted:
        raise SimulationDivergedError("the simulation diverges from every start")
    chosen = (
        first
        if best.point is None or (best.cost > first.cost and not setup.enforced)
        else best.point
    )
    initial, final, information = (
        evaluate(stage, first),
        evaluate(stage, chosen),
        stage.problem.information,
    )
    found = audit(setup, final.trajectory)
    clamped = saturated_actuators(setup.model_at(setup.theta), final.trajectory)
    rough = (
        None if interrupted else roughness(setup, setup.theta, final.trajectory, chosen.sensitivity)
    )
    status = Status.INTERRUPTED if interrupted else best.status
    if status.success and (rough is not None or clamped):
        status = Status.ROUGH
    if setup.enforced and not found.kept and not interrupted:
        status = Status.INFEASIBLE
    return Design(
        status=status,
        parameters=setup.parameters.names,
        theta=setup.theta,
        initial=initial,
        final=final,
        history=best.history,
        slope=best.slope,
        steps=steps,
        seconds=seconds,
        limits=found.margins,
        usage=found.usage,
        warnings=tuple(warnings_of(final, found, setup, clamped, rough)),
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
        nuisance=tuple(p.name for p in setup.parameters.parameters if p.nuisance),
        combinations=tuple(str(group) for group in seen.groups_always),
        combined=seen.combined(
            information,
            setup.theta[setup.parameters.interest],
            initial.information,
            final.information,
        ),
        prior=setup.prior,
        data=shared(
            information.visible(final.information - setup.prior),
            setup.parameters.prior_information,
            setup.parameters.recording_specific,
        ),
    )


def designable(setup: Setup) -> Survey:
    """Look along the initial control. Raises UnidentifiableError or SimulationDivergedError where no design can begin there."""
    first = setup.problem.point(setup.initial, CENTRAL_DIFFERENCES)
    if first.trajectory is None or first.sensitivity is None:
        raise SimulationDivergedError(
            "the simulation diverges when the parameters move a little along the initial control"
        )
    seen = survey(setup, first.trajectory, first.sensitivity)
    require_designable(setup, seen)
    return seen


def require_designable(setup: Setup, seen: Survey) -> None:
    """Raise UnidentifiableError where a parameter changes nothing at all, or the start does not excite what others would.

    Members of a declared inertia may be invisible: the design then works on what is visible of them.
    """
    p = setup.parameters
    wanted = [p.parameters[j] for j in p.interest]
    dead = [wanted[i].name for i in seen.always.silent if not wanted[i].group]
    if dead:
        raise UnidentifiableError(
            f"{_parameters(dead)} nothing in the measured outputs, neither along the initial control nor along "
            f"{PROBES} random ones; take {'it' if len(dead) == 1 else 'them'} out, or measure what shows the effect"
        )
    if setup.contrast is not None:
        information = replace(setup.information, basis=seen.basis)
        if not information.estimable(setup.contrast).all():
            raise UnidentifiableError(
                "cost.combination or cost.subset asks for what cannot be identified; what can is: "
                + "; ".join(str(group) for group in seen.groups_always)
            )
    if not seen.always.basis.shape[1]:
        raise UnidentifiableError("none of the parameters shows in the measured outputs")
    if seen.here.count > seen.always.count:
        raise UnidentifiableError(
            f"the start excites nothing along: {'; '.join(_plainly(g) for g in seen.groups_here)}. Another control would: "
            "start from one that moves those parameters' joints, a multisine for example"
        )


def _plainly(group: ParameterGroup) -> str:
    """A group that is not excited here, though it has an effect elsewhere."""
    return str(group) if group.combinations else join_names(group.members)


def _parameters(names: Sequence[str]) -> str:
    quoted = ", ".join(f"parameters.{name}" for name in names)
    return f"{quoted} {'changes' if len(names) == 1 else 'change'}"
