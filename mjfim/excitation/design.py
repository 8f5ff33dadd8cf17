"""The verb `mjfim.design`: find the control that is most informative about the parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import (
    ExperimentError,
    SimulationDivergedError,
    UnidentifiableError,
    explain_renamed_arguments,
    first_ones,
    listed,
)
from mjfim.excitation.constraints import constraint_set_of
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.evaluation import design_warnings, evaluate_point, point_at_stated_rate
from mjfim.excitation.initial_controls import InitialControl, initial_controls_of
from mjfim.excitation.levels import DescentLevel, coarse_level, easier_level
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.release_search import ReleaseSearch
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.run_result import RunResult, Runs, consume
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import UnconstrainedSearch
from mjfim.excitation.verification import Verification, require_feasible_start, verify
from mjfim.excitation.violations import all_violations_of
from mjfim.experiment.labels import labels_of_system
from mjfim.experiment.schema import Experiment
from mjfim.information.identifiability import PROBES, Identifiability
from mjfim.information.marginal import shared
from mjfim.information.smoothness import roughness
from mjfim.parallel import one_blas_thread
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.combinations import GROUPS_TEXT, ParameterGroup, groups_in_words
from mjfim.records.design import Design, Evaluation, ScaledStart, Status, without_motions
from mjfim.records.events import DesignCallback
from mjfim.records.progress import shown_progress


@explain_renamed_arguments
def design(
    experiment: Experiment,
    *,
    callback: DesignCallback | None = None,
    initial_control: Array | None = None,
    threads: int | None = None,
    executor: Executor | None = None,
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
        executor: Executor of `concurrent.futures` that runs several starts under hard limits side
            by side.
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
    executor: Executor | None = None,
    budget: Budget | None = None,
) -> Design:
    """Design the control of a task that is resolved already. See `design`.

    Args:
        task: The task.
        callback: Called with a `DesignEvent` for every iterate.
        initial_control: (N, nu) control to begin with [u-unit]; default: the experiment's.
        executor: Runs several starts under hard limits side by side.
        budget: Time of the design and the token that stops it; default: `[descent] seconds`.

    Returns:
        The design.
    """
    budget = design_budget(task) if budget is None else budget
    if task.release is not None:
        return _design_release(task, task.release, budget, callback)

    _require_controls(task)
    require_feasible_start(task)
    steps_before = task.plant.engine_steps

    # Evaluate the initial control and find the combinations that can be identified.
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    if initial_control is not None:
        initial_control = _checked_control(task, initial_control)
    starts = initial_controls_of(task, initial_control)
    begin = _point_of_given(task, first, initial_control)
    identifiability = _identifiability(task, begin)
    require_designable(task, identifiability)

    stage = DescentLevel(task, identifiability.basis)
    first, begin = stage.problem.reevaluated(first), stage.problem.reevaluated(begin)

    # Under hard limits, the design has to beat the initial control, scaled until it keeps them.
    limited = scaled = None
    if task.is_limited:
        limited = LimitedCost(level=DescentLevel(task.relaxed(), identifiability.basis))
        scaled = _scaled_start(limited, task.control, budget)

    search = _Search(
        stage=stage, first=first, executor=executor, budget=budget, limited=limited, scaled=scaled
    )
    results = consume(search.run(starts), callback)
    interrupted = budget.stop.requested

    # Steps on other plants, also those of workers, are counted by the runs.
    steps = task.plant.engine_steps - steps_before + sum(result.steps for result in results)
    best, chosen = _choose(search, [first, begin], results, interrupted)
    report = _Report(
        stage=stage,
        identifiability=identifiability,
        initial=first,
        final=chosen,
        scaled_start=None if scaled is None else scaled.record,
    )
    return report.design(best, results, budget.seconds_used, steps, interrupted)


def _design_release(
    task: DesignTask, space: ReleaseSpace, budget: Budget, callback: DesignCallback | None
) -> Design:
    """Design the initial state of a motion whose control is given. See `design`."""
    require_feasible_start(task)
    steps_before = task.plant.engine_steps

    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = _identifiability(task, first)
    require_designable(task, identifiability)
    stage = DescentLevel(task, identifiability.basis)
    first = stage.problem.reevaluated(first)

    search = ReleaseSearch(stage, space, budget, callback)
    found = search.run()
    interrupted = budget.stop.requested

    # The stated release stays where no better one within the limits was found.
    chosen, played = found.best.point, task
    if first.cost < chosen.cost and _keeps_limits(task, first):
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
    report = _Report(
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


def _identifiability(task: DesignTask, begin: DesignPoint) -> Identifiability:
    """Find the combinations of parameters that can be identified.

    They are looked for along the control with which the search begins and along random controls.
    """
    require_evaluated(task, begin)
    if begin.trajectory is None or begin.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges")
    return task.identifiability_test.along(begin.trajectory, begin.sensitivity)


def require_evaluated(task: DesignTask, begin: DesignPoint) -> None:
    """Raise SimulationDivergedError where the control with which a search begins diverges."""
    values = (begin.information, begin.trajectory, begin.sensitivity)
    if all(value is not None for value in values):
        return

    reason = "when the parameters change slightly along the initial control"
    if task.samples_of_parameters is not None:
        reason += (
            ", or at a parameter sample of [robust]; state bounds within which the model is valid"
        )
    raise SimulationDivergedError(f"the simulation diverges {reason}")


def _scaled_start(limited: LimitedCost, control: Array, budget: Budget) -> InsideControl | None:
    """The largest share of a control that keeps all limits; None where the control keeps them."""
    if budget.stop.requested or limited.trajectory(control) is not None:
        return None
    return ControlsWithinLimits(cost=limited, budget=budget).scaled(control)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """Search for the best control from several initial controls.

    Attributes:
        stage: The stated level.
        first: The experiment's initial control, evaluated.
        executor: Runs several starts under hard limits side by side, or None.
        budget: Time of the search and the token that stops it.
        limited: Cost of controls that keep the hard limits; None without limits.
        scaled: The largest share of the initial control that keeps all limits; None where the
            initial control keeps them, or where no share does.
    """

    stage: DescentLevel
    first: DesignPoint
    executor: Executor | None
    budget: Budget
    limited: LimitedCost | None = None
    scaled: InsideControl | None = None

    def run(self, starts: Iterable[InitialControl]) -> Runs:
        """Yield every iterate of all runs; return their results on the stated plant."""
        if self.limited is None:
            return (yield from self._run_without_barrier(starts))

        return (yield from self._run_within_limits(list(starts), self.limited))

    def keeps_limits(self, point: DesignPoint) -> bool:
        """Check whether the trajectory of a point keeps the hard limits, if there are any."""
        if self.limited is None:
            return True
        curve = point.trajectory
        return curve is not None and self.limited.trajectory(curve.ctrl) is not None

    def _run_without_barrier(self, starts: Iterable[InitialControl]) -> Runs:
        """Descend from every start; under hard limits until one descent leaves them."""
        task, basis = self.stage.task, self.stage.basis
        coarse = coarse_level(task, self.first, basis)
        tasks = [task] if coarse is None else [coarse, task]

        search = UnconstrainedSearch(
            levels=[DescentLevel(level, basis) for level in tasks],
            budget=self.budget,
            constraints=constraint_set_of(task) if task.is_limited else None,
            steps_before=sum(level.plant.engine_steps for level in tasks),
        )
        return (yield from search.run_all(starts))

    def _run_within_limits(self, starts: list[InitialControl], limited: LimitedCost) -> Runs:
        """Optimise under hard limits.

        The search begins without a barrier where the weights of the cost may keep the limits.
        """
        results: list[RunResult] = []
        steps_without_barrier = 0

        if _is_bounded_by_weights(self.stage.task):
            results = yield from self._run_without_barrier(starts)
            if not results[-1].left_limits:
                return results

            # The start that left the limits continues from its last feasible control.
            left = results.pop()
            steps_without_barrier = left.steps
            starts = starts[len(results) :]
            if left.control is not None:
                starts[0] = InitialControl(name=starts[0].name, control=left.control)

        # A start far outside the limits is replaced by the best control inside that is found
        # without derivatives.
        inside = self.scaled
        if inside is not None and limited.is_far_outside(starts[0].control):
            inside = ControlsWithinLimits(cost=limited, budget=self.budget).best(inside)
            starts[0] = InitialControl(name=starts[0].name, control=inside.begin)

        free = limited.level
        multistart = Multistart(
            fine=free, coarse=easier_level(free), executor=self.executor, budget=self.budget
        )
        constrained = yield from multistart.run(starts)
        constrained = yield from multistart.tighten_winner(constrained)

        found = [self._on_stated_plant(result) for result in constrained]
        results += self._not_worse(found, inside)
        if results:
            steps = results[0].steps + steps_without_barrier
            results[0] = replace(results[0], steps=steps)
        return results

    def _not_worse(self, found: list[RunResult], inside: InsideControl | None) -> list[RunResult]:
        """Results whose first one is not worse than a control that keeps all limits."""
        if not found or inside is None:
            return found

        first = found[0]
        if first.is_feasible and first.cost <= inside.cost:
            return found

        # Nothing better was found from the first start.
        status = first.status
        if status is Status.INFEASIBLE or status.success:
            status = Status.BEST_SEEN
        kept = replace(first, control=inside.control, cost=inside.cost, status=status)
        return [self._on_stated_plant(kept), *found[1:]]

    def _on_stated_plant(self, result: RunResult) -> RunResult:
        """Result of one start, evaluated again on the unmodified plant."""
        point = None
        if result.control is not None:
            point = point_at_stated_rate(self.stage, result.control)

        # A stopped search has not verified its controls on the unmodified model.
        is_feasible = bool(np.isfinite(result.cost))
        if self.budget.stop.requested:
            trajectory = None if point is None else point.trajectory
            is_feasible = trajectory is not None and verify(self.stage.task, trajectory).is_feasible

        return replace(
            result,
            point=point,
            cost=np.inf if point is None else point.cost,
            is_feasible=is_feasible,
        )


def _is_bounded_by_weights(task: DesignTask) -> bool:
    """Check whether weights on all controls may keep the limits without a barrier.

    A barrier is needed for a boundary, a bandwidth, limits on control rates and a clearance.
    """
    limits = task.experiment.limits
    needs_barrier = task.is_shaped or bool(limits.control_rate) or limits.clearance is not None
    return not needs_barrier and bool((task.control_weight > 0.0).all())


def _choose(
    search: _Search, begins: Sequence[DesignPoint], results: list[RunResult], interrupted: bool
) -> tuple[RunResult, DesignPoint]:
    """Choose the best run and the point of the design.

    The point is that of the control with which the search began, or of the initial control, where
    no run found a better one: a search that was stopped early may have seen controls on a coarse
    level only, which are slightly worse. One that breaks a limit is chosen only if no run has a
    point.

    Args:
        search: The search.
        begins: The initial control and the one with which the search began.
        results: One result per run.
        interrupted: True where the search was stopped.
    """
    if not results:
        results.append(RunResult(name="initial control", status=Status.INTERRUPTED))

    # A search that was stopped on the coarse level has no point at the stated rate yet.
    last = results[-1]
    if last.point is None and last.control is not None:
        point = point_at_stated_rate(search.stage, last.control)
        cost = np.inf if point is None else point.cost
        results[-1] = replace(last, point=point, cost=cost)

    best = min(results, key=lambda result: (not result.is_feasible, result.cost))
    if best.point is None and not interrupted:
        raise SimulationDivergedError("the simulation diverges from every start")

    # The beginning counts where it costs less than the best run, or where that breaks a limit.
    bound = best.cost if best.is_feasible else np.inf
    cheaper = [begin for begin in begins if begin.cost < bound and search.keeps_limits(begin)]
    if cheaper:
        status = Status.BEST_SEEN if best.status is Status.INFEASIBLE else best.status
        return replace(best, status=status), min(cheaper, key=lambda begin: begin.cost)
    return best, begins[0] if best.point is None else best.point


def _keeps_limits(task: DesignTask, point: DesignPoint) -> bool:
    """Check whether a motion without controls keeps the hard limits, if there are any."""
    if not task.is_limited:
        return True

    return point.trajectory is not None and verify(task, point.trajectory).is_feasible


@dataclass(frozen=True, kw_only=True, eq=False)
class _Report:
    """Evaluation of a design, from which its record is made.

    Attributes:
        stage: The stated level.
        identifiability: The combinations that can be identified.
        initial: The initial control, evaluated.
        final: The designed control, evaluated.
        played: The task with the initial state of the design; None where it is the stated one.
        remarks: Warnings that belong to the search.
        scaled_start: The largest share of an initial control outside limits that keeps them.
    """

    stage: DescentLevel
    identifiability: Identifiability
    initial: DesignPoint
    final: DesignPoint
    played: DesignTask | None = None
    remarks: tuple[str, ...] = ()
    scaled_start: ScaledStart | None = None

    def design(
        self,
        best: RunResult,
        results: Sequence[RunResult],
        seconds: float,
        steps: int,
        interrupted: bool,
    ) -> Design:
        """The design of the best run, with its warnings."""
        task = self.stage.task
        initial = evaluate_point(self.stage, self.initial)
        final = evaluate_point(self.stage, self.final)

        # The limits, on the model as the user wrote it.
        found = verify(self.played or task, final.trajectory)
        model = task.system.model_at(task.theta)
        clamped = saturated_actuators(model, final.trajectory)

        # Check that derivatives exist along the design; after Ctrl-C this would take too long.
        rough = None
        if not interrupted:
            rough = roughness(
                task.plant,
                task.system.noise,
                model,
                task.theta,
                final.trajectory,
                self.final.sensitivity,
            )

        status = Status.INTERRUPTED if interrupted else best.status
        if status.ended_as_planned and (rough is not None or clamped):
            status = Status.ROUGH
        if task.is_limited and not found.is_feasible and not interrupted:
            status = Status.INFEASIBLE

        warnings = (*design_warnings(final, found, task, clamped, rough), *self.remarks)
        return self._record(
            best=best,
            results=results,
            seconds=seconds,
            steps=steps,
            status=status,
            initial=initial,
            final=final,
            found=found,
            warnings=warnings,
        )

    def _record(
        self,
        *,
        best: RunResult,
        results: Sequence[RunResult],
        seconds: float,
        steps: int,
        status: Status,
        initial: Evaluation,
        final: Evaluation,
        found: Verification,
        warnings: tuple[str, ...],
    ) -> Design:
        """The record of the design."""
        task = self.stage.task
        information = self.stage.problem.information
        parameters = task.parameters
        combined = self.identifiability.combinations(
            information, task.theta[parameters.interest], initial.information, final.information
        )
        data = shared(
            information.without_round_off(final.information - task.prior),
            parameters.prior_information,
            parameters.recording_specific,
        )
        history, motions = without_motions(best.history)
        return Design(
            status=status,
            parameters=parameters.names,
            theta=task.theta,
            initial=initial,
            final=final,
            history=history,
            slope=best.slope,
            steps=steps,
            seconds=seconds,
            limits=found.margins,
            usage=found.usage,
            initial_violations=all_violations_of(task, initial.trajectory),
            scaled_start=self.scaled_start,
            warnings=warnings,
            found_by=best.name,
            starts=tuple(result.start_result for result in results),
            nuisance=tuple(p.name for p in parameters.parameters if p.nuisance),
            combinations=tuple(str(group) for group in self.identifiability.groups_along_all),
            combined=combined,
            prior=task.prior,
            data=data,
            labels=labels_of_system(task.system),
            sizes=parameters.sizes(task.theta),
            motions=motions,
        )


def designable(task: DesignTask) -> Identifiability:
    """Find what can be identified, and require that a design can begin at the initial control.

    Args:
        task: The task.

    Returns:
        The combinations that are identifiable along the initial control and along random ones.

    Raises:
        UnidentifiableError: A parameter has no effect, or the initial control does not excite it.
        SimulationDivergedError: The simulation diverges along the initial control.
    """
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = _identifiability(task, first)
    require_designable(task, identifiability)
    return identifiability


def require_designable(task: DesignTask, identifiability: Identifiability) -> None:
    """Require that every parameter has an effect, and that the initial control excites it.

    The initial control has to excite every combination of parameters that a random control
    excites. Members of a declared inertia may have no effect; the design then works on the
    combinations that have one.

    Args:
        task: The task.
        identifiability: The combinations that can be identified.

    Raises:
        UnidentifiableError: A parameter has no effect on the outputs, or the initial control does
            not excite it.
    """
    along_all = identifiability.along_all
    parameters = task.parameters
    estimated = [parameters.parameters[j] for j in parameters.interest]

    # Parameters without any effect.
    tried = "control" if task.release is None else "release"
    silent = [estimated[i].name for i in along_all.silent if not estimated[i].group]
    if silent:
        raise UnidentifiableError(
            f"{_subject(silent)} nothing in the measured outputs, neither along the initial "
            f"{tried} nor along {PROBES} random {tried}s; remove "
            f"{'it' if len(silent) == 1 else 'them'}, or measure a quantity that shows the effect"
        )

    # A criterion for combinations that cannot be identified.
    if task.contrast is not None:
        information = replace(task.information, basis=identifiability.basis)
        if not information.is_estimable(task.contrast).all():
            raise UnidentifiableError(
                "cost.combination or cost.subset states a combination that cannot be identified; "
                "identifiable are: " + groups_in_words(identifiability.groups_along_all)
            )

    if not along_all.basis.shape[1]:
        raise UnidentifiableError("no parameter has an effect on the measured outputs")

    # Combinations that random controls excite, but not the initial one. A search over all releases
    # does not need it.
    if task.release is not None:
        return
    if identifiability.along_trajectory.count > along_all.count:
        groups = identifiability.groups_along_trajectory
        unexcited = first_ones([_unexcited_group(group) for group in groups], "; ", GROUPS_TEXT)
        raise UnidentifiableError(
            f"the initial control does not excite: {unexcited}. Other controls do: begin with one "
            "that moves the joints of these parameters, for example a multisine"
        )


def _unexcited_group(group: ParameterGroup) -> str:
    """Name of a group that has an effect, but not along the initial control."""
    return group.short if group.combinations else group.short_names


def _subject(names: Sequence[str]) -> str:
    """Beginning of a sentence about some parameters."""
    quoted = listed([f"parameters.{name}" for name in names])
    return f"{quoted} {'changes' if len(names) == 1 else 'change'}"
