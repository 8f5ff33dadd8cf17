"""Descents without a barrier from several starts, side by side on the workers of an executor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult, Runs, consume
from mjfim.excitation.search_slices import (
    SearchSlice,
    SliceOrder,
    slice_seconds,
    worker_budget,
)
from mjfim.excitation.sent_task import SentTask
from mjfim.excitation.sliced_searches import run_in_slices
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import FreeState, UnconstrainedSearch
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import ModelVariant
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread
from mjfim.parallel.kept import KeptPerThread


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeSlice(SliceOrder[FreeState]):
    """Order for a slice of a descent without a barrier.

    Attributes:
        experiment: The experiment.
        start: The initial control.
        basis: (t, s) identifiable combinations of the parameters, or None.
        added_information: (p, p) information of other experiments [1/theta^2], or None.
        variants: Plant of each level, from the coarsest to the stated one.
        budget: Budget of the whole design; its token ends the descent.
        threads: Threads for simulations.
    """

    experiment: Experiment
    start: InitialControl
    basis: Array | None
    added_information: Array | None
    variants: tuple[ModelVariant, ...]
    budget: Budget = field(default_factory=Budget)
    threads: int | None = None

    @property
    def name(self) -> str:
        """Name of the initial control."""
        return self.start.name

    def resolved(self) -> tuple[DesignTask, ...]:
        """The task on each level."""
        stated = DesignTask.resolve(
            self.experiment,
            threads=self.threads,
            added_information=self.added_information,
            variant=self.variants[-1],
        )
        return (*(stated.with_variant(variant) for variant in self.variants[:-1]), stated)


# Tasks on all levels that a worker keeps for later slices.
_tasks = KeptPerThread[tuple[DesignTask, ...]](2)


@one_blas_thread()
def run_free_in_worker(order: FreeSlice) -> SearchSlice[FreeState]:
    """Run a slice of a descent, for an executor.

    Args:
        order: The order. A request to stop by its token or by that of the worker's pool ends it.

    Returns:
        The result so far with the engine steps of all levels, and the state.
    """
    tasks = _tasks.get(order.task_key, order.resolved)
    sealed = None if order.before is None else order.before.state
    state = None if sealed is None else sealed.opened()
    steps_done = 0 if state is None else state.steps
    search = UnconstrainedSearch(
        levels=[DescentLevel(task, order.basis) for task in tasks],
        budget=worker_budget(order.budget),
        constraints=None,
        steps_before=sum(task.plant.engine_steps for task in tasks) - steps_done,
        length=order.length,
    )
    found = consume(search.run_slice(order.start, state), None)
    return replace(found, result=replace(found.result, steps=search.steps))


def has_a_start_for_each(executor: ExecutorLike, starts: Sequence[InitialControl]) -> bool:
    """Check whether starts side by side are quicker than one after the other with all threads.

    Args:
        executor: The workers, or an executor that they can wrap.
        starts: The initial controls.
    """
    workers = Workers.of(executor)
    return len(starts) > 1 and (workers.is_cluster or len(starts) >= workers.count)


def run_free_starts(
    executor: ExecutorLike,
    levels: Sequence[DescentLevel],
    starts: Sequence[InitialControl],
    budget: Budget,
) -> Runs:
    """Descend from several initial controls side by side.

    Args:
        executor: The workers, or an executor that they can wrap.
        levels: Levels from the coarsest to the stated one.
        starts: The initial controls.
        budget: Time of all descents.

    Yields:
        Every iterate, as soon as its slice has ended.

    Returns:
        One result for every descent that was begun, as from one descent after the other. It states
        the engine steps of all levels.
    """
    stated = levels[-1].task
    workers = Workers.of(executor)
    variants = tuple(level.task.system.variant for level in levels)
    sent = SentTask.of(stated)
    first = FreeSlice(
        task_key=sent.key_of(*variants),
        experiment=sent.experiment,
        start=starts[0],
        basis=levels[-1].basis,
        added_information=stated.added_information,
        variants=variants,
        budget=budget,
        threads=workers.threads_for(len(starts)),
        seconds=slice_seconds(min(workers.count, len(starts))),
    )
    orders = [replace(first, start=start) for start in starts]
    results = yield from run_in_slices(executor, orders, run_free_in_worker, budget)
    found = _counted_together(results)

    # The choice of the levels took some steps on the coarse plant, which the caller does not count.
    if found and len(levels) > 1:
        chosen = levels[0].task.plant.engine_steps
        found[0] = replace(found[0], steps=found[0].steps + chosen)
    return found


def _counted_together(results: Sequence[RunResult]) -> list[RunResult]:
    """Results whose histories count engine steps from the beginning of the first one."""
    before = np.cumsum([0, *(result.steps for result in results)])
    counted = []
    for result, steps in zip(results, before.tolist(), strict=False):
        rows = tuple(replace(row, steps=row.steps + steps) for row in result.history)
        counted.append(replace(result, history=rows))
    return counted
