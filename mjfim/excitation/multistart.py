"""Optimisation under hard limits from several initial controls, with successive halving.

All starts compete with a blunt barrier, on a plant that is quicker to simulate where there is one.
The best of them continue on the stated plant with a sharp barrier. A winner that violates a limit
on the unmodified model between the points that the barrier evaluates is optimised again within
tighter limits.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.constrained import ConstrainedSearch, run_in_worker
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.feasibility import shrink_until_feasible
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule, updated_tightening
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.verification import verify
from mjfim.parallel import results_in_order, workers_of
from mjfim.records.design import HistoryRow, Status
from mjfim.records.events import DesignEvent

# One in this many starts survives the first round.
HALVING_RATE = 4

# Barrier weight mu down to which many starts compete.
FIRST_ROUND_MU = 0.01

# The same for few starts on samples as stated, where the first round may go further.
FEW_STARTS_MU = 1e-3

# The second round begins with this many times the last mu of the first round.
MU_RESTART_FACTOR = 3.0

# Share of the iterations and of the time for the first round.
FIRST_ROUND_SHARE = 0.5

# Share of the time that is kept for runs within tighter limits.
RESERVED_SHARE = 0.05

# Number of times that a winner which violates a limit on the unmodified model is optimised again.
MAX_TIGHTENED_RUNS = 3

# First barrier weight mu of such a run.
TIGHTENED_RUN_MU = 1e-3

# Iterations of such a run, at most.
TIGHTENED_RUN_ITERATIONS = 60

# What a search of several runs yields and returns.
Runs = Generator[DesignEvent, None, list[RunResult]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Multistart:
    """Successive halving of several starts under hard limits.

    Attributes:
        fine: The experiment on the plant without clamps.
        coarse: The same on a plant that is quicker to simulate, or smoother; None without one.
        executor: Runs the starts side by side; None: one after the other in this process.
        budget: Time of the whole design, and the token that stops it.
    """

    fine: DescentLevel
    coarse: DescentLevel | None
    executor: Executor | None = None
    budget: Budget

    def run(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise from all starts in two rounds.

        Args:
            starts: The initial controls.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun; those of the survivors include the second round.
        """
        max_iterations = self.fine.task.experiment.descent.max_iterations

        # A single start without a coarse level or a basis of its own needs no competition.
        if self._needs_one_round(starts):
            return (
                yield from self._round(
                    self.fine,
                    starts,
                    BarrierSchedule(),
                    max_iterations,
                    self.budget.seconds_left - self._reserved_seconds,
                )
            )

        # First round: all starts, down to a blunt barrier.
        is_short = len(starts) < HALVING_RATE and self._differs_by_timestep_only
        last_mu = FEW_STARTS_MU if is_short else FIRST_ROUND_MU
        results = yield from self._round(
            self.coarse or self.fine,
            starts,
            BarrierSchedule(last=last_mu),
            round(FIRST_ROUND_SHARE * max_iterations),
            FIRST_ROUND_SHARE * self.budget.seconds_left / self._turns(len(starts)),
        )
        if self.budget.stop.requested:
            return results

        # The survivors are chosen by their cost on the stated plant.
        results, candidates = self._judge_all(results, starts)
        survivors = self._choose_survivors(candidates)
        if not survivors:
            return results
        results = _discard_others(results, candidates, survivors)

        # Second round: the survivors on the stated plant, down to a sharp barrier.
        done = max((row.iteration for i in survivors for row in results[i].history), default=0)
        seconds_left = max(self.budget.seconds_left - self._reserved_seconds, 0.0)
        second = yield from _renumber(
            self._round(
                self.fine,
                [_continued(candidates[i]) for i in survivors],
                BarrierSchedule(first=min(MU_RESTART_FACTOR * last_mu, FIRST_ROUND_MU)),
                max_iterations - done,
                seconds_left / self._turns(len(survivors)),
            ),
            done + 1,
        )
        return _merge_rounds(results, second)

    def tighten_winner(self, results: Sequence[RunResult]) -> Runs:
        """Optimise a winner again within tighter limits while it violates a limit on the unmodified model.

        The barrier evaluates distances at the samples and other quantities at some engine steps;
        between them a limit may be violated. Where tighter limits do not help, the control is
        shrunk.

        Args:
            results: Result of every start.

        Yields:
            Every iterate.

        Returns:
            The results, the winner's replaced.
        """
        results = list(results)
        tightening = dict[str, float]()

        for _ in range(MAX_TIGHTENED_RUNS):
            violated = self._violated_by_winner(results)
            if violated is None:
                return results
            if self.budget.exhausted is not None:
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
                    results[winner] = _append_run(results[winner], result)

        # As a last resort the control is shrunk.
        violated = self._violated_by_winner(results)
        if violated is not None:
            winner, _ = violated
            results[winner] = self._shrink(results[winner])

        return results

    # ---- properties of the task

    @cached_property
    def _constraints(self) -> ConstraintSet:
        """The limits on the plant without clamps."""
        return constraint_set_of(self.fine.task)

    @property
    def _reserved_seconds(self) -> float:
        """Time that is kept for runs within tighter limits [s]; 0 without a limit of the time."""
        return RESERVED_SHARE * (self.fine.task.experiment.descent.seconds or 0.0)

    @property
    def _differs_by_timestep_only(self) -> bool:
        """Whether the minima on the coarse level are nearly those of the stated one."""
        if self.coarse is None:
            return True

        variant = self.coarse.task.system.variant
        return replace(variant, timestep_factor=1) == self.fine.task.system.variant

    def _needs_one_round(self, starts: Sequence[InitialControl]) -> bool:
        """Whether there is a single start that is free to take any shape on the stated level."""
        if len(starts) > 1 or self.coarse is not None:
            return False

        return all(start.basis is None and start.repeats == 1 for start in starts)

    def _turns(self, count: int) -> int:
        """Number of tasks that each worker runs one after the other."""
        return -(-max(count, 1) // workers_of(self.executor))

    # ---- choice of the survivors

    def _judge_all(
        self, results: Sequence[RunResult], starts: Sequence[InitialControl]
    ) -> tuple[list[RunResult], list[RunResult]]:
        """Results with their cost on the stated plant, and the candidates of the second round."""
        repeats = any(start.repeats > 1 for start in starts)
        if self.coarse is None and not repeats:
            return list(results), list(results)

        by_name = {start.name: start for start in starts}
        judged = [self.judge(result, by_name[result.name]) for result in results]
        return [result for result, _ in judged], [candidate for _, candidate in judged]

    def judge(self, result: RunResult, start: InitialControl) -> tuple[RunResult, RunResult]:
        """Replace the cost on a coarse level by that on the stated plant.

        Args:
            result: Result of the first round.
            start: Its initial control.

        Returns:
            The result with the better of the found and the initial control, by their costs on the
            stated plant, and the candidate with which the second round would continue: the same, or
            a found control that violates a limit here, with its cost on the coarse level, because
            the second round makes it feasible again.
        """
        found = [control for control in (result.control, start.over_horizon) if control is not None]
        costs = [self._cost_on_stated_plant(control) for control in found]

        best = int(np.argmin(costs))
        judged = replace(result, cost=costs[best])
        if np.isfinite(judged.cost):
            judged = replace(judged, control=found[best])

        violates = result.control is not None and np.isinf(costs[0])
        return judged, result if violates else judged

    def _cost_on_stated_plant(self, control: Array) -> float:
        """J of a control: (N, nu); infinite where it violates a limit, also where only a clamp keeps a force within one."""
        task = self.fine.task
        observed = task.plant.observe(task.theta, control, self._constraints.observations)
        if observed is None:
            return np.inf

        values = self._constraints.evaluate(*observed, slopes=False)
        if not self._constraints.is_feasible(values):
            return np.inf
        if not verify(task, values.trajectory).is_feasible:
            return np.inf

        return self.fine.problem.point(values.trajectory).cost

    def _choose_survivors(self, candidates: Sequence[RunResult]) -> list[int]:
        """Indices of the best candidates, at least one where there is any; the best one comes first."""
        usable = [i for i, candidate in enumerate(candidates) if candidate.control is not None]
        best_first = sorted(usable, key=lambda i: candidates[i].cost)

        count = max(1, len(candidates) // HALVING_RATE)
        return best_first[:count]

    # ---- the winner on the unmodified model

    def _violated_by_winner(
        self, results: Sequence[RunResult]
    ) -> tuple[int, dict[str, float]] | None:
        """Index of the winner and its relative margins, where it violates a limit on the unmodified model; else None."""
        if not results or self.budget.stop.requested:
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

    def _shrink(self, result: RunResult) -> RunResult:
        """Shrink the control of a result until no limit is violated, if that is possible."""

        def repair(control: Array) -> RunResult | None:
            """The result with this control, where it is feasible."""
            cost = self._cost_on_stated_plant(control)
            return replace(result, control=control, cost=cost) if np.isfinite(cost) else None

        control = np.asarray(result.control)
        return shrink_until_feasible(control, self.fine.task.centre, repair) or result

    # ---- one round

    def _round(
        self,
        stage: DescentLevel,
        starts: Sequence[InitialControl],
        schedule: BarrierSchedule,
        max_iterations: int,
        seconds: float,
        tightening: Mapping[str, float] | None = None,
    ) -> Runs:
        """Run one search per start, each with the given iterations and seconds."""
        task = stage.task
        tolerance = max(schedule.tolerance, task.experiment.descent.tolerance)

        # Workers share the threads; without an executor a search may use all of them.
        threads = task.system.threads
        if self.executor is not None:
            threads = max(workers_of(self.executor) // len(starts), 1)

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
            )
            for start in starts
        ]
        if self.executor is None:
            return (yield from self._run_here(searches, stage))
        return (yield from self._run_in_workers(searches, self.executor))

    def _run_here(self, searches: Sequence[ConstrainedSearch], stage: DescentLevel) -> Runs:
        """Run searches one after the other while the budget lasts; the first one always begins."""
        results: list[RunResult] = []
        for search in searches:
            if results and self.budget.exhausted is not None:
                break

            result = yield from search.run(stage.task)
            results.append(result)

        return results

    def _run_in_workers(self, searches: Sequence[ConstrainedSearch], executor: Executor) -> Runs:
        """Run searches side by side; the iterates of each are reported when it has ended."""
        futures = [executor.submit(run_in_worker, search) for search in searches]
        results: list[RunResult] = []

        for result in results_in_order(executor, futures, self.budget):
            results.append(result)

            for row in result.history:
                if self.budget.stop.requested:
                    break
                yield DesignEvent(start=result.name, row=row)

        return results


def _continued(result: RunResult) -> InitialControl:
    """The control of a result as an initial control."""
    return InitialControl(name=result.name, control=np.asarray(result.control))


def _renumber(events: Runs, offset: int) -> Runs:
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
    """Results of both rounds; the second one replaces a control only where it is at least as good."""
    by_name = {result.name: result for result in second}
    merged = [
        _merge(result, by_name[result.name]) if result.name in by_name else result
        for result in first
    ]

    # A discarded start may be the best after all, and so may one whose second run found nothing
    # feasible.
    best = min(range(len(merged)), key=lambda i: merged[i].cost)
    if np.isfinite(merged[best].cost) and merged[best].status in (Status.LEFT, Status.INFEASIBLE):
        merged[best] = replace(merged[best], status=Status.MAX_ITERATIONS)

    return merged


def _merge(first: RunResult, second: RunResult) -> RunResult:
    """Result of a start after both rounds."""
    merged = replace(
        first,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
        status=second.status,
        slope=second.slope,
    )
    if second.control is not None and second.cost <= first.cost:
        merged = replace(merged, control=second.control, cost=second.cost)

    # The control of the first round still counts where the second one found nothing feasible.
    if np.isfinite(merged.cost) and second.status is Status.INFEASIBLE:
        merged = replace(merged, status=Status.MAX_ITERATIONS)

    return merged


def _append_run(first: RunResult, second: RunResult) -> RunResult:
    """The second result, with the history and the steps of both."""
    return replace(
        second,
        history=_join(first.history, second.history),
        steps=first.steps + second.steps,
    )


def _join(first: tuple[HistoryRow, ...], second: tuple[HistoryRow, ...]) -> tuple[HistoryRow, ...]:
    """One history of two runs; iterates and engine steps are counted on."""
    if not first:
        return second

    end = first[-1]
    continued = [
        replace(row, iteration=row.iteration + end.iteration + 1, steps=row.steps + end.steps)
        for row in second
    ]
    return (*first, *continued)
