"""Requests of a fit to the workers that do a part of its work."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar

from mjfim.budget import Budget
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution, UnknownValues

if TYPE_CHECKING:
    from mjfim.identification.fit_problem import FitProblem

T = TypeVar("T")

# Work on one batch of a problem, at values of the unknowns.
BatchWork = Callable[["FitProblem", UnknownValues, SegmentBatch], T | None]


class BatchWorkers(Protocol):
    """Does work on batches of segments in other processes."""

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

    def solutions(
        self,
        problem: FitProblem,
        begins: Sequence[UnknownValues],
        settings: SearchSettings,
        budget: Budget,
    ) -> Iterator[Solution | None]:
        """Search from several starts.

        Args:
            problem: The problem.
            begins: Unknowns at which the searches begin.
            settings: Tolerance and number of iterations.
            budget: Ends the searches early.

        Yields:
            The solution of every search that was not stopped before its begin, in their order; None
            where the simulation diverges at the begin.
        """
