"""One optimisation under hard limits from one initial control, as an order that any process can carry out."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierIterate, BarrierSchedule, InteriorPointMethod
from mjfim.excitation.interior_problem import values_of
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import regulator_for
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import RELAXED, ModelVariant
from mjfim.parallel import pool_stop_token
from mjfim.records.design import HistoryRow, Status
from mjfim.records.events import DesignEvent
from mjfim.signals import independent_curves

# Power of the smooth E-criterion. It is always smooth here: several of the smallest eigenvalues
# meet under hard limits.
SMOOTH_POWER = 40.0

# Growth of deviations from which on feedback is worth its time; steps are short under hard limits.
FEEDBACK_THRESHOLD = 100.0

# Weight of an eigenvector, over the largest weight, below which it is left out of the gradient.
MIN_EIGENVECTOR_WEIGHT = 3e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class ConstrainedSearch:
    """Order for one constrained optimisation from one initial control; picklable, so that a worker can run it.

    Attributes:
        experiment: The experiment.
        start: Initial control; need not be feasible.
        schedule: Weights mu of the barrier stages and when a stage ends.
        max_iterations: Iterations, at most.
        budget: Budget of the whole design; the time in the history counts from its beginning, and
            its token ends the search.
        seconds: Time that this search may take from its own beginning [s].
        combinations: (t, s) identifiable combinations of the parameters, or None where all are
            identifiable.
        added_information: (p, p) information of other experiments [1/theta^2], or None.
        variant: Plant on which the search runs; the result is evaluated on the stated plant later.
        threads: Threads for simulations; None for one per core.
        tightening: Share of half of each range that is held back, by kind of constraint.
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

    def run(self, task: DesignTask | None = None) -> Generator[DesignEvent, None, RunResult]:
        """Run the search.

        Args:
            task: The task on the search's plant, where it exists already.

        Yields:
            Every iterate.

        Returns:
            The best feasible control, or the last one where none is feasible.
        """
        task = self._task() if task is None else task
        if self.start.repeats > 1:
            task = task.with_horizon(task.horizon / self.start.repeats)

        return (yield from _Search.begin(self, task).run())

    def _task(self) -> DesignTask:
        """The task on the plant of the search."""
        return DesignTask.resolve(
            self.experiment,
            threads=self.threads,
            added_information=self.added_information,
            variant=self.variant,
        )


def run_in_worker(search: ConstrainedSearch) -> RunResult:
    """Run a search to its end, for an executor.

    Args:
        search: The order. A request to stop by its own token or by that of the worker's pool ends
            it.

    Returns:
        The best result so far.
    """
    own_stop, pool_stop = search.budget.stop, pool_stop_token()
    stop = StopToken(also=lambda: own_stop.requested or pool_stop.requested)

    search = replace(search, budget=search.budget.with_stop(stop))

    # Matrices are small: threads of the BLAS would only wait for each other.
    with threadpool_limits(1, user_api="blas"):
        return consume(search.run(), None)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Search:
    """A search whose task is resolved.

    Attributes:
        order: What was asked for.
        task: The task on the plant of the search, over one repetition.
        exact: The cost by which iterates are judged.
        curves: (N * coarsening, M) curves of which the control is made at the stated rate, or None
            where it is free.
        constraints: The limits, as far as they are tightened.
        method: Minimises the smooth cost within them.
        budget: Time and iterations of the search.
        steps_before: Engine steps when it began.
    """

    order: ConstrainedSearch
    task: DesignTask
    exact: DesignProblem
    curves: Array | None
    constraints: ConstraintSet
    method: InteriorPointMethod
    budget: Budget
    steps_before: int

    @classmethod
    def begin(cls, order: ConstrainedSearch, task: DesignTask) -> _Search:
        """Set up the interior-point method; the time counts from here."""
        budget = Budget(
            seconds=order.seconds,
            iterations=order.max_iterations,
            stop=order.budget.stop,
        )
        steps_before = task.plant.engine_steps

        # A start may have curves of its own, such as a Fourier series; else a limited bandwidth
        # asks for splines.
        curves = order.start.basis
        if curves is None:
            curves = bandwidth_basis(task, task.stated_times)
        basis = None if curves is None else independent_curves(task.averaged(curves))

        # Feedback would leave the span of the curves.
        threshold = FEEDBACK_THRESHOLD if basis is None else np.inf
        constraints = constraint_set_of(task).tightened(order.tightening)
        method = InteriorPointMethod(
            base=smoothed(task, order.combinations),
            constraints=constraints,
            centre=task.centre,
            basis=basis,
            regulator=replace(regulator_for(task), feedback_threshold=threshold),
            schedule=order.schedule,
        )
        return cls(
            order=order,
            task=task,
            exact=DescentLevel(task, order.combinations).problem,
            curves=curves,
            constraints=constraints,
            method=method,
            budget=budget,
            steps_before=steps_before,
        )

    def run(self) -> Generator[DesignEvent, None, RunResult]:
        """Yield every iterate and return the best result."""
        result = RunResult(name=self.order.start.name)
        status: Status | None = None
        control = self.task.averaged(self.order.start.control)

        # A simulation that diverges ends this run, not the others.
        try:
            for iterate in self.method.run(control, self.budget):
                status = iterate.status
                point = self._judge(iterate)
                result = self._updated(result, iterate, point)
                if iterate.repaired:
                    continue

                row = self._row(iterate, point, result.steps)
                result = replace(result, history=(*result.history, row))
                yield DesignEvent(start=result.name, row=row)

                if self.budget.stop.requested:
                    break
        except (SimulationDivergedError, np.linalg.LinAlgError):
            status = Status.STALLED

        return replace(result, status=self._final_status(result, status))

    def _judge(self, iterate: BarrierIterate) -> DesignPoint | None:
        """The iterate's point by the exact cost over all repetitions; None without a cost."""
        point = iterate.iterate.point.point
        if point is None:
            return None

        return self.exact.reevaluated(_repeat_measurement(point, self.order.start.repeats))

    def _updated(
        self, result: RunResult, iterate: BarrierIterate, point: DesignPoint | None
    ) -> RunResult:
        """The result with this iterate: its control is kept where it is at least as good as the best feasible one."""
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

        # The last iterate has no status where the time ended the run, or the schedule had no
        # further stage.
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
        )


def smoothed(task: DesignTask, combinations: Array | None) -> DesignProblem:
    """Make the cost that is minimised under hard limits.

    Args:
        task: The task.
        combinations: (t, s) identifiable combinations of the parameters, or None.

    Returns:
        The cost, smooth where it is that of E-optimality, without eigenvectors that hardly count.
    """
    power = SMOOTH_POWER if task.experiment.cost.criterion == "E" else np.inf
    smooth = DescentLevel(task, combinations, power).problem
    information = replace(smooth.information, negligible_weight=MIN_EIGENVECTOR_WEIGHT)
    return replace(smooth, information=information)


def _repeat_measurement(point: DesignPoint, count: int) -> DesignPoint:
    """A point whose trajectory is measured several times."""
    if count == 1 or point.information is None:
        return point

    others = tuple(_repeat_measurement(other, count) for other in point.others)
    return replace(point, information=count * point.information, others=others)


def _at_stated_rate(task: DesignTask, ctrl: Array, curves: Array | None) -> Array:
    """The control of a level at the stated sample rate.

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
