"""A fit on the workers of an executor: they simulate batches of segments, and search from starts.

A worker receives the recordings of its batches once, and the values of the unknowns with every
order. The batches, and the order in which their results are added, are those of a single process:
the estimate is the same to the last digit.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar
from weakref import WeakKeyDictionary

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.experiment.system import System
from mjfim.experiment.system_order import SystemOrder
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.batch_workers import BatchWork
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.pins import Pins
from mjfim.identification.segment_simulation import SegmentBatch, SegmentSimulation
from mjfim.identification.segments import Segment
from mjfim.identification.unknowns import UnknownLayout
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.parallel import Workers, one_blas_thread, pool_stop_token, results_or_here
from mjfim.parallel.kept import KeptPerThread
from mjfim.parallel.shared_value import SharedValue, require_values
from mjfim.plant.noise import Noise

T = TypeVar("T")

# Number of problems that a worker keeps: a fit has variants with other noise or other segments.
KEPT_PROBLEMS = 8


@dataclass(frozen=True, kw_only=True, eq=False)
class _ProblemOrder:
    """A problem for the segments of some of its recordings. It can be pickled.

    Attributes:
        system: The system.
        recordings: Each of the recordings that are needed, by its index.
        masks: (M, ny) measured values of these recordings that count.
        row_counts: Number of rows M of every recording.
        segments: All segments of the problem.
        layout: Layout of the unknowns.
        start_directions: (nx, n) directions of the initial state.
        noise: Noise of the outputs.
        loss: Loss of a whitened residual.
        pins: Combinations that no recording determines.
        with_priors: Whether priors count.
        difference_step: Relative step of the differences.
    """

    system: SharedValue[SystemOrder]
    recordings: dict[int, SharedValue[AlignedRecording]]
    masks: dict[int, np.ndarray]
    row_counts: tuple[int, ...]
    segments: tuple[Segment, ...]
    layout: UnknownLayout
    start_directions: Array
    noise: Noise
    loss: RobustLoss
    pins: Pins
    with_priors: bool
    difference_step: float

    def problem(self) -> FitProblem:
        """Make the problem; recordings that are not needed are empty."""
        require_values([self.system, *self.recordings.values()])
        system = _worker_systems.get(self.system.digest, lambda: self.system.value.system())

        ny = len(system.outputs)
        known = self.recordings
        recordings = [
            known[i].value if i in known else _without_values(count, ny)
            for i, count in enumerate(self.row_counts)
        ]
        masks = [
            self.masks[i] if i in known else np.broadcast_to(False, (count, ny))
            for i, count in enumerate(self.row_counts)
        ]
        simulation = SegmentSimulation(
            system=system,
            recordings=tuple(recordings),
            segments=self.segments,
            layout=self.layout,
            start_directions=self.start_directions,
        )
        return FitProblem(
            simulation=simulation,
            masks=tuple(masks),
            noise=self.noise,
            loss=self.loss,
            pins=self.pins,
            with_priors=self.with_priors,
            difference_step=self.difference_step,
        )


def _without_values(rows: int, outputs: int) -> AlignedRecording:
    """A recording of a length without contents, which takes no memory."""
    return AlignedRecording(
        name="",
        t=np.broadcast_to(0.0, (rows,)),
        y=np.broadcast_to(np.nan, (rows, outputs)),
        ctrl=np.zeros((0, 0)),
        dt=1.0,
        on_grid=True,
    )


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


# The latest systems of a worker, by the hash of their order.
_worker_systems: KeptPerThread[System] = KeptPerThread(KEPT_PROBLEMS)

# The latest problems of a worker, by the hash of their order.
_worker_problems: KeptPerThread[FitProblem] = KeptPerThread(KEPT_PROBLEMS)


@dataclass(frozen=True, kw_only=True, eq=False)
class _BatchOrder(Generic[T]):
    """Work on one batch.

    Attributes:
        problem: The problem, with the recordings of the batch.
        work: Method of the problem that does the work.
        batch: The batch.
        at: The unknowns.
    """

    problem: SharedValue[_ProblemOrder]
    work: BatchWork[T]
    batch: SegmentBatch
    at: UnknownValues


@dataclass(frozen=True, kw_only=True, eq=False)
class _SearchOrder:
    """Search from one start.

    Attributes:
        problem: The problem, with all its recordings.
        begin: Unknowns at which the search begins.
        settings: Tolerance and number of iterations.
    """

    problem: SharedValue[_ProblemOrder]
    begin: UnknownValues
    settings: SearchSettings


def _problem_of(order: SharedValue[_ProblemOrder]) -> FitProblem:
    """The problem of an order in a worker, made at its first order."""
    return _worker_problems.get(order.digest, lambda: order.value.problem())


@one_blas_thread()
def _work_on_batch(order: _BatchOrder[T]) -> _Found[T | None]:
    """Do the work on one batch in a worker process."""
    problem = _problem_of(order.problem)
    return _counted(problem, lambda: order.work(problem, order.at, order.batch))


@one_blas_thread()
def _search_in_worker(order: _SearchOrder) -> _Found[Solution | None]:
    """Search from one start in a worker process."""
    problem = _problem_of(order.problem)
    return _counted(problem, lambda: _search(problem, order, pool_stop_token()))


def _search(problem: FitProblem, order: _SearchOrder, stop: StopToken) -> Solution | None:
    """Search from one start; None where the simulation diverges there."""
    return minimise(problem, order.begin, order.settings, Budget(stop=stop))


def _counted(problem: FitProblem, work: Callable[[], T]) -> _Found[T]:
    """Do a work, and count the engine steps that it takes."""
    before = problem.system.plant.engine_steps
    result = work()
    return _Found(result=result, steps=problem.system.plant.engine_steps - before)


# ---- in the process of the fit


class FitWorkers:
    """Workers that simulate the batches of a fit, and search from its starts.

    Args:
        executor: Executor of the workers.
    """

    def __init__(self, executor: Any) -> None:
        self._executor = Workers.of(executor)
        self._orders: _Orders = WeakKeyDictionary()

        # Variants of a problem have the same systems and recordings.
        self._systems: dict[tuple[int, int], tuple[System, SharedValue[SystemOrder]]] = {}
        self._recordings: WeakKeyDictionary[AlignedRecording, SharedValue[AlignedRecording]]
        self._recordings = WeakKeyDictionary()

    def of_batches(
        self,
        problem: FitProblem,
        work: BatchWork[T],
        batches: Sequence[SegmentBatch],
        at: UnknownValues,
    ) -> Sequence[T | None]:
        """Do a work on all batches. See `batch_workers.BatchWorkers`."""
        # One batch is simulated by all threads of this process.
        if len(batches) < 2:
            return [work(problem, at, batch) for batch in batches]

        threads = self._executor.threads_for(len(batches))
        orders = []
        for batch in batches:
            needed = {problem.segments[i].recording for i in batch.segments}
            shared = self._order_of(problem, sorted(needed), threads)
            orders.append(_BatchOrder(problem=shared, work=work, batch=batch, at=at))

        def here(order: _BatchOrder[T]) -> _Found[T | None]:
            """Do the work of a lost worker; its steps are counted by the simulator."""
            return _Found(result=work(problem, at, order.batch), steps=0)

        # A pass is completed, as in a single process: the search stops between two passes.
        results: Iterator[_Found[T | None]] = results_or_here(
            self._executor, _work_on_batch, orders, Budget(), here
        )
        return [_counted_here(problem, found) for found in results]

    def solutions(
        self,
        problem: FitProblem,
        begins: Sequence[UnknownValues],
        settings: SearchSettings,
        budget: Budget,
    ) -> Iterator[Solution | None]:
        """Search from several starts. See `batch_workers.BatchWorkers`."""
        needed = {segment.recording for segment in problem.segments}
        threads = self._executor.threads_for(len(begins))
        shared = self._order_of(problem, sorted(needed), threads)
        orders = [_SearchOrder(problem=shared, begin=begin, settings=settings) for begin in begins]
        alone = replace(problem, workers=None)

        def here(order: _SearchOrder) -> _Found[Solution | None]:
            """Search from the start of a lost worker; its steps are counted by the simulator."""
            return _Found(result=_search(alone, order, budget.stop), steps=0)

        for found in results_or_here(self._executor, _search_in_worker, orders, budget, here):
            yield _counted_here(problem, found)

    def _order_of(
        self, problem: FitProblem, needed: Sequence[int], threads: int
    ) -> SharedValue[_ProblemOrder]:
        """The order for a problem with some of its recordings, made once."""
        known = self._orders.setdefault(problem, {})
        key = (threads, *needed)
        if key not in known:
            known[key] = SharedValue(uuid.uuid4().hex, self._made(problem, needed, threads))
        return known[key]

    def _made(self, problem: FitProblem, needed: Sequence[int], threads: int) -> _ProblemOrder:
        """The order for a problem with some of its recordings."""
        return _ProblemOrder(
            system=self._shared_system(problem.system, threads),
            recordings={i: self._shared_recording(problem.recordings[i]) for i in needed},
            masks={i: problem.masks[i] for i in needed},
            row_counts=tuple(len(recording.t) for recording in problem.recordings),
            segments=problem.segments,
            layout=problem.layout,
            start_directions=problem.simulation.start_directions,
            noise=problem.noise,
            loss=problem.loss,
            pins=problem.pins,
            with_priors=problem.with_priors,
            difference_step=problem.difference_step,
        )

    def _shared_system(self, system: System, threads: int) -> SharedValue[SystemOrder]:
        """The order for a system, made once."""
        key = (id(system), threads)
        if key not in self._systems:
            order = SharedValue(uuid.uuid4().hex, SystemOrder.of(system, threads))

            # The system is kept as well, so that no other one has its identity.
            self._systems[key] = (system, order)
        return self._systems[key][1]

    def _shared_recording(self, recording: AlignedRecording) -> SharedValue[AlignedRecording]:
        """A recording, sent once."""
        if recording not in self._recordings:
            size = recording.t.nbytes + recording.y.nbytes + recording.ctrl.nbytes
            self._recordings[recording] = SharedValue(uuid.uuid4().hex, recording, size)
        return self._recordings[recording]


# Orders of each problem, by the threads of a worker and the recordings that are needed.
_Orders = WeakKeyDictionary[FitProblem, dict[tuple[int, ...], SharedValue[_ProblemOrder]]]


def _counted_here(problem: FitProblem, found: _Found[T]) -> T:
    """Result of a worker, whose engine steps are added to those of the problem."""
    problem.system.plant.simulator.add_steps(found.steps)
    return found.result
