"""Requests of a fit to the workers that do a part of its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar

from mjfim.budget import Budget
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.optimize.levenberg_marquardt import UnknownValues

if TYPE_CHECKING:
    from mjfim.identification.fit_problem import FitProblem

T = TypeVar("T")

# Work on one batch of a problem, at values of the unknowns.
BatchWork = Callable[["FitProblem", UnknownValues, SegmentBatch], T | None]

# Size of all recordings of a problem up to which each worker receives them [bytes].
LARGEST_SENT_BYTES = 64 * 2**20

# A task on a whole problem, which ends early when the budget is exhausted.
ProblemWork = Callable[["FitProblem", Budget], T]


class BatchWorkers(Protocol):
    """Workers for batches of segments, and for tasks on a whole problem."""

    @property
    def count(self) -> int:
        """Number of workers."""

    def of_batches(
        self,
        problem: FitProblem,
        work: BatchWork[T],
        batches: Sequence[SegmentBatch],
        at: UnknownValues,
    ) -> Sequence[T | None]:
        """Do a work on all batches.

        Args:
            problem: The problem.
            work: Method of the problem that does it for one batch.
            batches: The batches.
            at: The unknowns.

        Returns:
            What is found for every batch, in their order.
        """

    def of_whole(
        self, problem: FitProblem, works: Sequence[ProblemWork[T]], budget: Budget
    ) -> Iterator[T]:
        """Do tasks that do not depend on each other, each of them in one worker.

        Every worker receives all data of the problem, so that these should not be large.

        Args:
            problem: The problem.
            works: The tasks; they and the results can be pickled.
            budget: Ends the tasks early.

        Yields:
            The result of every task that was not stopped before its begin, in their order.
        """
