"""`mjfim.compare`: a design against what else the same budget could have found, all judged alike."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import StopToken, stop_on_interrupt
from mjfim.errors import ExperimentError, SimulationDivergedError, unknown
from mjfim.excitation.design import design_budget, design_task, designable
from mjfim.excitation.evaluation import point_at_stated_rate
from mjfim.excitation.feasibility import SHRINK_FACTORS
from mjfim.excitation.levels import Stage
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import SAME_STATE_TOLERANCE, require_feasible_start, verify
from mjfim.experiment.schema import Experiment
from mjfim.parallel import collect_finished, workers_of
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.comparison import DESIGN, Comparison, MethodOutcome, MethodResult
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent
from mjfim.studies.baselines.evaluator import BaselineSearch, SearchResult
from mjfim.studies.baselines.methods import METHODS, run_baseline

OURS = "mjfim's design"
LATE = 1.05  # share of the seconds after which a design is ended
PLENTY = 100_000  # iterations of the design: only its budget ends it


@dataclass(frozen=True)
class Glance:
    """How far a comparison is. title: of the method;  place, count: its number among all;  used: share of its budget

    cost: the lowest J so far, infinite without any
    """

    title: str
    place: int
    count: int
    used: float
    cost: float


Monitor = Callable[[Glance], None]
Tell = Callable[[float, float], None]  # share of the budget, J


def compare(
    experiment: Experiment,
    seconds: float = 60.0,
    steps: float | None = None,
    seed: int = 0,
    methods: Sequence[str] | None = None,
    executor: Executor | None = None,
    monitor: Monitor | None = None,
    threads: int | None = None,
) -> Comparison:
    """Run baselines, then the design, on an experiment: each for so many seconds and MuJoCo steps, whichever end first.

    methods: keys of `baselines.METHODS`, default: all that make sense;  seed: of the baselines
    executor: of `concurrent.futures`, among whose workers each method is shared out;  monitor: called during the searches
    All look for a control under the same limits, by the same J, and are judged on the untouched model at every engine step.
    Ctrl-C returns the methods that are finished. Raises as `design` does.
    """
    task = DesignTask.resolve(experiment, threads=threads)
    return compare_task(task, seconds, steps, seed, methods, executor, monitor)


def compare_task(
    task: DesignTask,
    seconds: float = 60.0,
    steps: float | None = None,
    seed: int = 0,
    methods: Sequence[str] | None = None,
    executor: Executor | None = None,
    monitor: Monitor | None = None,
) -> Comparison:
    """Compare the design of a resolved task with baselines. See `compare`."""
    if not (seconds > 0.0 and np.isfinite(seconds)) or not (steps is None or steps > 0.0):
        raise ExperimentError("compare: seconds and steps must be positive")
    chosen = (*chosen_methods(task, methods), DESIGN)
    judge = Judge(task, _combinations(task))
    most = np.inf if steps is None else float(steps)
    job = BaselineSearch(
        experiment=task.experiment,
        method=DESIGN,
        seconds=seconds,
        steps=most,
        seed=seed,
        combinations=judge.stage.basis,
        added_information=task.added_information,
        threads=task.system.threads,
    )
    rows: list[MethodResult] = []
    interrupted = False
    try:
        for i, method in enumerate(chosen):
            title = OURS if method == DESIGN else METHODS[method].title
            tell = _teller(monitor, title, i, len(chosen))
            if method == DESIGN:
                row, interrupted = _designed(judge, job, executor, tell)
            else:
                row = judge.row(method, title, _tried(replace(job, method=method), executor, tell))
            rows.append(row)
    except KeyboardInterrupt:
        interrupted = True
    p = task.parameters
    return Comparison(
        source=task.experiment.source,
        criterion=task.experiment.cost.criterion,
        nats=judge.nats,
        parameters=p.names,
        units=task.system.units,
        scale=p.scale,
        nuisance=tuple(q.name for q in p.parameters if q.nuisance),
        rows=tuple(rows),
        seconds=seconds,
        steps=most,
        seed=seed,
        weighted=bool(task.control_weight.any() or task.tracking.any()),
        interrupted=interrupted,
    )


def chosen_methods(task: DesignTask, methods: Sequence[str] | None) -> tuple[str, ...]:
    """Keys of the baselines that are to run. Raises ExperimentError for others."""
    if methods is None:
        return tuple(
            key for key, baseline in METHODS.items() if task.is_limited or not baseline.needs_limits
        )
    for key in methods:
        if key not in METHODS and key != DESIGN:
            raise ExperimentError(f"methods: {unknown('method', key, [*METHODS, DESIGN])}")
        if key in METHODS and METHODS[key].needs_limits and not task.is_limited:
            raise ExperimentError(
                f"methods: {key} needs hard limits; {task.experiment.source} has none that hold"
            )
    return tuple(key for key in dict.fromkeys(methods) if key != DESIGN)


def _combinations(task: DesignTask) -> Array | None:
    """The identifiable combinations, as a design finds them. Raises where nothing can be designed."""
    seen = designable(task)
    if task.is_limited:
        require_feasible_start(task)
    return seen.basis


def _teller(monitor: Monitor | None, title: str, place: int, count: int) -> Tell:
    def tell(used: float, cost: float) -> None:
        if monitor is not None:
            monitor(Glance(title, place, count, used, cost))

    return tell


def _tried(job: BaselineSearch, executor: Executor | None, tell: Tell) -> SearchResult:
    """A baseline's attempt; with an executor the best of as many as it has workers, each with its share of the steps."""
    if executor is None:
        return run_baseline(job, lambda used, attempt: tell(used, attempt.cost))
    count = workers_of(executor)
    jobs = [replace(job, part=(i, count), steps=job.steps / count, threads=1) for i in range(count)]
    futures: list[Future[SearchResult]] = []
    try:
        futures += [executor.submit(run_baseline, each) for each in jobs]
        attempts = [future.result() for future in futures]
    except BaseException:
        collect_finished(executor, futures)
        raise
    best = min(attempts, key=lambda attempt: (attempt.cost, -attempt.margin))
    return replace(
        best, seconds=max(a.seconds for a in attempts), steps=sum(a.steps for a in attempts)
    )


