"""One optimisation under hard limits from one initial control, in this or in another process."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.barrier_state import SearchState, unfinished
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierIterate, BarrierSchedule, InteriorPointMethod
from mjfim.excitation.interior_problem import values_of
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.search_slices import (
    SearchSlice,
    SliceLength,
    SliceOrder,
    worker_budget,
)
from mjfim.excitation.short_steps import ShortSteps
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import regulator_for
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import RELAXED, ModelVariant
from mjfim.parallel import offer_result, one_blas_thread
from mjfim.parallel.kept import KeptPerThread
from mjfim.records.design import HistoryRow, IterateMotion, Status, extended
from mjfim.records.events import DesignEvent
from mjfim.signals import independent_curves

# Power of the smooth E-criterion. The criterion is always smoothed here, because under hard limits
# several of the smallest eigenvalues meet.
SMOOTH_POWER = 40.0

# Growth of a small deviation along the trajectory above which the projection uses feedback. It is
# larger than without hard limits, because steps are shorter here.
FEEDBACK_THRESHOLD = 100.0

# Share of the budget of a design after which a descent has to be better than random controls.
PATIENCE_WITHOUT_PROGRESS = 0.35

# Weight of an eigenvector, relative to the largest weight, below which the gradient leaves it out.
MIN_EIGENVECTOR_WEIGHT = 3e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class ConstrainedSearch:
    """Order for one constrained optimisation from one initial control.

    It can be pickled, so that a worker process can run it.

    Attributes:
        experiment: The experiment.
        start: Initial control, which may be infeasible.
        schedule: Weights mu of the barrier stages, and when a stage ends.
        max_iterations: Largest number of iterations.
        budget: Budget of the whole design; the time in the history counts from its beginning, and
            its token ends the search.
        seconds: Time that this search may take [s].
        combinations: (t, s) identifiable combinations of the parameters, or None where all are
            identifiable.
        added_information: (p, p) information of other experiments [1/theta^2], or None.
        variant: Plant on which the search runs; the result is evaluated on the stated plant later.
        threads: Threads for simulations; None for one per core.
        tightening: Share of half of each range that is held back, by kind of constraint.
        inside_first: Steer the control inside all limits before the cost is minimised, however
            little it violates them.
        until_held_up: End the search when its steps become very short.
        cost_to_beat: End the search, too, where it has not found a lower cost than this after
            `PATIENCE_WITHOUT_PROGRESS` of the budget of the whole design.
    """

    experiment: Experiment
    start: InitialControl
    schedule: BarrierSchedule
    max_iterations: int
    budget: Budget = field(default_factory=Budget)
    seconds: float = np.inf
    combinations: Array | None = None
    added_information: Array | None = None
    variant: ModelVariant = RELAXED
    threads: int | None = None
    tightening: Mapping[str, float] = field(default_factory=dict)
    inside_first: bool = False
    until_held_up: bool = False
    cost_to_beat: float = np.inf

    def run(self, task: DesignTask | None = None) -> Generator[DesignEvent, None, RunResult]:
        """Run the search.

        Args:
            task: The task on the plant of the search; default: resolved from the experiment.

        Yields:
            Every iterate.

        Returns:
            The best feasible control, or the last one where none is feasible.
        """
        whole = yield from self.run_slice(task, SliceLength())
        return whole.result

    def run_slice(
        self,
        task: DesignTask | None,
        length: SliceLength,
        before: SearchSlice[SearchState] | None = None,
    ) -> Generator[DesignEvent, None, SearchSlice[SearchState]]:
        """Run a part of the search, with the same result to the last digit as the whole of it.

        Args:
            task: The task on the plant of the search; default: resolved from the experiment.
            length: When the part ends.
            before: The part before, which has not ended the search; None for the first one.

        Yields:
            Every iterate of the part.

        Returns:
            The result so far, and the state from which the next part goes on.
        """
        task = self.resolved() if task is None else task
        if self.start.repeats > 1:
            task = task.with_horizon(task.horizon / self.start.repeats)

        begun = None if before is None else _Begun.of(before)
        return (yield from _Search.begin(self, task, length, begun).run(begun))

    def resolved(self) -> DesignTask:
        """The task on the plant of the search."""
        return DesignTask.resolve(
            self.experiment,
            threads=self.threads,
            added_information=self.added_information,
            variant=self.variant,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class ConstrainedSlice(SliceOrder[SearchState]):
    """Order for a slice of a search under hard limits.

    Attributes:
        search: The search.
    """

    search: ConstrainedSearch

    @property
    def name(self) -> str:
        """Name of the initial control."""
        return self.search.start.name


# Number of tasks that a worker keeps for later slices: those of all levels of a design, and that of
# the stated level with the threads of later rounds.
KEPT_TASKS = 6
_tasks = KeptPerThread[DesignTask](KEPT_TASKS)


def task_in_worker(key: str, search: ConstrainedSearch) -> DesignTask:
    """The task of a search, which a worker resolves once.

    Args:
        key: Text that is equal for searches on the same task.
        search: The search.
    """
    return _tasks.get(key, search.resolved)


@one_blas_thread()
def run_in_worker(order: ConstrainedSlice) -> SearchSlice[SearchState]:
    """Run a part of a search, for an executor.

    Args:
        order: The order. A request to stop by the token of its search or by that of the worker's
            pool ends it.

    Returns:
        The result so far, and the state.
    """
    search = order.search
    search = replace(search, budget=worker_budget(search.budget))
    task = task_in_worker(order.task_key, search)
    begun = time.monotonic()
    found = consume(search.run_slice(task, order.length, order.before), None)
    before = 0.0 if order.before is None else order.before.seconds
    return replace(found, seconds=before + time.monotonic() - begun)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Begun:
    """Result and state that earlier parts of a search have left.

    Attributes:
        result: The result so far.
        state: State from which the search goes on, which it may change.
    """

    result: RunResult
    state: SearchState

    @classmethod
    def of(cls, before: SearchSlice[SearchState]) -> _Begun | None:
        """Open what the part before has left; None where it has ended the search."""
        if before.state is None:
            return None
        return cls(result=before.result, state=before.state.opened())


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """A search whose task is resolved.

    Attributes:
        order: The order that is carried out.
        task: The task on the plant of the search, over one repetition.
        exact: The cost by which iterates are compared.
        curves: (N * coarsening, M) curves of which the control is made at the stated rate, or None
            where it is free.
        constraints: The tightened limits.
        method: Minimises the smooth cost within the tightened limits.
        budget: Time and iterations of the search.
        length: When this part of the search ends.
        steps_before: Engine steps of the plant when the search began.
    """

    order: ConstrainedSearch
    task: DesignTask
    exact: DesignProblem
    curves: Array | None
    constraints: ConstraintSet
    method: InteriorPointMethod
    budget: Budget
    length: SliceLength
    steps_before: int

    @classmethod
    def begin(
        cls,
        order: ConstrainedSearch,
        task: DesignTask,
        length: SliceLength,
        begun: _Begun | None,
    ) -> _Search:
        """Set up the interior-point method; the time of the search counts from here."""
        budget = Budget(
            seconds=order.seconds,
            iterations=order.max_iterations,
            stop=order.budget.stop,
        )
        steps_done = 0
        if begun is not None:
            budget = begun.state.barrier.budget.resumed(order.budget.stop)
            steps_done = begun.result.steps

        # The controls that hold the start are found once for all searches of a process, so their
        # few steps do not count.
        centre, *other_centres = task.centre, *task.centres[1:]
        steps_before = task.plant.engine_steps - steps_done

        # An initial control may bring its curves, such as a Fourier series; else a limited
        # bandwidth requires splines.
        curves = order.start.basis
        if curves is None:
            curves = bandwidth_basis(task, task.stated_times)
        basis = None if curves is None else independent_curves(task.averaged(curves))

        # With curves there is no feedback, because it would leave their span.
        threshold = FEEDBACK_THRESHOLD if basis is None else np.inf
        constraints = constraint_set_of(task).tightened(order.tightening)
        method = InteriorPointMethod(
            base=smoothed(task, order.combinations),
            constraints=constraints,
            centre=centre,
            basis=basis,
            regulator=replace(regulator_for(task), feedback_threshold=threshold),
            schedule=order.schedule,
            other_centres=tuple(other_centres),
            inside_first=order.inside_first,
        )
        return cls(
            order=order,
            task=task,
            exact=DescentLevel(task, order.combinations).problem,
            curves=curves,
            constraints=constraints,
            method=method,
            budget=budget,
            length=length,
            steps_before=steps_before,
        )

    def run(self, begun: _Begun | None) -> Generator[DesignEvent, None, SearchSlice[SearchState]]:
        """Yield every iterate of this part, and return the best result so far.

        Args:
            begun: What the parts before have found; None for the first one.
        """
        result = RunResult(name=self.order.start.name)
        status: Status | None = None
        best_of_stages: dict[float, Array] = {}
        steps = ShortSteps(self.method.tolerance)
        if begun is not None:
            result = begun.result
            best_of_stages = begun.state.best_of_stages
            steps = begun.state.short_steps

        # A simulation that diverges ends this search, not those of other initial controls.
        rows_before = len(result.history)
        try:
            for iterate in self._iterates(begun):
                status = iterate.status
                point = self._exact_point(iterate)
                result = self._updated(result, iterate, point)

                if np.isfinite(result.cost) and result.control is not None:
                    best_of_stages[iterate.mu] = result.control

                # The next iterate may take longer than anybody waits for after Ctrl-C.
                earlier = tuple(best_of_stages.values())[:-1]
                so_far = replace(result, status=Status.INTERRUPTED, earlier=earlier)
                offer_result(SearchSlice(result=so_far))
                if iterate.repaired:
                    continue

                row = self._row(iterate, point, result.steps)
                result = replace(result, history=extended(result.history, [row]))
                yield DesignEvent(start=result.name, row=row)

                # Later stages of the barrier bring a good iterate back inside the limits.
                has_short_steps = steps.hold_up(row.gamma, row.mu, row.slope)
                has_short_steps = has_short_steps and self.order.until_held_up
                may_end_here = iterate.feasible or row.cost > self.order.cost_to_beat
                is_held_up = has_short_steps and may_end_here

                # Steps may be short at an optimum, where nothing holds the search up.
                is_held_up = is_held_up and not (status is not None and status.success)
                is_held_up = is_held_up or self._is_too_slow(min(row.cost, result.cost))
                result = replace(result, is_held_up=is_held_up)
                if is_held_up or self.budget.stop.requested:
                    break

                # The next part goes on from here.
                is_over = self.length.is_over(len(result.history) - rows_before)
                if is_over and iterate.state is not None and status is None:
                    state = SearchState(
                        barrier=iterate.state, best_of_stages=best_of_stages, short_steps=steps
                    )
                    return unfinished(result, state)
        except (SimulationDivergedError, np.linalg.LinAlgError):
            status = Status.STALLED

        earlier = tuple(best_of_stages.values())[:-1]
        ended = replace(result, status=self._final_status(result, status), earlier=earlier)
        return SearchSlice(result=ended)

    def _iterates(self, begun: _Begun | None) -> Iterator[BarrierIterate]:
        """Iterates of the interior-point method, from the beginning or after those of a part."""
        if begun is not None:
            return self.method.resume(begun.state.barrier, self.budget)

        control = self.task.averaged(self.order.start.control)
        return self.method.run(control, self.budget)

    def _is_too_slow(self, cost: float) -> bool:
        """Check whether a search has not reached a cost that it should have reached by now.

        Args:
            cost: The lowest cost so far, or that of the present iterate, inside limits or not.
        """
        is_late = self.order.budget.used > PATIENCE_WITHOUT_PROGRESS
        return is_late and cost > self.order.cost_to_beat

    def _exact_point(self, iterate: BarrierIterate) -> DesignPoint | None:
        """Point of the iterate with the exact cost over all repetitions; None without a cost."""
        point = iterate.iterate.point.point
        if point is None:
            return None

        return self.exact.reevaluated(_repeat_measurement(point, self.order.start.repeats))

    def _updated(
        self, result: RunResult, iterate: BarrierIterate, point: DesignPoint | None
    ) -> RunResult:
        """Take an iterate into the result; its control where it is feasible and the best so far."""
        steps = self.task.plant.engine_steps - self.steps_before
        result = replace(result, slope=iterate.iterate.slope, steps=steps)

        cost = np.inf if point is None or not iterate.feasible else point.cost
        if cost > result.cost:
            return result

        control = _at_stated_rate(self.task, iterate.iterate.point.ctrl, self.curves)
        return replace(result, control=np.tile(control, (self.order.start.repeats, 1)), cost=cost)

    def _final_status(self, result: RunResult, status: Status | None) -> Status:
        """Status of the run, given that of the last iterate."""
        if self.budget.stop.requested:
            return status or Status.INTERRUPTED
        if not np.isfinite(result.cost):
            return Status.INFEASIBLE

        # The last iterate has no status where the budget was used up, or where the last stages
        # ended outside the limits.
        if status is None and self.budget.exhausted is None:
            return Status.BEST_SEEN
        return status or Status.MAX_ITERATIONS

    def _row(self, iterate: BarrierIterate, point: DesignPoint | None, steps: int) -> HistoryRow:
        """An iterate as a row of the history."""
        criterion = None if point is None else point.criterion
        values = values_of(iterate.iterate.point)
        margins = self.constraints.relative_margins(values)

        return HistoryRow(
            iteration=iterate.iterate.index,
            cost=np.inf if point is None else point.cost,
            criterion=np.inf if criterion is None else criterion.value,
            min_eigenvalue=0.0 if criterion is None else float(criterion.eigenvalues[0]),
            slope=iterate.iterate.slope,
            gamma=iterate.iterate.gamma,
            seconds=self.order.budget.seconds_used,
            steps=steps,
            rate=1.0 / self.task.dt,
            mu=iterate.mu,
            margin=min(margins.values(), default=np.nan),
            margins=margins,
            motion=IterateMotion.of(values.trajectory),
        )


def smoothed(task: DesignTask, combinations: Array | None) -> DesignProblem:
    """Make the cost that is minimised under hard limits.

    Args:
        task: The task.
        combinations: (t, s) identifiable combinations of the parameters, or None.

    Returns:
        The cost. The criterion of E-optimality is smoothed, and its gradient leaves out
        eigenvectors of negligible weight.
    """
    power = SMOOTH_POWER if task.experiment.cost.criterion == "E" else np.inf
    smooth = DescentLevel(task, combinations, power).problem
    information = replace(smooth.information, negligible_weight=MIN_EIGENVECTOR_WEIGHT)
    return replace(smooth, information=information)


def _repeat_measurement(point: DesignPoint, count: int) -> DesignPoint:
    """A point with the information of several repetitions of its trajectory."""
    if count == 1 or point.information is None:
        return point

    others = tuple(_repeat_measurement(other, count) for other in point.others)
    return replace(point, information=count * point.information, others=others)


def _at_stated_rate(task: DesignTask, ctrl: Array, curves: Array | None) -> Array:
    """Convert a control of a level to the stated sample rate.

    Args:
        task: The task on the level.
        ctrl: (N, nu) control on the level [u-unit].
        curves: (N * coarsening, M) curves of which the control is made at the stated rate, or None.

    Returns:
        (N * coarsening, nu) control [u-unit].
    """
    factor = task.system.variant.sample_factor
    if factor == 1 or curves is None:
        return np.repeat(ctrl, factor, axis=0)

    coefficients = np.linalg.lstsq(task.averaged(curves), ctrl - task.centre)[0]
    return np.asarray(task.centre + curves @ coefficients)
