"""Searches of a design under hard limits, in this process or on workers."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mjfim.budget import Budget
from mjfim.excitation.constrained import ConstrainedSearch, ConstrainedSlice, run_in_worker
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.search_slices import slice_seconds
from mjfim.excitation.sent_task import SentTask
from mjfim.excitation.sliced_searches import run_in_slices
from mjfim.parallel import ExecutorLike, Workers
from mjfim.records.events import DesignEvent


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchTerms:
    """Limits of the effort of a search.

    Attributes:
        schedule: Stages of the barrier.
        max_iterations: Largest number of iterations.
        seconds: Time [s].
        tightening: Distance by which limits are moved inwards, by kind.
        inside_first: Whether the control is steered inside the limits before the cost is minimised.
    """

    schedule: BarrierSchedule
    max_iterations: int
    seconds: float
    tightening: Mapping[str, float] = field(default_factory=dict)
    inside_first: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedSearches:
    """Makes the searches of a design, and the orders with which workers run them.

    Attributes:
        stated: The stated level, on the plant without clamps.
        executor: Runs searches side by side; None to run them one by one in this process.
        budget: Time of the whole design, and the token that stops it.
        until_held_up: End searches whose steps become very short.
        cost_to_beat: Cost that random controls have reached, see `ConstrainedSearch`.
    """

    stated: DescentLevel
    executor: ExecutorLike | None
    budget: Budget
    until_held_up: bool = False
    cost_to_beat: float = np.inf

    def turns(self, count: int) -> int:
        """Number of searches that each worker does one after the other.

        Args:
            count: Number of all searches.
        """
        workers = 1 if self.executor is None else Workers.of(self.executor).count
        return -(-max(count, 1) // workers)

    def search(
        self, level: DescentLevel, start: InitialControl, terms: SearchTerms
    ) -> ConstrainedSearch:
        """Make a search, which uses all threads of this process.

        Args:
            level: The level on which the cost is minimised.
            start: The initial control.
            terms: What the search may use.
        """
        task = level.task
        tolerance = max(terms.schedule.tolerance, task.experiment.descent.tolerance)
        return ConstrainedSearch(
            experiment=task.experiment,
            start=start,
            schedule=replace(terms.schedule, tolerance=tolerance),
            max_iterations=max(terms.max_iterations, 1),
            budget=self.budget,
            seconds=terms.seconds,
            combinations=level.basis,
            added_information=task.added_information,
            variant=task.system.variant,
            threads=task.system.threads,
            tightening=terms.tightening,
            inside_first=terms.inside_first,
            until_held_up=self.until_held_up,
            cost_to_beat=self.cost_to_beat,
        )

    def order(
        self, executor: ExecutorLike, search: ConstrainedSearch, count: int = 1
    ) -> ConstrainedSlice:
        """Order for the first slice of a search.

        Args:
            executor: The workers, or an executor that they can wrap.
            search: The search.
            count: Number of searches side by side, which share the threads.
        """
        workers = Workers.of(executor)
        threads = workers.threads_for(count)
        sent = replace(search, experiment=self._sent.experiment, threads=threads)

        # A worker keeps the plant together with its threads, of which later rounds have more.
        key = f"{self._sent.key_of(search.variant)} {threads}"
        seconds = slice_seconds(min(workers.count, count))
        return ConstrainedSlice(search=sent, task_key=key, seconds=seconds)

    def run(
        self, level: DescentLevel, start: InitialControl, terms: SearchTerms
    ) -> Generator[DesignEvent, None, RunResult | None]:
        """Run a single search.

        Args:
            level: The level on which the cost is minimised.
            start: The initial control.
            terms: What the search may use.

        Yields:
            Every iterate.

        Returns:
            The result; None where it did not begin before a request to stop.
        """
        search = self.search(level, start, terms)
        if self.executor is None:
            return (yield from search.run(level.task))

        orders = [self.order(self.executor, search)]
        found = yield from run_in_slices(self.executor, orders, run_in_worker, self.budget)
        return found[0] if found else None

    @cached_property
    def _sent(self) -> SentTask:
        """Task that all orders of this design send."""
        return SentTask.of(self.stated.task)
