"""A fit on the workers of an executor: they simulate batches of segments, or do whole searches.

A worker receives the recordings of its batches once, and the values of the unknowns with every
order. The batches, and the order in which their results are added, are those of a single process:
the estimate is the same to the last digit.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from mjfim.budget import Budget, StopToken
from mjfim.experiment.system import System
from mjfim.experiment.system_order import SystemOrder
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.batch_workers import LARGEST_SENT_BYTES, BatchWork, ProblemWork
from mjfim.identification.fit_orders import (
    KEPT_PROBLEMS,
    BatchOrder,
    PartOrder,
    ProblemOrder,
    RecordingOrder,
    WholeOrder,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.recording_files import RecordingFolder
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.optimize.levenberg_marquardt import InterruptedPassError, UnknownValues
from mjfim.parallel import (
    ExecutorLike,
    Workers,
    carry_out,
    one_blas_thread,
    pool_stop_token,
    results_or_here,
)
from mjfim.parallel.dispatch import GRACE
from mjfim.parallel.kept import KeptPerThread
from mjfim.parallel.shared_value import SharedValue
from mjfim.recordings.channels import Channels

T = TypeVar("T")

# Size of a recording above which workers of this computer find it as files [bytes]; smaller ones
# are sent.
MIN_FILE_BYTES = 2**20


@dataclass(frozen=True, kw_only=True, eq=False)
class _Found(Generic[T]):
    """Result of a worker, and how much it has simulated.

    Attributes:
        result: The result.
        steps: Engine steps that this took.
    """

    result: T
    steps: int


# ---- in a worker


# The latest problems of a worker, by the hash of their part.
_worker_problems: KeptPerThread[FitProblem] = KeptPerThread(KEPT_PROBLEMS)


def _problem_of(order: SharedValue[PartOrder]) -> FitProblem:
    """The problem of an order in a worker, made at its first order."""
    return _worker_problems.get(order.digest, lambda: order.value.made())


@one_blas_thread()
def _work_on_batch(order: BatchOrder[T]) -> _Found[T | None]:
    """Do the work on one batch in a worker process."""
    problem = _problem_of(order.part)
    at = order.unknowns(len(problem.segments))
    return _counted(problem, lambda: order.work(problem, at, order.batch))


@one_blas_thread()
def _work_on_whole(order: WholeOrder[T]) -> _Found[T]:
    """Do a task on a whole problem in a worker process."""
    problem = _problem_of(order.part)
    return _counted(problem, lambda: order.work(problem, Budget(stop=pool_stop_token())))


def _counted(problem: FitProblem, work: Callable[[], T]) -> _Found[T]:
    """Do a work, and count the engine steps that it takes."""
    before = problem.system.plant.engine_steps
    result = work()
    return _Found(result=result, steps=problem.system.plant.engine_steps - before)


# ---- in the process of the fit


class _Watch:
    """Watches whether workers still do anything after a request to stop.

    Args:
        workers: The workers.
    """

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self.restart()

    def restart(self) -> None:
        """Begin to wait again, after a worker has done something."""
        self._begun = time.monotonic()

    @property
    def is_over(self) -> bool:
        """True where there is no worker any more, or none has done anything for `GRACE`."""
        return self._workers.is_empty or time.monotonic() - self._begun > GRACE


class FitWorkers:
    """Workers that simulate the batches of a fit, or do whole tasks such as searches.

    Args:
        executor: Executor of the workers.
        stop: Token whose request ends a pass over the data that is running.
    """

    def __init__(self, executor: ExecutorLike, stop: StopToken | None = None) -> None:
        self._executor = Workers.of(executor)
        self._stop = StopToken() if stop is None else stop

        # True if, after a request to stop, this process does the passes itself that a result still
        # needs, because the workers do not answer or are busy with what nobody waits for.
        self._are_given_up = False

        # Orders of each problem, by the threads of a worker, and the segments of a part.
        self._orders: WeakKeyDictionary[FitProblem, dict[int, SharedValue[ProblemOrder]]]
        self._orders = WeakKeyDictionary()
        self._parts: WeakKeyDictionary[
            FitProblem, dict[tuple[int, ...], SharedValue[PartOrder]]
        ] = WeakKeyDictionary()

        # Variants of a problem have the same systems and recordings. Orders hold them, so that they
        # are kept as long as this object.
        self._systems: dict[tuple[int, int], tuple[System, SharedValue[SystemOrder]]] = {}
        self._recordings: dict[AlignedRecording, RecordingOrder] = {}
        self._folder = RecordingFolder()

    @property
    def count(self) -> int:
        """Number of workers."""
        return self._executor.count

    def of_batches(
        self,
        problem: FitProblem,
        work: BatchWork[T],
        batches: Sequence[SegmentBatch],
        at: UnknownValues,
    ) -> Sequence[T | None]:
        """Do a work on all batches. See `batch_workers.BatchWorkers`."""
        # One batch is simulated by all threads of this process. So is what is needed after a
        # request to stop, if the workers did not answer then: each pass would wait for them anew.
        if len(batches) < 2 or self._are_given_up:
            return [work(problem, at, batch) for batch in batches]

        threads = self._executor.threads_for(len(batches))
        orders = [
            BatchOrder.of(self.part_of(problem, batch.segments, threads), work, batch, at)
            for batch in batches
        ]

        # A pass that begins after the request is one that the result needs. Ctrl-C in a terminal
        # may have ended the workers, so that this process does what nobody else does.
        is_needed = self._stop.requested
        watch = _Watch(self._executor)
        stop = StopToken(also=lambda: watch.is_over) if is_needed else self._stop
        found: dict[int, T | None] = {}
        for outcome in carry_out(self._executor, _work_on_batch, orders, Budget(stop=stop)):
            watch.restart()
            if not outcome.is_lost:
                found[outcome.index] = _counted_here(problem, outcome.result)
            elif not self._stop.requested:
                found[outcome.index] = work(problem, at, batches[outcome.index])

        if len(found) < len(orders) and not is_needed:
            raise InterruptedPassError
        # One order that is lost again and again does not mean that no worker answers.
        self._are_given_up = is_needed and watch.is_over and len(found) < len(orders)
        for index, batch in enumerate(batches):
            if index not in found:
                found[index] = work(problem, at, batch)
        return [found[index] for index in range(len(batches))]

    def of_whole(
        self, problem: FitProblem, works: Sequence[ProblemWork[T]], budget: Budget
    ) -> Iterator[T]:
        """Do independent tasks, each in one worker. See `batch_workers.BatchWorkers`."""
        threads = self._executor.threads_for(len(works))
        part = self.part_of(problem, range(len(problem.segments)), threads)
        orders = [WholeOrder(part=part, work=work) for work in works]
        alone = replace(problem, workers=None)

        def here(order: WholeOrder[T]) -> _Found[T]:
            """Do the work of a lost worker; its steps are counted by the simulator."""
            return _Found(result=order.work(alone, budget), steps=0)

        work_on_whole: Callable[[WholeOrder[T]], _Found[T]] = _work_on_whole
        left = len(orders)
        try:
            for found in results_or_here(self._executor, work_on_whole, orders, budget, here):
                left -= 1
                yield _counted_here(problem, found)
        finally:
            # Workers other than those of a pool go on with tasks that a request to stop has left.
            # If all of them do, this process is sooner ready with passes over small data.
            is_small = problem.recording_bytes <= LARGEST_SENT_BYTES
            are_busy = self._executor.pool is None and left >= self.count
            if self._stop.requested and are_busy and is_small:
                self._are_given_up = True

    def part_of(
        self, problem: FitProblem, segments: Sequence[int], threads: int
    ) -> SharedValue[PartOrder]:
        """Share some segments of a problem, described once.

        Args:
            problem: The problem.
            segments: Indices of the segments.
            threads: Threads of a worker.
        """
        known = self._parts.setdefault(problem, {})
        key = (threads, *segments)
        if key not in known:
            shared = self._problem_order(problem, threads)
            channels = problem.system.channels
            part = PartOrder.of(
                problem, segments, shared, lambda each: self._recording_order(each, channels)
            )
            known[key] = SharedValue(uuid.uuid4().hex, part, part.size)
        return known[key]

    def _problem_order(self, problem: FitProblem, threads: int) -> SharedValue[ProblemOrder]:
        """Return the order that all parts of a problem share, which is made once."""
        known = self._orders.setdefault(problem, {})
        if threads not in known:
            known[threads] = SharedValue(uuid.uuid4().hex, self._made(problem, threads))
        return known[threads]

    def _made(self, problem: FitProblem, threads: int) -> ProblemOrder:
        """Make the order that all parts of a problem share."""
        rows = [segment.rows.stop - segment.rows.start for segment in problem.segments]
        return ProblemOrder(
            system=self._shared_system(problem.system, threads),
            row_counts=tuple(len(recording.t) for recording in problem.recordings),
            segment_rows=np.array(rows),
            layout=problem.layout,
            start_directions=problem.simulation.start_directions,
            noise=problem.noise,
            loss=problem.loss,
            pins=problem.pins,
            with_priors=problem.with_priors,
            difference_step=problem.difference_step,
            central=problem.central,
        )

    def _shared_system(self, system: System, threads: int) -> SharedValue[SystemOrder]:
        """The order for a system, made once."""
        key = (id(system), threads)
        if key not in self._systems:
            order = SharedValue(uuid.uuid4().hex, SystemOrder.of(system, threads))

            # The system is kept as well, so that no other one has its identity.
            self._systems[key] = (system, order)
        return self._systems[key][1]

    def _recording_order(self, recording: AlignedRecording, channels: Channels) -> RecordingOrder:
        """A recording, which each worker reads or receives once."""
        if recording not in self._recordings:
            self._recordings[recording] = self._ordered(recording, channels)
        return self._recordings[recording]

    def _ordered(self, recording: AlignedRecording, channels: Channels) -> RecordingOrder:
        """Order a recording, with the files that workers may need."""
        if self._executor.shares_memory:
            return RecordingOrder.of(recording, None)

        files = self._folder.written(recording) if recording.size > MIN_FILE_BYTES else None

        # Workers of this computer find these files, so that nobody reads the log again.
        is_found = files is not None and self._executor.is_local
        return RecordingOrder.of(recording, None if is_found else channels, files)


def _counted_here(problem: FitProblem, found: _Found[T]) -> T:
    """Result of a worker, whose engine steps are added to those of the problem."""
    problem.system.plant.simulator.add_steps(found.steps)
    return found.result
