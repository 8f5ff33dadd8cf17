"""Search for the best control: without a barrier, within hard limits, or one after the other."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.constraints import constraint_set_of
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
    OutsideStart,
    keeps_limits,
)
from mjfim.excitation.evaluation import point_at_stated_rate
from mjfim.excitation.free_slices import has_a_start_for_each, run_free_starts
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel, coarse_level
from mjfim.excitation.limited_search import LimitedSearch
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.short_budget import enlarged
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import UnconstrainedSearch
from mjfim.excitation.verification import verify
from mjfim.information.smoothness import roughness
from mjfim.interruption import hurried
from mjfim.parallel import ExecutorLike, LostWorkError, Workers
from mjfim.plant.active_constraints import nothing_acts_along
from mjfim.records.design import Status

# Largest number of searches, stopped on a coarse level, that are compared at the stated rate.
EVALUATED_STOPPED = 4

# Number of the best searches under hard limits that are evaluated on the unmodified plant, where
# the costs of all of them are known from the plant without clamps.
EVALUATED_LIMITED = 8

# Time after a request to stop in which further ones are evaluated until one keeps all limits [s].
EVALUATED_SECONDS = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlSearch:
    """Search for the best control from several initial controls.

    Attributes:
        stage: The stated level.
        first: The experiment's initial control, evaluated.
        executor: Runs several starts side by side, or None.
        budget: Time of the search and the token that stops it.
        limited: Cost of controls that keep the hard limits; None without limits.
        outside: The initial control where it violates a limit; None where it keeps them.
        is_brief: Whether the time allows few evaluations only.
        evaluation_seconds: Time of the first evaluation [s].
    """

    stage: DescentLevel
    first: DesignPoint
    executor: ExecutorLike | None
    budget: Budget
    limited: LimitedCost | None = None
    outside: OutsideStart | None = None
    is_brief: bool = False
    evaluation_seconds: float = 0.0

    def run(self, starts: Iterable[InitialControl]) -> Runs:
        """Yield every iterate of all runs; return their results on the stated plant."""
        if self.limited is None:
            return (yield from self._run_without_barrier(starts))

        return (yield from self._run_within_limits(list(starts), self.limited))

    def _run_without_barrier(self, starts: Iterable[InitialControl]) -> Runs:
        """Descend from every start; under hard limits until one descent leaves them."""
        task, basis = self.stage.task, self.stage.basis
        coarse = coarse_level(task, self.first, basis)
        tasks = [task] if coarse is None else [coarse, task]

        levels = [DescentLevel(level, basis) for level in tasks]

        # Without a coarse level an iteration takes several evaluations, and a larger control often
        # costs less.
        if self.is_brief and coarse is None:
            starts = self._enlarged(list(starts))

        # Starts without limits are independent of each other.
        if self.executor is not None and not task.is_limited:
            starts = list(starts)
            if has_a_start_for_each(self.executor, starts):
                return (yield from run_free_starts(self.executor, levels, starts, self.budget))

        search = UnconstrainedSearch(
            levels=levels,
            budget=self.budget,
            constraints=constraint_set_of(task) if task.is_limited else None,
            steps_before=sum(level.plant.engine_steps for level in tasks),
        )
        return (yield from search.run_all(starts))

    def _enlarged(self, starts: list[InitialControl]) -> list[InitialControl]:
        """The starts, of which the initial control is enlarged if it keeps all limits."""
        start = starts[0]
        is_initial = start.control is self.stage.task.control
        if self.limited is None or self.outside is not None or not is_initial:
            return starts
        control = enlarged(self.limited, start.control, self.first.cost, self.budget)
        return [replace(start, control=control), *starts[1:]]

    def _run_within_limits(self, starts: list[InitialControl], limited: LimitedCost) -> Runs:
        """Optimise under hard limits.

        The search begins without a barrier where the weights of the cost may keep the limits.
        """
        results: list[RunResult] = []
        steps_without_barrier = 0

        is_bounded = _is_bounded_by_weights(self.stage.task)
        if is_bounded:
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
        inside = None if self.outside is None else self.outside.scaled
        if inside is not None and self._is_far_outside(starts[0].control, limited):
            inside = ControlsWithinLimits(cost=limited, budget=self.budget).best(inside)
            starts[0] = InitialControl(name=starts[0].name, control=inside.begin)

        search = LimitedSearch(
            limited=limited,
            is_rough=self._is_rough(starts[0].control),
            executor=self.executor,
            budget=self.budget,
            first=self.first,
            is_brief=self.is_brief and not is_bounded,
            evaluation_seconds=self.evaluation_seconds,
        )
        found = yield from search.run(starts, inside)
        results += self._not_worse(self._evaluated(found.results), found.inside)
        if results:
            steps = results[0].steps + steps_without_barrier
            results[0] = replace(results[0], steps=steps)
        return results

    def _is_rough(self, control: Array) -> bool:
        """Check whether derivatives may mislead along a control, if it is the initial one.

        Dry friction is enough, wherever the initial motion reverses.
        """
        task = self.stage.task
        if control is not task.control or self.first.trajectory is None:
            return False
        if self.limited is not None and self.limited.level.task.system.variant.smoothing_speeds:
            return True

        # The check takes as long as an evaluation of the cost.
        if self.is_brief and not _is_bounded_by_weights(task):
            return False

        # Derivatives exist where nothing touches, rubs, stops or clamps.
        model = task.system.model_at(task.theta)
        if nothing_acts_along(model, self.first.trajectory, task.system.grid.substeps):
            return False
        found = roughness(
            task.plant,
            task.system.noise,
            model,
            task.theta,
            self.first.trajectory,
            self.first.sensitivity,
        )
        return found is not None

    def _is_far_outside(self, control: Array, limited: LimitedCost) -> bool:
        """Check whether a control is far outside; that of the initial control is known."""
        if self.outside is not None and control is self.outside.control:
            return self.outside.is_far
        return limited.is_far_outside(limited.values(control))

    def _not_worse(self, found: list[RunResult], inside: InsideControl | None) -> list[RunResult]:
        """Results of which one is not worse than a control that keeps all limits.

        Args:
            found: Result of every start.
            inside: The control that keeps all limits; None where there is none.
        """
        if inside is None:
            return found
        if any(result.is_feasible and result.cost <= inside.cost for result in found):
            return found

        # A search that was stopped early may have no results.
        first = found[0] if found else RunResult(name="initial control", status=Status.INTERRUPTED)

        # Nothing better was found from the first start.
        status = first.status
        if status is Status.INFEASIBLE or status.success:
            status = Status.BEST_SEEN
        kept = replace(first, control=inside.control, cost=inside.cost, status=status)
        return [self._on_stated_plant(kept), *found[1:]]

    def _evaluated(self, results: Sequence[RunResult]) -> list[RunResult]:
        """Results of which the first and the best ones are evaluated on the unmodified plant.

        The costs of the others are those of the searches. After a request to stop, these may be
        costs on a coarse level, of controls that were not verified. Further ones are then evaluated
        until one keeps all limits, a time is over, or the user presses Ctrl-C a second time.
        """
        by_cost = sorted(range(len(results)), key=lambda index: results[index].cost)
        first, others = by_cost[:EVALUATED_LIMITED], by_cost[EVALUATED_LIMITED:]
        wanted = {0, *first} & set(by_cost)
        evaluated = {index: self._on_stated_plant(results[index]) for index in sorted(wanted)}

        is_stopped = self.budget.stop.requested
        end = time.monotonic() + EVALUATED_SECONDS
        for index in others if is_stopped else []:
            is_found = any(result.is_feasible for result in evaluated.values())
            if is_found or hurried() or time.monotonic() > end:
                break
            if index not in evaluated:
                evaluated[index] = self._on_stated_plant(results[index])

        return [
            evaluated[index]
            if index in evaluated
            else replace(result, is_feasible=bool(np.isfinite(result.cost)) and not is_stopped)
            for index, result in enumerate(results)
        ]

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Choice:
    """The best run of a design.

    Attributes:
        best: The best run.
        point: Point of the design.
        results: One result per run, of which the chosen one is evaluated on the stated plant.
    """

    best: RunResult
    point: DesignPoint
    results: tuple[RunResult, ...]


def choose(
    search: ControlSearch,
    begins: Sequence[DesignPoint],
    results: Sequence[RunResult],
    interrupted: bool,
) -> Choice:
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
        results = [RunResult(name="initial control", status=Status.INTERRUPTED)]

    known = _with_best_evaluated(search.stage, _with_evaluated_stops(search.stage, results))
    best = _best_of(known)
    if best.point is None and not interrupted:
        if all(result.status is Status.LOST for result in known):
            fault = "" if search.executor is None else Workers.of(search.executor).probable_fault
            raise LostWorkError(
                f"the worker of every start was lost several times, so there is no design: {fault}"
            )
        raise SimulationDivergedError("the simulation diverges from every start")

    # The beginning counts where it costs less than the best run, or where that breaks a limit.
    bound = best.cost if best.is_feasible else np.inf
    cheaper = [
        begin for begin in begins if begin.cost < bound and keeps_limits(search.limited, begin)
    ]
    point = begins[0] if best.point is None else best.point
    if cheaper:
        status = Status.BEST_SEEN if best.status is Status.INFEASIBLE else best.status
        best, point = replace(best, status=status), min(cheaper, key=lambda begin: begin.cost)
    return Choice(best=best, point=point, results=tuple(_comparable(known, best)))


def _comparable(results: Sequence[RunResult], best: RunResult) -> list[RunResult]:
    """Results whose costs can be compared with that of the best run.

    J of a control that violates a limit is infinite where the best run keeps all limits: it would
    look like a better result that was not chosen.

    Args:
        results: Result of every run.
        best: The best of them.
    """
    if not best.is_feasible:
        return list(results)
    return [
        result if result.is_feasible or result.point is None else replace(result, cost=np.inf)
        for result in results
    ]


def _best_of(results: Sequence[RunResult]) -> RunResult:
    """The feasible run of lowest cost; an infeasible one where none is feasible."""
    return min(results, key=lambda result: (not result.is_feasible, result.cost))


def _with_best_evaluated(stage: DescentLevel, results: Sequence[RunResult]) -> list[RunResult]:
    """Results of which the best one is evaluated on the stated plant, where its cost is known."""
    known = list(results)
    while True:
        best = _best_of(known)
        if best.point is not None or best.control is None or np.isinf(best.cost):
            return known
        known[known.index(best)] = _evaluated_at(stage, best)


def _with_evaluated_stops(stage: DescentLevel, results: Sequence[RunResult]) -> list[RunResult]:
    """Evaluate the best searches that were stopped on a coarse level, at the stated rate.

    On workers several searches may be stopped there. Each evaluation costs as much as an iterate,
    so that only those of lowest cost on their levels are compared.

    Args:
        stage: The stated level.
        results: One result per run.

    Returns:
        The results, some of which are evaluated.
    """

    def last_cost(index: int) -> float:
        """J of the last iterate on its level."""
        history = results[index].history
        return history[-1].cost if history else np.inf

    stopped = [
        index
        for index, result in enumerate(results)
        if result.point is None and result.control is not None and np.isinf(result.cost)
    ]
    compared = {
        index: _evaluated_at(stage, results[index])
        for index in sorted(stopped, key=last_cost)[:EVALUATED_STOPPED]
    }
    return [compared.get(index, result) for index, result in enumerate(results)]


def _evaluated_at(stage: DescentLevel, result: RunResult) -> RunResult:
    """A result with a control, evaluated on the stated plant."""
    assert result.control is not None
    point = point_at_stated_rate(stage, result.control)
    return replace(result, point=point, cost=np.inf if point is None else point.cost)


def _is_bounded_by_weights(task: DesignTask) -> bool:
    """Check whether weights on all controls may keep the limits without a barrier.

    A barrier is needed for a boundary, a bandwidth, limits on control rates and a clearance.
    """
    limits = task.experiment.limits
    needs_barrier = task.is_shaped or bool(limits.control_rate) or limits.clearance is not None
    return not needs_barrier and bool((task.control_weight > 0.0).all())