def _designed(
    judge: Judge, job: BaselineSearch, executor: Executor | None, tell: Tell
) -> tuple[MethodResult, bool]:
    """The design with the same budget, and whether the user interrupted it."""
    d = job.experiment.descent
    stated = job.experiment.replace(
        descent={"seconds": job.seconds, "max_iterations": max(d.max_iterations, PLENTY)}
    )
    meter = Meter(job, tell)
    try:
        task = DesignTask.resolve(
            stated, threads=job.threads, added_information=job.added_information
        )
        with stop_on_interrupt(meter.stop):
            found = design_task(
                task,
                callback=meter,
                executor=executor,
                budget=design_budget(task, meter.stop),
            )
    except SimulationDivergedError:
        return judge.row(
            DESIGN, OURS, SearchResult(seconds=meter.seconds, steps=meter.steps)
        ), False
    attempt = SearchResult(
        control=found.trajectory.ctrl,
        cost=found.final.cost,
        margin=0.0,
        found_by=found.found_by,
        seconds=found.seconds,
        steps=found.steps,
    )
    row = judge.row(
        DESIGN, OURS, attempt, "" if meter.spent else found.status.value.split(":")[0].split(";")[0]
    )
    return row, found.status is Status.INTERRUPTED and not meter.spent


class Meter:
    """Watches the iterates of a design and asks it to stop where its budget is used up."""

    def __init__(self, job: BaselineSearch, tell: Tell) -> None:
        self.job, self.tell = job, tell
        self.clock, self.steps, self.last, self.cost = time.perf_counter(), 0, 0, np.inf
        self.spent = False
        self.stop = StopToken()

    @property
    def seconds(self) -> float:
        """Since the start."""
        return time.perf_counter() - self.clock

    def __call__(self, event: DesignEvent) -> None:
        """Count the steps of an iterate, which begin anew with every task of a design."""
        row = event.row
        self.steps += row.steps - (self.last if row.steps >= self.last else 0)
        self.last = row.steps
        if not row.margin < 0.0:
            self.cost = min(self.cost, row.cost)
        seconds, steps = self.seconds / self.job.seconds, self.steps / self.job.steps
        self.tell(max(seconds, steps), self.cost)
        if (
            seconds > LATE or steps > 1.0
        ):  # a design keeps the time by itself, but for its last iterate
            self.spent = True
            self.stop.request()


