"""Optimisation under hard limits from several initial controls, with successive halving.

In the first round all starts are optimised with a large barrier weight, if possible on a plant that
is quicker to simulate. The best of them continue on the stated plant with a small barrier weight.
The best result may violate a limit of the unmodified model between the times at which the barrier
is evaluated; then it is optimised again within tighter limits.
"""

from __future__ import annotations

import uuid
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.constrained import (
    ConstrainedSearch,
    ConstrainedSlice,
    run_in_worker,
)
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.feasibility import reduced_actuators, shrink_about_each
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule, updated_tightening
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.sliced_searches import run_in_slices
from mjfim.excitation.verification import verify
from mjfim.experiment.packing import for_workers
from mjfim.parallel import Workers
from mjfim.records.design import HistoryRow, Status, extended
from mjfim.records.events import DesignEvent

# The first round keeps one in this number of starts.
HALVING_RATE = 4

# Last barrier weight mu of the first round.
FIRST_ROUND_MU = 0.01

# Last barrier weight mu of the first round with fewer than `HALVING_RATE` starts, where the coarse
# level differs by its timestep only: its minima are then close to those of the stated level.
FEW_STARTS_MU = 1e-3

# Ratio of the first mu of the second round to the last mu of the first round.
MU_RESTART_FACTOR = 3.0

# Share of the iterations and of the time for the first round.
FIRST_ROUND_SHARE = 0.5

# Share of the time that is reserved for runs within tighter limits.
RESERVED_SHARE = 0.05

# Time after a request to stop in which a result may still be moved inside the limits [s].
SECONDS_AFTER_STOP = 2.0

# Largest number of runs within tighter limits.
MAX_TIGHTENED_RUNS = 3

# First barrier weight mu of a run within tighter limits.
TIGHTENED_RUN_MU = 1e-3

# Largest number of iterations of a run within tighter limits.
TIGHTENED_RUN_ITERATIONS = 60

# Least number of iterations of the run that follows where no start found a feasible motion; it is
# never larger than that of the experiment.
RESCUE_ITERATIONS = 60


