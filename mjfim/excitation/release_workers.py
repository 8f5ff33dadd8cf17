"""Releases on the workers of an executor: they evaluate the grid, and follow the best releases."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.release_evaluation import Release, ReleaseEvaluation
from mjfim.excitation.release_following import Following, follow
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.search_slices import SLICE_SECONDS
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.parallel import (
    Dispatch,
    ExecutorLike,
    Workers,
    one_blas_thread,
    pool_stop_token,
    results_or_here,
)
from mjfim.parallel.kept import KeptPerThread

T = TypeVar("T")

# Number of releases of the grid that a worker evaluates at once.
RELEASES_PER_ORDER = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class _EvaluationOrder:
    """Everything that determines the evaluation of releases. It can be pickled.

    Attributes:
        key: Unique text by which a worker recognises it.
        experiment: The experiment, with its files.
        added_information: (p, p) information of other experiments [1/theta^2], or None.
        basis: (t, s) identifiable combinations of the parameters, or None.
        space: Ranges of the release.
        step_factors: (p,) factors of the difference steps, or None.
        threads: Threads for simulations.
    """

    key: str
    experiment: Experiment
    added_information: Array | None
    basis: Array | None
    space: ReleaseSpace
    step_factors: Array | None
    threads: int

    def evaluation(self) -> ReleaseEvaluation:
        """Make the evaluation."""
        task = DesignTask.resolve(
            self.experiment, threads=self.threads, added_information=self.added_information
        )
        plant = task.plant.with_step_factors(self.step_factors)
        return ReleaseEvaluation(DescentLevel(task, self.basis), self.space, plant)


@dataclass(frozen=True, kw_only=True, eq=False)
class _GridOrder:
    """Order to evaluate some releases.

    Attributes:
        evaluation: How they are evaluated.
        shares: (d,) place of each in the ranges.
    """

    evaluation: _EvaluationOrder
    shares: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class _FollowOrder:
    """Order for a slice of a local search.

    Attributes:
        evaluation: How releases are evaluated.
        start: Where the search begins.
        before: The search as far as it came.
        seconds: Time of the slice [s].
    """

    evaluation: _EvaluationOrder
    start: Release
    before: Following
    seconds: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found(Generic[T]):
    """Result of a worker, and how much it has simulated.

    Attributes:
        result: The result.
        steps: Engine steps that this took.
    """

    result: T
    steps: int


# The latest evaluations of a worker, by their key.
_worker_evaluations: KeptPerThread[ReleaseEvaluation] = KeptPerThread(2)


@one_blas_thread()
def _grid_in_worker(order: _GridOrder) -> _Found[tuple[Release, ...]]:
    """Evaluate some releases in a worker process."""
    evaluation = _evaluation_of(order.evaluation)
    before = evaluation.plant.engine_steps
    found = tuple(evaluation.release(shares) for shares in order.shares)
    return _Found(result=found, steps=evaluation.plant.engine_steps - before)


@one_blas_thread()
def _follow_in_worker(order: _FollowOrder) -> _Found[Following]:
    """Follow a release for a slice in a worker process."""
    evaluation = _evaluation_of(order.evaluation)
    before, stop = evaluation.plant.engine_steps, pool_stop_token()
    end = time.monotonic() + order.seconds
    found = follow(
        evaluation.release,
        order.start,
        evaluation.stage.task.experiment.descent,
        order.before,
        lambda: stop.requested or time.monotonic() >= end,
    )
    return _Found(result=found, steps=evaluation.plant.engine_steps - before)


def _evaluation_of(order: _EvaluationOrder) -> ReleaseEvaluation:
    """The evaluation of an order in a worker, made at its first order."""
    return _worker_evaluations.get(order.key, order.evaluation)


class ReleaseWorkers:
    """Workers that evaluate releases; the results are those of one process, to the last digit.

    Args:
        executor: The workers, or an executor that they can wrap.
        budget: Time of the search and the token that stops it.
    """

    def __init__(self, executor: ExecutorLike, budget: Budget) -> None:
        self._workers = Workers.of(executor)
        self._budget = budget

    def grid(
        self, evaluation: ReleaseEvaluation, grid: Sequence[Array], share: float
    ) -> Iterator[Release]:
        """Evaluate the releases of a grid, in their order.

        Args:
            evaluation: Evaluates releases in this process.
            grid: (d,) place of each in the ranges.
            share: Share of the time that is left after which the rest is left out.

        Yields:
            The evaluated releases.
        """
        parts = [
            tuple(grid[first : first + RELEASES_PER_ORDER])
            for first in range(0, len(grid), RELEASES_PER_ORDER)
        ]
        common = self._order(evaluation, len(parts))
        orders = [_GridOrder(evaluation=common, shares=part) for part in parts]

        def here(order: _GridOrder) -> _Found[tuple[Release, ...]]:
            """Evaluate releases whose worker was lost; their steps are counted by the plant."""
            found = tuple(evaluation.release(shares) for shares in order.shares)
            return _Found(result=found, steps=0)

        budget = self._budget.share(share)
        for found in results_or_here(self._workers, _grid_in_worker, orders, budget, here):
            evaluation.plant.simulator.add_steps(found.steps)
            yield from found.result

    def followed(self, evaluation: ReleaseEvaluation, starts: Sequence[Release]) -> list[Following]:
        """Follow several releases side by side, in slices.

        Args:
            evaluation: Evaluates releases in this process.
            starts: Where the searches begin.

        Returns:
            Every search as far as it came; one that has not begun has tried nothing.
        """
        common = self._order(evaluation, len(starts))
        dispatch = Dispatch[_FollowOrder, _Found[Following]](
            self._workers, _follow_in_worker, self._budget
        )
        latest = [Following() for _ in starts]
        orders = [
            _FollowOrder(evaluation=common, start=start, before=before, seconds=SLICE_SECONDS)
            for start, before in zip(starts, latest, strict=True)
        ]
        for index, order in enumerate(orders):
            dispatch.add(index, order)

        for outcome in dispatch.arrivals():
            # A search whose worker is lost each time ends with what it has tried.
            if outcome.is_lost:
                latest[outcome.index] = replace(latest[outcome.index], is_lost=True)
                continue
            index, found = outcome.index, outcome.result
            evaluation.plant.simulator.add_steps(found.steps)
            latest[index] = found.result
            if self._budget.exhausted is not None:
                dispatch.withdraw()
            elif not found.result.has_ended:
                dispatch.add(index, replace(orders[index], before=found.result), next_one=True)
        return latest

    def _order(self, evaluation: ReleaseEvaluation, tasks: int) -> _EvaluationOrder:
        """Describe an evaluation for workers, which do some number of tasks."""
        task = evaluation.stage.task
        return _EvaluationOrder(
            key=uuid.uuid4().hex,
            experiment=for_workers(task.experiment, task.system.source),
            added_information=task.added_information,
            basis=evaluation.stage.basis,
            space=evaluation.space,
            step_factors=evaluation.plant.step_factors,
            threads=self._workers.threads_for(tasks),
        )
