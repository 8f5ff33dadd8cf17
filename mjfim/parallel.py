"""Processes that search side by side and can be told to stop: what they have found by then is not lost."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


T = TypeVar("T")
GRACE = 20.0  # [s] that tasks get to return what they have: they look between iterates
_STOP: list[Any] = []  # a worker's view of its pool's signal


class Pool(ProcessPoolExecutor):
    """Fresh processes, one per core or fewer. Ctrl-C is the parent's to answer: workers go on until they are told to stop.

    Other executors serve as well; their tasks run to their end where nothing interrupts them.
    """

    def __init__(self, count: int | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._stop = context.Event()
        super().__init__(min(count or cores(), cores()), context, _begin, (self._stop,))

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """As of any executor. Processes that it starts do not see Ctrl-C, from their first moment on."""
        with _deaf():
            return super().submit(fn, *args, **kwargs)

    def stop(self) -> None:
        """Tell all tasks, also those to come, to return what they have."""
        self._stop.set()

    def resume(self) -> None:
        """Take it back, once nothing runs any more."""
        self._stop.clear()


def workers_of(executor: Executor | None) -> int:
    """How many tasks an executor runs at once; 1 without."""
    return 1 if executor is None else int(getattr(executor, "_max_workers", 1))


def stopped() -> bool:
    """Whether the pool that runs this process was told to stop; False elsewhere."""
    return bool(_STOP and _STOP[0].is_set())


def collect_finished(executor: Executor, futures: Iterable[Future[T]]) -> list[T]:
    """Stop what an executor still runs, and return what its futures, in their order, have found within the grace."""
    waiting = list(futures)
    for future in waiting:
        future.cancel()
    if isinstance(executor, Pool):
        executor.stop()
    done, left = wait(waiting, timeout=GRACE)
    if isinstance(executor, Pool) and not left:
        executor.resume()
    return [
        f.result() for f in waiting if f in done and not f.cancelled() and f.exception() is None
    ]


@contextmanager
def _deaf() -> Iterator[None]:
    """Ctrl-C waits; what is started meanwhile inherits that, where the system has such masks."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin(stop: Any) -> None:
    """A worker's first act."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _STOP[:] = [stop]