class _Feasible(NamedTuple):
    """A control with its cost on the unmodified model.

    Attributes:
        cost: J; infinite where the control violates a limit.
        control: (N, nu) control [u-unit].
    """

    cost: float
    control: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Multistart:
    """Successive halving of several starts under hard limits.

    Attributes:
        fine: The stated level, on the plant without clamps.
        coarse: A level that is quicker to simulate, or smoother; None without one.
        executor: Runs the starts side by side; None to run them one by one in this process.
        budget: Time of the whole design, and the token that stops it.
        until_held_up: End searches whose steps become very short.
        cost_to_beat: Cost that random controls have reached, see `ConstrainedSearch`.
        iterations_done: Iterations of the design before.
    """

    fine: DescentLevel
    coarse: DescentLevel | None
    executor: Executor | None = None
    budget: Budget
    until_held_up: bool = False
    cost_to_beat: float = np.inf
    iterations_done: int = 0

    def run(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise from all starts in two rounds.

        Args:
            starts: The initial controls.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun; those of the survivors include the second round.
        """
        if self._needs_one_round(starts):
            return (yield from self._run_single_round(starts))

        few_starts = len(starts) < HALVING_RATE and self._differs_by_timestep_only
        last_mu = FEW_STARTS_MU if few_starts else FIRST_ROUND_MU
        results = yield from self._run_first_round(starts, last_mu)
        if self.budget.stop.requested:
            return results

        # The survivors are chosen by their cost on the stated plant.
        results, candidates = self._compare_on_stated_plant(results, starts)
        survivors = self._choose_survivors(candidates)
        if not survivors or self._are_beaten([candidates[i] for i in survivors]):
            return results

        results = _discard_others(results, candidates, survivors)
        done = max((row.iteration for i in survivors for row in results[i].history), default=0)
        second = yield from self._run_second_round(
            [_continued(candidates[i]) for i in survivors],
            first_mu=min(MU_RESTART_FACTOR * last_mu, FIRST_ROUND_MU),
            done=done,
        )
        return _merge_rounds(results, second)

    def tighten_winner(self, results: Sequence[RunResult]) -> Runs:
        """Optimise the best result again while it violates a limit on the unmodified model.

        The barrier evaluates distances at the samples and other quantities at some engine steps;
        between them a limit may be violated. So the result is optimised again within tighter
        limits. Where that does not help, its control is shrunk.

        Args:
            results: Result of every start.

        Yields:
            Every iterate.

        Returns:
            The results, of which the best one is replaced.
        """
        results = list(results)
        tightening = dict[str, float]()

        for _ in range(MAX_TIGHTENED_RUNS):
            violated = self._violated_by_winner(results)
            if violated is None or self.budget.exhausted is not None:
                break

            winner, margins = violated
            tightening = updated_tightening(tightening, margins)
            repeated = yield from self._round(
                self.fine,
                [_continued(results[winner])],
                BarrierSchedule(first=TIGHTENED_RUN_MU),
                TIGHTENED_RUN_ITERATIONS,
                self.budget.seconds_left,
                tightening,
            )
            for result in repeated:
                if np.isfinite(result.cost):
                    results[winner] = append_run(results[winner], result)

        results = self._repaired(results)
        if any(np.isfinite(result.cost) for result in results) or self.budget.stop.requested:
            return results

        # No start found anything feasible.
        return (yield from self._rescued(results))

    def _repaired(self, results: Sequence[RunResult]) -> list[RunResult]:
        """Make sure that the best result keeps all limits of the unmodified model.

        A winner that violates a limit is replaced by the best feasible control that its start has
        seen, or counts as infeasible; then the next best result has to be feasible. After a request
        to stop this ends with the waiting time.
        """
        results = list(results)
        waiting = Budget(seconds=SECONDS_AFTER_STOP)
        while not (self.budget.stop.requested and waiting.exhausted):
            violated = self._violated_by_winner(results)
            if violated is None:
                return results

            winner, _ = violated
            results[winner] = self._best_feasible(results[winner], waiting)
        return results

    def _best_feasible(self, result: RunResult, waiting: Budget) -> RunResult:
        """A result with its best feasible control: a shrunk one, or that of an earlier stage."""
        control = np.asarray(result.control)
        found = [self._shrink(control)]
        found += [_Feasible(self._cost_on_stated_plant(c), c) for c in result.earlier]

        # No run within tighter limits may follow a request to stop.
        if self.budget.stop.requested:
            found += self._with_reduced_actuators(control, waiting)

        best = min(found, key=lambda feasible: feasible.cost)
        if not np.isfinite(best.cost):
            return replace(result, cost=np.inf, status=Status.INFEASIBLE)
        return replace(result, control=best.control, cost=best.cost, status=Status.BEST_SEEN)

    def _with_reduced_actuators(self, control: Array, waiting: Budget) -> Iterator[_Feasible]:
        """Feasible controls in which one actuator deviates less, while there is time to wait."""
        for candidates in reduced_actuators(control, self.fine.task.centre):
            for candidate in candidates:
                if waiting.exhausted is not None:
                    return
                cost = self._cost_on_stated_plant(candidate)
                if np.isfinite(cost):
                    yield _Feasible(cost, candidate)
                    break

    # ---- the search for a feasible motion

    def _rescued(self, results: Sequence[RunResult]) -> Runs:
        """Search for a feasible motion where no start found one, and optimise from there.

        Each control is shrunk about the controls that hold the start, even when the time is used
        up. Where that does not help, these are steered inside the limits.
        """
        results = list(results)
        for i, result in enumerate(results):
            # With several starts this may take long.
            if i and self.budget.exhausted is not None:
                break
            results[i] = self._rescued_by_shrinking(result)

        best = min(range(len(results)), key=lambda i: results[i].cost, default=None)
        if best is None:
            return results

        begins = self._steered_begins(results)
        if np.isfinite(results[best].cost):
            begins = [np.asarray(results[best].control)]
        for control in begins:
            if self.budget.exhausted is not None:
                break

            found = yield from self._continue_inside(results[best], control)
            if found.cost < results[best].cost:
                results[best] = found
            if np.isfinite(results[best].cost):
                break

        return results

    def _rescued_by_shrinking(self, result: RunResult) -> RunResult:
        """A result with the feasible control to which its own one can be shrunk, if there is one.

        The initial control is shrunk as well, since its motion may be inside where that of the
        result is not.
        """
        if result.control is None:
            return result

        found = (self._shrink(result.control), self._shrunk_initial)
        best = min(found, key=lambda feasible: feasible.cost)
        if not np.isfinite(best.cost):
            return result
        begun = replace(result, control=best.control, cost=best.cost)
        return replace(begun, status=Status.MAX_ITERATIONS)

    @cached_property
    def _shrunk_initial(self) -> _Feasible:
        """The initial control, shrunk inside the limits."""
        return self._shrink(self.fine.task.control)

    def _steered_begins(self, results: Sequence[RunResult]) -> list[Array]:
        """Controls, (N, nu) each, from which the limits may be reached without the cost."""
        task = self.fine.task
        begins = [np.tile(centre, (task.samples, 1)) for centre in reversed(task.centres)]
        for result in results:
            if result.control is not None:
                return [*begins, np.array(result.control)]
        return begins

    def _continue_inside(
        self, result: RunResult, control: Array
    ) -> Generator[DesignEvent, None, RunResult]:
        """Optimise from a control, which is first steered inside the limits.

        Args:
            result: Result that is continued.
            control: (N, nu) control with which to begin [u-unit].

        Returns:
            The result with the history and the engine steps of both. It is feasible on the
            unmodified model where its cost is finite.
        """
        done = result.history[-1].iteration if result.history else 0
        iterations = max(self._max_iterations - done, RESCUE_ITERATIONS)
        runs = yield from self._round(
            self.fine,
            [InitialControl(name=result.name, control=control)],
            BarrierSchedule(),
            min(iterations, self._max_iterations),
            self.budget.seconds_left,
            inside_first=True,
        )
        for run in self._repaired(runs):
            return append_run(result, run)
        return result

    # ---- properties of the task

    @cached_property
    def _limited_cost(self) -> LimitedCost:
        """Cost of controls that keep all limits on the stated plant."""
        return LimitedCost(level=self.fine)

    @property
    def _reserved_seconds(self) -> float:
        """Time that is reserved for runs within tighter limits [s]; 0 without a limit of time."""
        return RESERVED_SHARE * (self.fine.task.experiment.descent.seconds or 0.0)

    @property
    def _differs_by_timestep_only(self) -> bool:
        """True where the coarse level has a longer timestep, but the stated samples and friction.

        Its minima are then close to those of the stated level.
        """
        if self.coarse is None:
            return True

        variant = self.coarse.task.system.variant
        return replace(variant, timestep_factor=1) == self.fine.task.system.variant

    def _needs_one_round(self, starts: Sequence[InitialControl]) -> bool:
        """Check whether there is one start only, whose control is free, and one level."""
        if len(starts) > 1 or self.coarse is not None:
            return False

        return all(start.basis is None and start.repeats == 1 for start in starts)

    def _turns(self, count: int) -> int:
        """Number of runs that each worker does one after the other, of `count` runs."""
        workers = 1 if self.executor is None else Workers.of(self.executor).count
        return -(-max(count, 1) // workers)

    # ---- choice of the survivors

    def _compare_on_stated_plant(
        self, results: Sequence[RunResult], starts: Sequence[InitialControl]
    ) -> tuple[list[RunResult], list[RunResult]]:
        """Results with their cost on the stated plant, and the candidates of the second round."""
        repeats = any(start.repeats > 1 for start in starts)
        if self.coarse is None and not repeats:
            return list(results), list(results)

        by_name = {start.name: start for start in starts}
        pairs = [self.reevaluate(result, by_name[result.name]) for result in results]
        return [result for result, _ in pairs], [candidate for _, candidate in pairs]

    def reevaluate(self, result: RunResult, start: InitialControl) -> tuple[RunResult, RunResult]:
        """Replace the cost on a coarse level by that on the stated plant.

        Args:
            result: Result of the first round.
            start: Its initial control.

        Returns:
            The result with the better of the found and the initial control, by their costs on the
            stated plant, and the candidate with which the second round would continue. The
            candidate differs from the result where the found control violates a limit on the
            stated plant: it is then the found control with its cost on the coarse level, because
            the second round makes it feasible again.
        """
        found = [control for control in (result.control, start.over_horizon) if control is not None]
        costs = [self._cost_on_stated_plant(control) for control in found]

        best = int(np.argmin(costs))
        reevaluated = replace(result, cost=costs[best])
        if np.isfinite(reevaluated.cost):
            reevaluated = replace(reevaluated, control=found[best])

        violates = result.control is not None and np.isinf(costs[0])
        candidate = result if violates else reevaluated
        return reevaluated, candidate

    def _cost_on_stated_plant(self, control: Array) -> float:
        """J of a control: (N, nu); infinite where it violates a limit on the stated plant."""
        return self._limited_cost(control)

    def _are_beaten(self, candidates: Sequence[RunResult]) -> bool:
        """Check whether all candidates are held up where random controls cost less."""
        return all(each.is_held_up and each.cost > self.cost_to_beat for each in candidates)

    def _choose_survivors(self, candidates: Sequence[RunResult]) -> list[int]:
        """Indices of the candidates for the second round, the best one first."""
        usable = [i for i, candidate in enumerate(candidates) if candidate.control is not None]
        best_first = sorted(usable, key=lambda i: candidates[i].cost)

        count = max(1, len(candidates) // HALVING_RATE)
        return best_first[:count]

    # ---- the winner on the unmodified model

    def _violated_by_winner(
        self, results: Sequence[RunResult]
    ) -> tuple[int, dict[str, float]] | None:
        """Find out whether the best result violates a limit on the unmodified model.

        Returns:
            Index of the best result and its relative margins; None where it keeps all limits.
        """
        if not results:
            return None

        winner = min(range(len(results)), key=lambda i: results[i].cost)
        control = results[winner].control
        if control is None or not np.isfinite(results[winner].cost):
            return None

        task = self.fine.task
        found = verify(task, task.plant.simulate(task.theta, control))
        if found.is_feasible or not np.isfinite(found.deviation):
            return None

        return winner, found.relative_margins

    def _shrink(self, control: Array) -> _Feasible:
        """Shrink a control about each centre until no limit is violated; the best one counts."""

        def feasible(candidate: Array) -> _Feasible | None:
            """The control with its cost; None where it violates a limit."""
            cost = self._cost_on_stated_plant(candidate)
            return _Feasible(cost, candidate) if np.isfinite(cost) else None

        found = shrink_about_each(control, self.fine.task.centres, feasible)
        outside = _Feasible(np.inf, control)
        return min(found, key=lambda candidate: candidate.cost, default=outside)

    # ---- the rounds

    @property
    def _max_iterations(self) -> int:
        """Largest number of iterations of one start over all rounds."""
        return max(self.fine.task.experiment.descent.max_iterations - self.iterations_done, 1)

    def _run_single_round(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise on the stated plant with all barrier weights."""
        return (
            yield from self._round(
                self.fine,
                starts,
                BarrierSchedule(),
                self._max_iterations,
                self.budget.seconds_left - self._reserved_seconds,
            )
        )

    def _run_first_round(self, starts: Sequence[InitialControl], last_mu: float) -> Runs:
        """Optimise all starts down to barrier weight `last_mu`, if possible on a coarse level."""
        seconds = FIRST_ROUND_SHARE * self.budget.seconds_left
        return (
            yield from self._round(
                self.coarse or self.fine,
                starts,
                BarrierSchedule(last=last_mu),
                round(FIRST_ROUND_SHARE * self._max_iterations),
                seconds / self._turns(len(starts)),
            )
        )

    def _run_second_round(
        self, starts: Sequence[InitialControl], *, first_mu: float, done: int
    ) -> Runs:
        """Continue the survivors on the stated plant, after `done` iterations."""
        seconds = max(self.budget.seconds_left - self._reserved_seconds, 0.0)
        events = self._round(
            self.fine,
            starts,
            BarrierSchedule(first=first_mu),
            self._max_iterations - done,
            seconds / self._turns(len(starts)),
        )
        return (yield from renumber(events, done + 1))

    def _round(
        self,
        stage: DescentLevel,
        starts: Sequence[InitialControl],
        schedule: BarrierSchedule,
        max_iterations: int,
        seconds: float,
        tightening: Mapping[str, float] | None = None,
        *,
        inside_first: bool = False,
    ) -> Runs:
        """Run one search per start, each with the given iterations and seconds."""
        task = stage.task
        tolerance = max(schedule.tolerance, task.experiment.descent.tolerance)

        # Workers share the threads; without an executor a search uses all of them.
        threads = task.system.threads
        if self.executor is not None:
            threads = Workers.of(self.executor).threads_for(len(starts))

        searches = [
            ConstrainedSearch(
                experiment=task.experiment,
                start=start,
                schedule=replace(schedule, tolerance=tolerance),
                max_iterations=max(max_iterations, 1),
                budget=self.budget,
                seconds=seconds,
                combinations=stage.basis,
                added_information=task.added_information,
                variant=task.system.variant,
                threads=threads,
                tightening=tightening or {},
                inside_first=inside_first,
                until_held_up=self.until_held_up,
                cost_to_beat=self.cost_to_beat,
            )
            for start in starts
        ]
        if self.executor is None:
            return (yield from self._run_here(searches, stage))

        # A worker needs no file of the caller, and resolves the task of all these searches once.
        packed = for_workers(task.experiment, task.system.source)
        key = uuid.uuid4().hex
        orders = [
            ConstrainedSlice(search=replace(search, experiment=packed), task_key=key)
            for search in searches
        ]
        return (yield from run_in_slices(self.executor, orders, run_in_worker, self.budget))

    def _run_here(self, searches: Sequence[ConstrainedSearch], stage: DescentLevel) -> Runs:
        """Run searches one after the other while the budget lasts; the first one always begins."""
        results: list[RunResult] = []
        for search in searches:
            if results and self.budget.exhausted is not None:
                break

            result = yield from search.run(stage.task)
            results.append(result)

        return results


def _continued(result: RunResult) -> InitialControl:
    """The control of a result as an initial control."""
    return InitialControl(name=result.name, control=np.asarray(result.control))


def renumber(events: Runs, offset: int) -> Runs:
    """Add an offset to the numbers of the iterates."""
    while True:
        try:
            event = next(events)
        except StopIteration as end:
            results: list[RunResult] = end.value
            return results

        row = replace(event.row, iteration=event.row.iteration + offset)
        yield replace(event, row=row)


def _discard_others(
    results: Sequence[RunResult], candidates: Sequence[RunResult], survivors: Sequence[int]
) -> list[RunResult]:
    """Mark feasible results that do not survive the first round."""
    marked = list(results)
    for i, candidate in enumerate(candidates):
        is_usable = candidate.control is not None and np.isfinite(candidate.cost)
        if i not in survivors and is_usable:
            marked[i] = replace(marked[i], status=Status.LEFT)

    return marked


def _merge_rounds(first: Sequence[RunResult], second: Sequence[RunResult]) -> list[RunResult]:
    """Results of both rounds; every start keeps its control of lower cost."""
    by_name = {result.name: result for result in second}
    merged = [
        _merge(result, by_name[result.name]) if result.name in by_name else result
        for result in first
    ]

    return without_discarded_winner(merged)


def without_discarded_winner(results: Sequence[RunResult]) -> list[RunResult]:
    """Results of all rounds, of which the best one does not count as discarded or infeasible.

    A discarded start may be the best after all, and so may one whose later run found nothing
    feasible.

    Args:
        results: Result of every start.
    """
    results = list(results)
    best = min(range(len(results)), key=lambda i: results[i].cost, default=None)
    if best is None or not np.isfinite(results[best].cost):
        return results

    if results[best].status in (Status.LEFT, Status.INFEASIBLE):
        results[best] = replace(results[best], status=Status.MAX_ITERATIONS)
    return results


def _merge(first: RunResult, second: RunResult) -> RunResult:
    """Result of a start after both rounds."""
    merged = replace(
        first,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
        status=second.status,
        slope=second.slope,
        is_held_up=second.is_held_up,
    )
    merged = replace(merged, earlier=(*first.earlier, *second.earlier))
    if second.control is not None and second.cost <= first.cost:
        merged = replace(merged, control=second.control, cost=second.cost)
    elif second.status.success:
        merged = replace(merged, status=Status.BEST_SEEN)

    # The control of the first round still counts where the second one found nothing feasible.
    if np.isfinite(merged.cost) and second.status is Status.INFEASIBLE:
        merged = replace(merged, status=Status.MAX_ITERATIONS)

    return merged


def append_run(first: RunResult, second: RunResult) -> RunResult:
    """The second result, with the history and the engine steps of both."""
    return replace(
        second,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
    )


def _join(first: tuple[HistoryRow, ...], second: tuple[HistoryRow, ...]) -> tuple[HistoryRow, ...]:
    """Join the histories of two runs; iterates and engine steps of the second one are added."""
    if not first:
        return second

    end = first[-1]
    continued = [
        replace(row, iteration=row.iteration + end.iteration + 1, steps=row.steps + end.steps)
        for row in second
    ]
    return extended(first, continued)
