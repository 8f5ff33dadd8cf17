"""Pool of worker processes that can be asked to stop and to return their best result so far."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import connection
from multiprocessing.synchronize import Event
from queue import SimpleQueue
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from mjfim.budget import Budget, StopToken
from mjfim.errors import ExperimentError
from mjfim.interruption import SIGNALS, hurried

T = TypeVar("T")

# Time for which the parent process waits for running tasks after a request to stop [s]. The tasks
# check the request after each iterate. A second Ctrl-C ends the waiting.
GRACE = 4.0

# Time after a signal to terminate at which a worker ends, whether or not its task has ended [s].
TERMINATION_SECONDS = 2.0 * GRACE

# Period at which the parent process checks its stop token while it waits for a task [s].
POLL_INTERVAL = 0.2

# Largest number of threads that can be asked for; more would only use memory.
MAX_THREADS = 1024


def cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))

    return os.cpu_count() or 1


def require_threads(threads: int | None) -> None:
    """Refuse a number of threads that is not positive, or so large that it only uses memory.

    Args:
        threads: Threads that the user asks for; None for one per core.

    Raises:
        ExperimentError: The number cannot be used.
    """
    if threads is not None and not 1 <= threads <= MAX_THREADS:
        raise ExperimentError(
            f"threads: {threads} is not possible; it must be a whole number from 1 to "
            f"{MAX_THREADS}, or None for one thread per core"
        )


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Use one thread of the linear algebra libraries; also a decorator of functions.

    Several threads divide long sums differently, so results would depend on their number. The
    matrices are small, so that more threads would not be quicker.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


class Pool(ProcessPoolExecutor):
    """Worker processes, at most one per core, that share one request to stop.

    Only the parent process reacts to Ctrl-C; the workers continue until `stop` is called. If the
    parent process is killed, its workers end by themselves.

    Another executor of `concurrent.futures` can be used instead of a pool. Its processes do not
    receive the request to stop, so their tasks run to the end.

    Args:
        count: Number of processes; the default and the maximum are one per core.

    Attributes:
        is_abandoned: True if tasks are not waited for when the pool is shut down.
    """

    def __init__(self, count: int | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        with _safe_path():
            self._stop = context.Event()
        processes = min(count or cores(), cores())

        # The workers end when nobody holds the writing end of this pipe any more.
        lifeline, self._hold = context.Pipe(duplex=False)
        self.is_abandoned = False
        super().__init__(processes, context, _initialize_worker, (self._stop, lifeline))

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; the arguments are those of `concurrent.futures.Executor.submit`.

        A process that is started for the task ignores Ctrl-C from the beginning.
        """
        with _interrupts_blocked(), _safe_path():
            return super().submit(fn, *args, **kwargs)

    def stop(self) -> None:
        """Ask all running and later tasks to return their best result so far."""
        self._stop.set()

    def resume(self) -> None:
        """Withdraw the request to stop. No task may be running."""
        self._stop.clear()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; the arguments are those of `concurrent.futures.Executor.shutdown`.

        The workers of an abandoned pool are ended at once, whether or not their tasks have ended.
        """
        if self.is_abandoned:
            self._hold.close()
        super().shutdown(wait, cancel_futures=cancel_futures)


# Stop token of the pool to which this process belongs. In a worker process, `_initialize_worker`
# replaces it.
_pool_token = StopToken()


def pool_stop_token() -> StopToken:
    """Return the stop token of the pool to which this process belongs.

    Returns:
        The token; in a process that does not belong to a pool, a token that is never set.
    """
    return _pool_token


def workers_of(executor: Executor | None) -> int:
    """Return the number of tasks that an executor runs in parallel; 1 without an executor."""
    # `concurrent.futures` has no public name for this number; an executor without it counts as one.
    return 1 if executor is None else int(getattr(executor, "_max_workers", 1))


def results_in_order(
    executor: Executor, futures: Sequence[Future[T]], budget: Budget
) -> Iterator[T]:
    """Yield the results of tasks in the order of their submission, within a budget.

    Args:
        executor: Executor that runs the tasks.
        futures: Submitted tasks.
        budget: When it is exhausted, tasks that have not begun are cancelled, except the first
            one. After a request to stop, all running tasks return their best result so far.

    Yields:
        The result of every task that was not cancelled.

    Raises:
        Exception: The error of a task that failed.
    """
    waiting = list(futures)
    try:
        while waiting and not budget.stop.requested:
            # When the budget is exhausted, a task that has not begun is cancelled. The first task
            # is kept, because without it there might be no result at all.
            is_first = len(waiting) == len(futures)
            if not is_first and budget.exhausted is not None and waiting[0].cancel():
                waiting.pop(0)
                continue

            done, _ = wait(waiting[:1], timeout=POLL_INTERVAL)
            if done:
                yield waiting.pop(0).result()

        # After a request to stop, the remaining tasks return their best results so far.
        stopped = waiting
        waiting = []
        if stopped:
            yield from collect_finished(executor, stopped)
    finally:
        # If the caller ended the iteration or a task failed, the other tasks are stopped.
        if waiting:
            collect_finished(executor, waiting)


def collect_finished(executor: Executor, futures: Iterable[Future[T]]) -> list[T]:
    """Stop all tasks and collect their results so far.

    Args:
        executor: Executor that runs the tasks; a `Pool` asks them to stop.
        futures: Submitted tasks; those that have not begun are cancelled.

    Returns:
        Results of the tasks that ended without an error within `GRACE` seconds, in the given order.
    """
    waiting = list(futures)
    for future in waiting:
        future.cancel()

    if isinstance(executor, Pool):
        executor.stop()
    done, running = _wait_for_all(waiting)

    # The request is withdrawn, so that the pool can be used again, unless a task is still running.
    # Such a task does not look at the request, so nobody waits for it any longer.
    if isinstance(executor, Pool):
        if running:
            executor.is_abandoned = True
        else:
            executor.resume()

    ended = [future for future in waiting if future in done and not future.cancelled()]
    return [future.result() for future in ended if future.exception() is None]


def _wait_for_all(futures: Sequence[Future[T]]) -> tuple[set[Future[T]], set[Future[T]]]:
    """Wait for tasks until `GRACE` is over, or until the user presses Ctrl-C a second time.

    Returns:
        The tasks that have ended, and those that have not.
    """
    deadline = time.monotonic() + GRACE
    done, running = wait(futures, timeout=0.0)
    while running and time.monotonic() < deadline and not hurried():
        done, running = wait(futures, timeout=min(POLL_INTERVAL, GRACE))

    return done, running


@contextmanager
def _safe_path() -> Iterator[None]:
    """Let Python processes that are started here import nothing from the current folder.

    Otherwise they would take a file `signal.py` or `socket.py` there for the module of this name.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
        else:
            os.environ["PYTHONSAFEPATH"] = before


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C and SIGTERM in this thread, and thereby in processes that it starts.

    Without signal masks, as on Windows, this has no effect.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return

    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _initialize_worker(stop: Event, lifeline: connection.Connection) -> None:
    """Prepare a new worker process.

    It ignores Ctrl-C, its token follows the pool's event, and it ends with its parent process.

    Args:
        stop: The pool's event.
        lifeline: Connection that ends when the pool gives up its workers.
    """
    global _pool_token
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _pool_token = StopToken(also=stop.is_set)

    _run_in_background(_end_with_parent, lifeline)
    _delay_termination()


def _run_in_background(function: Callable[..., None], *arguments: object) -> None:
    """Run a function in a thread that does not keep the process alive."""
    threading.Thread(target=function, args=arguments, name="mjfim-watch", daemon=True).start()


def _end_with_parent(lifeline: connection.Connection) -> None:
    """Wait until the parent process or its pool is gone, then end this process at once.

    A worker waits for tasks from a queue whose other end it holds itself, so the queue does not
    tell it that the parent process was killed.
    """
    parent = multiprocessing.parent_process()
    sentinels = [] if parent is None else [parent.sentinel]
    connection.wait([lifeline, *sentinels])
    os._exit(1)


def _delay_termination() -> None:
    """End this process some time after SIGTERM instead of at once.

    SIGTERM is often sent to all processes of a program. The parent process then asks the tasks for
    their best results so far, which they can only return while their process lives.
    """
    received: SimpleQueue[int] = SimpleQueue()

    def end_later() -> None:
        """Wait for the signal, and then for the task."""
        received.get()
        time.sleep(TERMINATION_SECONDS)
        os._exit(1)

    _run_in_background(end_later)
    signal.signal(signal.SIGTERM, lambda number, frame: received.put(number))

    # The parent process blocked the signals while it started this process.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
