"""`mjfim.compare`: a design compared with baselines of equal budget, all evaluated alike."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import (
    ExperimentError,
    NoResultError,
    SimulationDivergedError,
    listed,
    unknown,
)
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.evaluation import designable, point_at_stated_rate
from mjfim.excitation.limits.verification import (
    SAME_STATE_TOLERANCE,
    Verification,
    require_feasible_start,
    verify,
)
from mjfim.excitation.search.inside import InsideSearch
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import require_controls
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.information.identifiability import Identifiability
from mjfim.parallel import ExecutorLike, Workers, carry_out
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.design import Status
from mjfim.records.events import Callback, DesignEvent, Event, StudyEvent, shown_progress
from mjfim.records.studies import DESIGN, Comparison, MethodOutcome, MethodResult
from mjfim.records.trajectory import Trajectory
from mjfim.studies.baselines import METHODS, TITLES, BaselineSearch, SearchCallback, run_baseline

# Names of all methods for the user.
METHOD_TITLES = {**TITLES, DESIGN: "mjfim's design"}

# Remark about a method that the user interrupted.
INTERRUPTED_NOTE = "interrupted"

# Largest number of iterations of the design. It is never reached, because the budget ends the
# design.
UNLIMITED_ITERATIONS = 100_000


@checked
def compare(
    experiment: ExperimentLike,
    *,
    seconds: float = 60.0,
    seed: int = 0,
    methods: Sequence[str] | None = None,
    executor: ExecutorLike | None = None,
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Comparison:
    """Run baselines and then the design, each until its time is used up.

    All methods search for a control under one set of limits and with one cost J. They are evaluated
    at every engine step of the user's model.

    Args:
        experiment: Experiment for which controls are searched.
        seconds: Time of each method [s].
        seed: Seed of the baselines.
        methods: Keys of the baselines (`mjfim.studies.baselines.METHODS`); None for all
            that are applicable.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. Each
            method is divided among its workers.
        callback: Called with a `StudyEvent` while a method runs, and with every `DesignEvent` of
            the design.
        threads: Threads of MuJoCo; None for all cores.
        stop: Ends the comparison early, as Ctrl-C does; the methods that are finished are returned.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Raises:
        ExperimentError: A budget or a method is faulty.
        MjfimError: As `mjfim.design` raises it.
    """
    if not (seconds > 0.0 and np.isfinite(seconds)):
        raise ExperimentError("compare: seconds must be positive and finite")

    task = DesignTask.resolve(experiment, threads=threads)
    chosen = (*chosen_methods(task.system, methods), DESIGN)
    # What can be identified is found before the time of any method begins.
    identifiability = designable(task)
    if task.is_limited:
        require_feasible_start(task)
    evaluation = MethodEvaluation(task, identifiability.basis)
    search = BaselineSearch(
        experiment=task.experiment,
        method=DESIGN,
        seconds=seconds,
        seed=seed,
        combinations=evaluation.stage.basis,
        added=task.added,
        threads=task.system.threads,
    )

    rows = []
    workers = Workers.of_any(executor)
    with (
        stop_on_interrupt(stop) as token,
        shown_progress("comparing", callback, progress) as show,
    ):
        for i, method in enumerate(chosen):
            event = StudyEvent(
                study="compare",
                part=METHOD_TITLES[method],
                index=i,
                count=len(chosen),
                share=0.0,
            )
            report = partial(_report, show, event, time.monotonic(), seconds)
            own = replace(search, method=method)
            if method == DESIGN:
                found = _designed(own, show, report, workers, token, identifiability)
            else:
                found = _by_baseline(own, report, workers, token, task.system)

            # An interrupted method is kept with its best control so far.
            if found is not None:
                rows.append(evaluation.result(found))
            if token.requested:
                break

        interrupted = token.requested

    p = task.parameters
    return Comparison(
        source=task.experiment.source,
        criterion=task.experiment.cost.criterion,
        nats=evaluation.nats,
        parameters=p.names,
        units=task.system.units,
        scale=p.scale,
        nuisance=tuple(parameter.name for parameter in p.parameters if parameter.nuisance),
        rows=tuple(rows),
        seconds=seconds,
        seed=seed,
        weighted=bool(task.control_weight.any() or task.tracking.any()),
        interrupted=interrupted,
    )


def chosen_methods(system: System, methods: Sequence[str] | None) -> tuple[str, ...]:
    """Choose the baselines that run.

    Args:
        system: The system.
        methods: Keys that the user requests; None for all that are applicable.

    Returns:
        Keys of the baselines, without the design.

    Raises:
        ExperimentError: No baseline is requested, a key is unknown, or its method is not
            applicable.
    """
    require_controls(system, "compare")
    if methods is None:
        return tuple(METHODS)
    for key in methods:
        if key not in METHODS and key != DESIGN:
            raise ExperimentError(f"methods: {unknown('method', key, [*METHODS, DESIGN])}")
    chosen = tuple(key for key in dict.fromkeys(methods) if key != DESIGN)
    if not chosen:
        raise ExperimentError(
            "methods: no baseline is named, so that the design would be compared with nothing; "
            f"valid: {', '.join(METHODS)}"
        )
    return chosen


def _report(
    callback: Callback | None, event: StudyEvent, begun: float, seconds: float, cost: float
) -> None:
    """Report the used share of the time of a method [s], and the lowest J so far."""
    if callback is not None:
        share = min((time.monotonic() - begun) / seconds, 1.0)
        callback(replace(event, share=share, message=f"best J {cost:.5g}"))


def _by_baseline(
    search: BaselineSearch,
    report: SearchCallback,
    executor: Workers | None,
    stop: StopToken,
    system: System,
) -> MethodResult | None:
    """Run a baseline; None where it was stopped without a control."""
    found: MethodResult | None
    if executor is None:
        found = run_baseline(search, report, stop)
    else:
        found = _divided(search, executor, stop, system)
    # An interrupted search is compared by its best control so far.
    if found is None or (stop.requested and found.control is None):
        return None
    return replace(found, note=INTERRUPTED_NOTE if stop.requested else "")


def _divided(
    search: BaselineSearch, workers: Workers, stop: StopToken, system: System
) -> MethodResult | None:
    """Run a part of a baseline in every worker; a part that is lost is left out."""
    count = workers.count
    experiment = for_workers(search.experiment, system.source)
    parts = [
        replace(search, experiment=experiment, threads=1, part=(i, count)) for i in range(count)
    ]
    outcomes = carry_out(workers, run_baseline, parts, Budget(stop=stop))
    results = [result for _, found in outcomes for result in found]
    if not results:
        return None
    return replace(
        min(results, key=lambda result: result.cost),
        seconds=max(result.seconds for result in results),
        steps=sum(result.steps for result in results),
    )


def _designed(
    search: BaselineSearch,
    callback: Callback | None,
    report: SearchCallback,
    executor: Workers | None,
    stop: StopToken,
    identifiability: Identifiability,
) -> MethodResult | None:
    """Design with the time of the method; None where it was stopped before it had a result."""
    best = np.inf

    def watch(event: Event) -> None:
        nonlocal best
        if callback is not None:
            callback(event)
        if isinstance(event, DesignEvent):
            best = best if event.row.margin < 0.0 else min(best, event.row.cost)
            report(best)

    begun = time.monotonic()
    try:
        task = search.task(
            descent={"seconds": search.seconds, "max_iterations": UNLIMITED_ITERATIONS}
        )
        design = design_task(
            task,
            callback=watch,
            executor=executor,
            budget=design_budget(task, stop),
            identifiability=identifiability,
        )
    except SimulationDivergedError:
        return MethodResult(method=DESIGN, seconds=time.monotonic() - begun)
    except NoResultError:
        return None

    # A design that its time ended needs no remark about its status.
    is_late = design.status is Status.MAX_ITERATIONS
    return MethodResult(
        method=DESIGN,
        control=design.trajectory.ctrl,
        cost=design.final.cost,
        found_by=design.found_by,
        seconds=design.seconds,
        steps=design.steps,
        note="" if is_late else design.status.value.split(":")[0].split(";")[0],
    )


class MethodEvaluation:
    """Evaluates the controls of all methods alike: at the stated rate, on the user's model.

    Attributes:
        task: Task that is compared.
        stage: Its cost, with the identifiable combinations.
        nats: Cost of one e-fold of every eigenvalue with D-optimality, else 0; see `Comparison`.
    """

    def __init__(self, task: DesignTask, combinations: Array | None) -> None:
        self.task = task
        self.stage = DescentLevel(task, combinations)

        cost = task.experiment.cost
        count = len(task.parameters.interest) if combinations is None else combinations.shape[1]
        self.nats = cost.information * count if cost.criterion == "D" else 0.0

    def result(self, found: MethodResult) -> MethodResult:
        """Evaluate the control that a method has found.

        The control of a baseline that violates a limit on the user's model is shrunk until no limit
        is violated. The control of a design is evaluated without changes.

        Args:
            found: The best control of its search.
        """
        control = found.control
        nothing = replace(
            found,
            title=METHOD_TITLES[found.method],
            outcome=MethodOutcome.NOTHING if found.steps else MethodOutcome.NONE,
            control=None,
            cost=np.nan,
            std=np.full_like(self.task.theta, np.nan),
            found_by="",
        )
        if control is None:
            return nothing

        evaluated = self._evaluate(nothing, found, control)
        if found.method == DESIGN or evaluated.outcome is not MethodOutcome.OUTSIDE:
            return evaluated

        # A control that violates a limit of the unmodified model is made smaller.
        centre = self.task.centre
        relaxed = DescentLevel(self.task.relaxed(), self.stage.basis)
        inside = InsideSearch(relaxed, 0).largest(centre, control - centre, Budget())
        if inside is None:
            return evaluated
        remarks = filter(None, [found.note, f"shrunk to {100.0 * inside.share:.3g} %"])
        return self._evaluate(replace(nothing, note=", ".join(remarks)), found, inside.control)

    def _evaluate(self, nothing: MethodResult, found: MethodResult, control: Array) -> MethodResult:
        """Evaluate a control without changing it; `nothing` where the simulation diverges.

        Args:
            nothing: The row of the method where it has no usable control.
            found: The result of the search.
            control: (N, nu) its control, perhaps made smaller [u-unit].
        """
        point = point_at_stated_rate(self.stage, control)
        if point is None or point.trajectory is None:
            return nothing
        if point.criterion is None or point.information is None:
            return nothing

        verification = verify(self.task, point.trajectory)
        outcome, note = self._outcome(found, point.trajectory, verification)
        smallest = float(point.criterion.eigenvalues[0])
        rate = self.task.system.measure_rate
        worst = (smallest * rate) ** -0.5 if smallest > 0.0 else np.inf
        return replace(
            nothing,
            outcome=outcome,
            control=control,
            cost=point.cost,
            criterion=point.criterion.value,
            std=self.stage.problem.information.std(point.information),
            min_eigenvalue=smallest,
            worst_relative_std=worst,
            margins=verification.margins,
            relative_margins=verification.relative_margins,
            found_by=found.found_by,
            note=note or nothing.note,
        )

    def _outcome(
        self, found: MethodResult, trajectory: Trajectory, verification: Verification
    ) -> tuple[MethodOutcome, str]:
        """The outcome of a method, and what a clamp, a stop or a contact does; may be empty."""
        if not verification.is_feasible and not np.isfinite(found.cost):
            outcome = MethodOutcome.NOTHING
        else:
            is_inside = verification.is_feasible
            outcome = MethodOutcome.INSIDE if is_inside else MethodOutcome.OUTSIDE

        saturated = saturated_actuators(self.task.system.model_at(self.task.theta), trajectory)
        if outcome is MethodOutcome.INSIDE and saturated:
            return MethodOutcome.CLAMPED, f"forcerange clamps {listed(saturated)}"
        if verification.deviation > SAME_STATE_TOLERANCE:
            deviation = f"{verification.deviation:.2g}"
            return outcome, f"a clamp, stop or contact acts: the states deviate by {deviation}"
        return outcome, ""