class Judge:
    """Looks at every method's control in the same way: at the stated rate, on the user's model.

    nats: see `Comparison`
    """

    def __init__(self, task: DesignTask, combinations: Array | None) -> None:
        self.task, self.stage = task, Stage(task, combinations)
        e, p = task.experiment, task.parameters
        count = len(p.interest) if combinations is None else combinations.shape[1]
        self.nats = e.cost.information * count if e.cost.criterion == "D" else 0.0

    def row(self, method: str, title: str, attempt: SearchResult, note: str = "") -> MethodResult:
        """What an attempt is worth. A baseline's control that leaves the limits after all is shrunk until it does not."""
        if attempt.control is None:
            return self._nothing(method, title, attempt, note)
        first: MethodResult | None = None
        for share in (
            [1.0] if method == DESIGN or not np.isfinite(attempt.cost) else SHRINK_FACTORS.tolist()
        ):
            control = self.task.centre + share * (attempt.control - self.task.centre)
            told = note if share == 1.0 else f"shrunk to {100.0 * share:.3g} %"
            found = self._looked(method, title, replace(attempt, control=control), told)
            if found is not None and found.outcome is not MethodOutcome.OUTSIDE:
                return found
            first = first or found
        return first or self._nothing(method, title, attempt, note)

    def _looked(
        self, method: str, title: str, attempt: SearchResult, note: str
    ) -> MethodResult | None:
        """None where the simulation diverges."""
        task = self.task
        point = (
            None if attempt.control is None else point_at_stated_rate(self.stage, attempt.control)
        )
        if (
            point is None
            or point.trajectory is None
            or point.criterion is None
            or point.information is None
        ):
            return None
        found = verify(task, point.trajectory)
        outcome = MethodOutcome.INSIDE if found.is_feasible else MethodOutcome.OUTSIDE
        if outcome is MethodOutcome.OUTSIDE and not np.isfinite(attempt.cost):
            outcome = MethodOutcome.NOTHING
        clamped = saturated_actuators(task.system.model_at(task.theta), point.trajectory)
        if outcome is MethodOutcome.INSIDE and clamped:
            outcome, note = MethodOutcome.CLAMPED, f"forcerange clamps {', '.join(clamped)}"
        elif found.deviation > SAME_STATE_TOLERANCE:
            note = f"a clamp, stop or contact acts: deviates by {found.deviation:.2g}"
        smallest = float(point.criterion.eigenvalues[0])
        return MethodResult(
            method=method,
            title=title,
            outcome=outcome,
            control=attempt.control,
            cost=point.cost,
            criterion=point.criterion.value,
            std=self.stage.problem.information.std(point.information),
            min_eigenvalue=smallest,
            worst_relative_std=(smallest * task.system.measure_rate) ** -0.5
            if smallest > 0.0
            else np.inf,
            seconds=attempt.seconds,
            steps=attempt.steps,
            margins=found.margins,
            relative_margins=found.relative_margins,
            found_by=attempt.found_by,
            note=note,
        )

    def _nothing(self, method: str, title: str, attempt: SearchResult, note: str) -> MethodResult:
        outcome = MethodOutcome.NONE if attempt.control is None else MethodOutcome.NOTHING
        blank = np.full(len(self.task.parameters), np.nan)
        return MethodResult(
            method=method,
            title=title,
            outcome=outcome,
            control=None,
            cost=np.nan,
            criterion=np.nan,
            std=blank,
            min_eigenvalue=np.nan,
            worst_relative_std=np.nan,
            seconds=attempt.seconds,
            steps=attempt.steps,
            margins={},
            relative_margins={},
            note=note,
        )
