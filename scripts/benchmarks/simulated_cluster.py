"""A cluster of any size on a simulated clock, for the scheduling code of mjfim itself.

Each task is carried out once in this process, and the CPU time that it takes is measured. Its
result and its length are kept, so that the same work can be scheduled again on 2 or 256 simulated
workers within seconds. What is simulated is the time alone: the scheduler (`mjfim.parallel`, and
what decides between slices of searches) is that of the package, and what the caller computes
between tasks counts with its measured CPU time, during which the workers go on. So does the time in
which it pickles orders and unpickles results, which is measured once for equal tasks. Beyond that,
a cluster needs the latency, and the time in which each of its workers resolves the experiment at
its first task: here one task does this for all of them.
"""

from __future__ import annotations

import heapq
import pickle
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import Empty
from typing import Any
from unittest.mock import patch

from mjfim.parallel import Workers, dispatch

# Number of times that an order is pickled, and its result unpickled, to measure how long it takes.
PICKLED_TIMES = 3


@dataclass(kw_only=True)
class MeasuredTasks:
    """Results and lengths of tasks, each of which is carried out once.

    Attributes:
        key_of: Key of a task by its arguments; tasks with the same key have the same result.
        kept: Result and CPU time [s] by key.
        pickling: CPU times in which the caller pickles the order and unpickles the result [s], by
            key.
    """

    key_of: Callable[[tuple[Any, ...]], Hashable] = pickle.dumps
    kept: dict[Hashable, tuple[Any, float]] = field(default_factory=dict)
    pickling: dict[Hashable, tuple[float, float]] = field(default_factory=dict)

    def done(self, fn: Callable[..., Any], args: tuple[Any, ...]) -> tuple[Any, float]:
        """Result of a task and its CPU time [s].

        Args:
            fn: Function of the task.
            args: Its arguments.
        """
        key = self.key_of(args)
        if key not in self.kept:
            begun = time.process_time()
            result = fn(*args)
            self.kept[key] = result, time.process_time() - begun
        return self.kept[key]

    def pickled(
        self, fn: Callable[..., Any], args: tuple[Any, ...], result: Any
    ) -> tuple[float, float]:
        """CPU times in which the caller pickles an order and unpickles its result [s].

        Args:
            fn: Function of the task.
            args: Its arguments.
            result: Its result.
        """
        key = self.key_of(args)
        if key not in self.pickling:
            sent = pickle.dumps(result, pickle.HIGHEST_PROTOCOL)
            self.pickling[key] = (
                _mean_time(lambda: pickle.dumps((fn, args), pickle.HIGHEST_PROTOCOL)),
                _mean_time(lambda: pickle.loads(sent)),
            )
        return self.pickling[key]


def _mean_time(action: Callable[[], object]) -> float:
    """CPU time of an action, the mean of some runs [s]."""
    begun = time.process_time()
    for _ in range(PICKLED_TIMES):
        action()
    return (time.process_time() - begun) / PICKLED_TIMES


@dataclass(frozen=True, kw_only=True, eq=False)
class _Arrival:
    """Result of a task on its way.

    Attributes:
        result: The result.
        receiving: CPU time in which the caller unpickles it [s].
    """

    result: Any
    receiving: float


class SimulatedCluster(Executor):
    """An executor whose tasks end on a simulated clock.

    Args:
        count: Number of workers, each of which does one task at a time.
        tasks: Results and lengths of the tasks.
        latency: Time from the submission of a task to its begin [s], and from its end to its
            arrival.

    Attributes:
        now: Simulated time [s].
        busy: Length of all tasks together [s].
        caller: CPU time of the caller between the tasks, such as for choosing survivors [s].
        pickling: The part of it in which orders are pickled and results unpickled [s].
        searching: Time from the submission of the first task to the arrival of the last one [s].
        count: Number of tasks.
    """

    def __init__(self, count: int, tasks: MeasuredTasks, latency: float = 0.0) -> None:
        self.max_workers = count
        self.now = 0.0
        self.busy = 0.0
        self.caller = 0.0
        self.pickling = 0.0
        self.searching = 0.0
        self.count = 0
        self._first: float | None = None
        self._tasks = tasks
        self._latency = latency
        self._free_at = [0.0] * count
        self._running: list[tuple[float, int, Future[Any], _Arrival]] = []
        self._submitted = 0
        self._mark = time.process_time()

    @property
    def workers(self) -> Workers:
        """The cluster as workers of one thread each."""
        return Workers(self, count=self.max_workers, threads=1)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task to the worker that is free first."""
        if kwargs:
            raise TypeError("a simulated task takes no keywords")
        self.account()
        result, seconds = self._tasks.done(fn, args)
        sending, receiving = self._tasks.pickled(fn, args, result)
        self._pickle(sending)
        self.count += 1
        self._mark = time.process_time()

        if self._first is None:
            self._first = self.now
        begin = max(heapq.heappop(self._free_at), self.now + self._latency)
        end = begin + seconds
        heapq.heappush(self._free_at, end)
        self.busy += seconds

        future: Future[Any] = Future()
        arrival = _Arrival(result=result, receiving=receiving)
        heapq.heappush(self._running, (end + self._latency, self._submitted, future, arrival))
        self._submitted += 1
        return future

    def account(self) -> None:
        """Move the clock on by the CPU time that the caller has used."""
        mark = time.process_time()
        self.now += mark - self._mark
        self.caller += mark - self._mark
        self._mark = mark

    def advance(self) -> None:
        """Move the clock on to the end of the next task, which then has its result."""
        self.account()
        if self._running:
            end, _, future, arrival = heapq.heappop(self._running)
            self.now = max(self.now, end)
            self.searching = self.now - (self._first or 0.0)
            self._pickle(arrival.receiving)
            if future.set_running_or_notify_cancel():
                future.set_result(arrival.result)
        self._mark = time.process_time()

    def _pickle(self, seconds: float) -> None:
        """Move the clock on by the time in which the caller pickles or unpickles [s]."""
        self.now += seconds
        self.caller += seconds
        self.pickling += seconds


class _SimulatedQueue:
    """Takes the place of the queue on which the scheduler waits: waiting moves the clock on."""

    def __init__(self, cluster: SimulatedCluster) -> None:
        self._cluster = cluster
        self._ended: deque[Any] = deque()

    def put(self, future: Any) -> None:
        """Add a task that has ended."""
        self._ended.append(future)

    def get(self, timeout: float | None = None) -> Any:
        """Wait for a task on the simulated clock."""
        if not self._ended:
            self._cluster.advance()
        if not self._ended:
            raise Empty
        return self._ended.popleft()


@contextmanager
def simulated(count: int, tasks: MeasuredTasks, latency: float = 0.0) -> Iterator[SimulatedCluster]:
    """Let the scheduler of mjfim work on a simulated clock.

    Args:
        count: Number of workers.
        tasks: Results and lengths of the tasks; those that are missing are carried out.
        latency: Time from the submission of a task to its begin [s], and from its end to its
            arrival.

    Yields:
        The cluster; pass its `workers` as executor. At the end its clock is that of the whole work.
    """
    cluster = SimulatedCluster(count, tasks, latency)
    with patch.object(dispatch, "SimpleQueue", lambda: _SimulatedQueue(cluster)):
        yield cluster
    cluster.account()
