"""`mjfim.compare`: a design compared with baselines of equal budget, all evaluated alike."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import field, replace

import numpy as np

from mjfim.arrays import Array, record
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
    require_feasible_start,
    verify,
)
from mjfim.excitation.search.inside import InsideSearch, LimitedCost
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.excitation.task_parts import require_controls
from mjfim.experiment.arguments import checked
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
from mjfim.studies.baselines import METHODS, TITLES, BaselineSearch, SearchResult, run_baseline

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
            run = _MethodRun(
                search=replace(search, method=method),
                index=i,
                count=len(chosen),
                callback=show,
                executor=workers,
                stop=token,
                identifiability=identifiability,
            )
            row = run.design(evaluation) if method == DESIGN else run.baseline(evaluation)

            # An interrupted method is kept with its best control so far.
            if row is not None:
                rows.append(row)
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


@record
class _MethodRun:
    """One method of a comparison."""

    search: BaselineSearch
    index: int
    count: int
    callback: Callback | None
    executor: ExecutorLike | None
    stop: StopToken
    identifiability: Identifiability
    begun: float = field(default_factory=time.monotonic)

    def report(self, cost: float) -> None:
        """Report the used share of the time and the lowest J so far."""
        if self.callback is None:
            return
        event = StudyEvent(
            study="compare",
            part=METHOD_TITLES[self.search.method],
            index=self.index,
            count=self.count,
            share=min((time.monotonic() - self.begun) / self.search.seconds, 1.0),
            message=f"best J {cost:.5g}",
        )
        self.callback(event)

    def baseline(self, evaluation: MethodEvaluation) -> MethodResult | None:
        """Run a baseline and evaluate its control; None where it was stopped without one."""
        result: SearchResult | None
        if self.executor is None:
            result = run_baseline(self.search, self.report, self.stop)
        else:
            result = self._divided(self.executor, evaluation.task.system)
        # An interrupted search is compared by its best control so far.
        interrupted = self.stop.requested
        if result is None or (interrupted and result.control is None):
            return None
        note = INTERRUPTED_NOTE if interrupted else ""
        return evaluation.result(self.search.method, result, note)

    def _divided(self, executor: ExecutorLike, system: System) -> SearchResult | None:
        """Run a part of a baseline in every worker; a part that is lost is left out."""
        count = Workers.of(executor).count
        experiment = for_workers(self.search.experiment, system.source)
        parts = [
            replace(self.search, experiment=experiment, threads=1, part=(i, count))
            for i in range(count)
        ]
        outcomes = list(carry_out(executor, run_baseline, parts, Budget(stop=self.stop)))
        results = [outcome.result for outcome in outcomes if not outcome.is_lost]
        if not results:
            return None
        return replace(
            min(results, key=lambda result: result.cost),
            seconds=max(result.seconds for result in results),
            steps=sum(result.steps for result in results),
        )

    def design(self, evaluation: MethodEvaluation) -> MethodResult | None:
        """Design with the time of the method, and evaluate the result.

        Returns:
            The result; None where the design was stopped before it had one.
        """
        best = np.inf

        def watch(event: Event) -> None:
            nonlocal best
            if self.callback is not None:
                self.callback(event)
            if isinstance(event, DesignEvent):
                best = best if event.row.margin < 0.0 else min(best, event.row.cost)
                self.report(best)

        iterations = max(self.search.experiment.descent.max_iterations, UNLIMITED_ITERATIONS)
        stated = self.search.experiment.replace(
            descent={"seconds": self.search.seconds, "max_iterations": iterations}
        )
        try:
            task = DesignTask.resolve(
                stated,
                threads=self.search.threads,
                added=self.search.added,
            )
            design = design_task(
                task,
                callback=watch,
                executor=self.executor,
                budget=design_budget(task, self.stop),
                identifiability=self.identifiability,
            )
        except SimulationDivergedError:
            nothing = SearchResult(seconds=time.monotonic() - self.begun)
            return evaluation.result(DESIGN, nothing)
        except NoResultError:
            return None

        result = SearchResult(
            control=design.trajectory.ctrl,
            cost=design.final.cost,
            found_by=design.found_by,
            seconds=design.seconds,
            steps=design.steps,
        )
        # A design that its time ended needs no remark about its status.
        status = design.status.value.split(":")[0].split(";")[0]
        is_late = design.status is Status.MAX_ITERATIONS
        return evaluation.result(DESIGN, result, "" if is_late else status)


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

    def result(self, method: str, found: SearchResult, note: str = "") -> MethodResult:
        """Evaluate the control that a method has found.

        The control of a baseline that violates a limit on the user's model is shrunk until no limit
        is violated. The control of a design is evaluated without changes.

        Args:
            method: Key of the method.
            found: The best control of its search.
            note: Remark about the result.
        """
        control = found.control
        nothing = MethodResult(
            method=method,
            title=METHOD_TITLES[method],
            outcome=MethodOutcome.NOTHING if found.steps else MethodOutcome.NONE,
            control=None,
            cost=np.nan,
            criterion=np.nan,
            std=np.full(len(self.task.parameters), np.nan),
            min_eigenvalue=np.nan,
            worst_relative_std=np.nan,
            seconds=found.seconds,
            steps=found.steps,
            margins={},
            relative_margins={},
            note=note,
        )
        if control is None:
            return nothing

        evaluated = self._evaluate(nothing, found, control)
        if method == DESIGN or evaluated.outcome is not MethodOutcome.OUTSIDE:
            return evaluated

        # A control that violates a limit of the unmodified model is made smaller.
        centre = self.task.centre
        relaxed = LimitedCost(level=DescentLevel(self.task.relaxed(), self.stage.basis))
        inside = InsideSearch(relaxed, 0).largest(centre, control - centre, Budget())
        if inside is None:
            return evaluated
        remarks = filter(None, [note, f"shrunk to {100.0 * inside.share:.3g} %"])
        return self._evaluate(replace(nothing, note=", ".join(remarks)), found, inside.control)

    def _evaluate(self, nothing: MethodResult, found: SearchResult, control: Array) -> MethodResult:
        """Evaluate a control without changing it; `nothing` where the simulation diverges.

        Args:
            nothing: The row of the method where it has no usable control.
            found: The result of the search.
            control: (N, nu) its control, perhaps made smaller [u-unit].
        """
        task, note = self.task, nothing.note
        point = point_at_stated_rate(self.stage, control)
        if point is None or point.trajectory is None:
            return nothing
        if point.criterion is None or point.information is None:
            return nothing

        # The outcome of the method, and a note for the user.
        verification = verify(task, point.trajectory)
        saturated = saturated_actuators(task.system.model_at(task.theta), point.trajectory)
        outcome = MethodOutcome.INSIDE if verification.is_feasible else MethodOutcome.OUTSIDE
        if outcome is MethodOutcome.OUTSIDE and not np.isfinite(found.cost):
            outcome = MethodOutcome.NOTHING

        if outcome is MethodOutcome.INSIDE and saturated:
            outcome = MethodOutcome.CLAMPED
            note = f"forcerange clamps {listed(saturated)}"
        elif verification.deviation > SAME_STATE_TOLERANCE:
            note = (
                f"a clamp, stop or contact acts: the states deviate by {verification.deviation:.2g}"
            )

        smallest = float(point.criterion.eigenvalues[0])
        worst = (smallest * task.system.measure_rate) ** -0.5 if smallest > 0.0 else np.inf
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
            note=note,
        )
