"""Worker processes that see a request to stop and then return the best result that they have."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from typing import Any, TypeVar

from mjfim.budget import Budget, StopToken

T = TypeVar("T")

# Time that running tasks have to return their best result after a request to stop [s]; they ask
# between two iterates.
GRACE = 20.0

# Time between two looks at the stop token while the parent process waits for a task [s].
POLL_INTERVAL = 0.2


def cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))

    return os.cpu_count() or 1


class Pool(ProcessPoolExecutor):
    """Fresh worker processes, at most one per core, that share a request to stop.

    Only the parent process reacts to Ctrl-C; the workers continue until `stop` is called. Other
    executors of `concurrent.futures` can be used in place of a pool; their processes do not see the
    request, so that their tasks run to the end.

    Args:
        count: Number of processes; default and maximum: one per core.
    """

    def __init__(self, count: int | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._stop = context.Event()
        processes = min(count or cores(), cores())
        super().__init__(processes, context, _initialize_worker, (self._stop,))

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task, as for any executor.

        Processes that are started here ignore Ctrl-C from the beginning.
        """
        with _interrupts_blocked():
            return super().submit(fn, *args, **kwargs)

    def stop(self) -> None:
        """Ask all tasks, also later ones, to return the best result that they have."""
        self._stop.set()

    def resume(self) -> None:
        """Withdraw the request to stop; allowed when no task is running."""
        self._stop.clear()


# The token of the pool that this process works for. It is replaced when a pool starts the process.
_pool_token = StopToken()


def pool_stop_token() -> StopToken:
    """Return the token of the pool that this process works for; elsewhere a token that nobody sets."""
    return _pool_token


def workers_of(executor: Executor | None) -> int:
    """Return how many tasks an executor runs at the same time; 1 without an executor."""
    # `concurrent.futures` has no public name for this number; an executor without it counts as one.
    return 1 if executor is None else int(getattr(executor, "_max_workers", 1))


def results_in_order(
    executor: Executor, futures: Sequence[Future[T]], budget: Budget
) -> Iterator[T]:
    """Yield the results of tasks in the order of their submission, as far as the budget allows.

    Args:
        executor: Runs the tasks.
        futures: Submitted tasks.
        budget: When its time is used up, tasks that have not begun are cancelled, except the first
            one. After a request to stop, all tasks return the best result that they have.

    Yields:
        The result of every task that was not cancelled.

    Raises:
        Exception: The error of a task that failed.
    """
    waiting = list(futures)
    try:
        while waiting and not budget.stop.requested:
            # A task that has not begun by the end of the time is not worth beginning, unless it is
            # the only hope.
            is_first = len(waiting) == len(futures)
            if not is_first and budget.exhausted is not None and waiting[0].cancel():
                waiting.pop(0)
                continue

            done, _ = wait(waiting[:1], timeout=POLL_INTERVAL)
            if done:
                yield waiting.pop(0).result()

        # Asked to stop: return whatever the other tasks have found.
        stopped, waiting = waiting, []
        if stopped:
            yield from collect_finished(executor, stopped)
    finally:
        # The consumer ended early or a task failed: nothing may continue to run.
        if waiting:
            collect_finished(executor, waiting)


def collect_finished(executor: Executor, futures: Iterable[Future[T]]) -> list[T]:
    """Stop all tasks and collect what they have found.

    Args:
        executor: Runs the tasks; a `Pool` passes the request to stop on to them.
        futures: Submitted tasks; those that have not begun are cancelled.

    Returns:
        Results of the tasks that ended within the grace period without an error, in the given
        order.
    """
    waiting = list(futures)
    for future in waiting:
        future.cancel()

    if isinstance(executor, Pool):
        executor.stop()
    done, running = wait(waiting, timeout=GRACE)

    # The pool can be used again once nothing runs that might miss the request.
    if isinstance(executor, Pool) and not running:
        executor.resume()

    ended = [future for future in waiting if future in done and not future.cancelled()]
    return [future.result() for future in ended if future.exception() is None]


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C in this thread; child processes inherit that, where the system has signal masks."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return

    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _initialize_worker(stop: Event) -> None:
    """Ignore Ctrl-C in a new worker process and connect its token with the pool's event."""
    global _pool_token
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _pool_token = StopToken(also=stop.is_set)
