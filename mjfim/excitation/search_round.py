"""One round of a design under hard limits: a search from each of several starts, on one level."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.budget import Budget
from mjfim.excitation.constrained import ConstrainedSearch, ConstrainedSlice, run_in_worker
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.sliced_searches import run_in_slices
from mjfim.experiment.packing import for_workers
from mjfim.parallel import ExecutorLike, Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundTerms:
    """What the searches of a round have in common.

    Attributes:
        schedule: Stages of the barrier.
        max_iterations: Largest number of iterations of each search.
        seconds: Time of each search [s].
        tightening: Distance by which limits are moved inwards, by kind.
        inside_first: Whether controls are steered inside the limits before the cost is minimised.
    """

    schedule: BarrierSchedule
    max_iterations: int
    seconds: float
    tightening: Mapping[str, float] = field(default_factory=dict)
    inside_first: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchRounds:
    """Runs the searches of a round one by one, or side by side on workers.

    Attributes:
        executor: Runs the starts side by side; None to run them one by one in this process.
        budget: Time of the whole design, and the token that stops it.
        until_held_up: End searches whose steps become very short.
        cost_to_beat: Cost that random controls have reached, see `ConstrainedSearch`.
    """

    executor: ExecutorLike | None
    budget: Budget
    until_held_up: bool = False
    cost_to_beat: float = np.inf

    def turns(self, count: int) -> int:
        """Number of runs that each worker does one after the other.

        Args:
            count: Number of all runs.
        """
        workers = 1 if self.executor is None else Workers.of(self.executor).count
        return -(-max(count, 1) // workers)

    def run(self, level: DescentLevel, starts: Sequence[InitialControl], terms: RoundTerms) -> Runs:
        """Run one search per start.

        Args:
            level: The level on which the cost is minimised.
            starts: The initial controls.
            terms: What the searches have in common.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun.
        """
        searches = self._searches(level, starts, terms)
        if self.executor is None:
            return (yield from self._run_here(searches, level))

        # A worker needs no file of the caller, and resolves the task of all these searches once.
        task = level.task
        packed = for_workers(task.experiment, task.system.source)
        key = uuid.uuid4().hex
        orders = [
            ConstrainedSlice(search=replace(search, experiment=packed), task_key=key)
            for search in searches
        ]
        return (yield from run_in_slices(self.executor, orders, run_in_worker, self.budget))

    def _searches(
        self, level: DescentLevel, starts: Sequence[InitialControl], terms: RoundTerms
    ) -> list[ConstrainedSearch]:
        """The search from each start."""
        task = level.task
        tolerance = max(terms.schedule.tolerance, task.experiment.descent.tolerance)

        # Workers share the threads; without an executor a search uses all of them.
        threads = task.system.threads
        if self.executor is not None:
            threads = Workers.of(self.executor).threads_for(len(starts))

        return [
            ConstrainedSearch(
                experiment=task.experiment,
                start=start,
                schedule=replace(terms.schedule, tolerance=tolerance),
                max_iterations=max(terms.max_iterations, 1),
                budget=self.budget,
                seconds=terms.seconds,
                combinations=level.basis,
                added_information=task.added_information,
                variant=task.system.variant,
                threads=threads,
                tightening=terms.tightening,
                inside_first=terms.inside_first,
                until_held_up=self.until_held_up,
                cost_to_beat=self.cost_to_beat,
            )
            for start in starts
        ]

    def _run_here(self, searches: Sequence[ConstrainedSearch], level: DescentLevel) -> Runs:
        """Run searches one after the other while the budget lasts; the first one always begins."""
        results: list[RunResult] = []
        for search in searches:
            if results and self.budget.exhausted is not None:
                break

            result = yield from search.run(level.task)
            results.append(result)

        return results
