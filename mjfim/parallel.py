"""Pool of worker processes that can be asked to stop and to return their best result so far.

A task that cannot end in time offers its best result so far, see `offer_result`. A worker process
that is killed from outside loses nothing but time: its tasks are done again in the parent process.
"""

from __future__ import annotations

import ctypes
import itertools
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, suppress
from multiprocessing import connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from threadpoolctl import threadpool_limits

from mjfim.amounts import MAX_THREADS
from mjfim.budget import Budget, StopToken
from mjfim.errors import ExperimentError
from mjfim.interruption import SIGNALS, hurried

T = TypeVar("T")
Order = TypeVar("Order")

# Time for which the parent process waits for running tasks after a request to stop [s]. The tasks
# check the request after each iterate. A second Ctrl-C ends the waiting.
GRACE = 4.0

# Time after a signal to terminate at which a worker ends, whether or not its task has ended [s].
TERMINATION_SECONDS = 2.0 * GRACE

# Period at which the parent process checks its stop token while it waits for a task [s].
POLL_INTERVAL = 0.2

# What the user reads after a worker process was killed.
LOST_SENTENCE = (
    "a worker process was ended from outside (killed, perhaps because the memory was full); its "
    "work was done again without worker processes"
)

# Largest number of processes of a pool on Windows, beyond which Python refuses it.
MAX_WINDOWS_PROCESSES = 61


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
    is_whole = hasattr(threads, "__index__") and not isinstance(threads, bool)
    if threads is not None and not (is_whole and 1 <= threads <= MAX_THREADS):
        raise ExperimentError(
            f"threads: {threads} is not possible; it must be a whole number from 1 to "
            f"{MAX_THREADS}, or None for one thread per core"
        )


def process_count(wanted: int | None) -> int:
    """Return the number of worker processes of a pool.

    Args:
        wanted: Number that the user asks for; None for one per core.

    Returns:
        At most one per core, and on Windows at most the number that a pool can wait for.
    """
    largest = min(cores(), MAX_WINDOWS_PROCESSES) if sys.platform == "win32" else cores()
    return min(wanted or largest, largest)


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
        has_lost_worker: True after a worker process was ended from outside, which ends the others,
            too.
    """

    def __init__(self, count: int | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        processes = process_count(count)

        # The request to stop has no lock: a process that is killed while it holds a lock would
        # block all others.
        self._stop = context.RawValue(ctypes.c_bool, False)

        # Tasks that cannot end in time send their results so far to this address, at which somebody
        # listens after a request to stop only.
        self._address = _private_address()
        self._listener: connection.Listener | None = None
        self._offers: dict[int, Any] = {}
        self._next_number = itertools.count()
        self._numbers: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

        # The workers end when nobody holds the writing end of this pipe any more.
        lifeline, self._hold = context.Pipe(duplex=False)
        self.is_abandoned = False
        self.has_lost_worker = False
        arguments = (self._stop, lifeline, self._address)
        with _safe_path():
            super().__init__(processes, context, _initialize_worker, arguments)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; the arguments are those of `concurrent.futures.Executor.submit`.

        A process that is started for the task ignores Ctrl-C from the beginning.
        """
        number = next(self._next_number)
        with _interrupts_blocked(), _safe_path():
            future = super().submit(_run_task, number, fn, *args, **kwargs)
        self._numbers[future] = number
        return future

    def stop(self) -> None:
        """Ask all running and later tasks to return their best result so far."""
        if self._listener is None:
            # Only processes that have the key of this process are heard.
            key = multiprocessing.current_process().authkey
            with suppress(OSError):
                self._listener = connection.Listener(self._address, authkey=key)
                _run_in_background(self._listen, self._listener)
        self._stop.value = True

    def resume(self) -> None:
        """Withdraw the request to stop. No task may be running."""
        self._stop.value = False
        self._close_listener()

    def offered(self, future: Future[T]) -> list[T]:
        """Read what a running task has offered as its best result so far after `stop`.

        Args:
            future: The task.

        Returns:
            The result; empty where the task has none yet.
        """
        number = self._numbers.get(future)
        return [] if number not in self._offers else [self._offers[number]]

    def _listen(self, listener: connection.Listener) -> None:
        """Collect what workers offer, until the listener is closed."""
        while self._listener is listener:
            # A worker that is killed while it connects ends its own connection only.
            with suppress(OSError, EOFError, multiprocessing.AuthenticationError):
                _run_in_background(_receive, listener.accept(), self._offers)

    def _close_listener(self) -> None:
        """Hear no more offers."""
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()

    def give_up(self) -> None:
        """End the workers after one of them was ended from outside."""
        self.has_lost_worker = True
        self.is_abandoned = True
        self._hold.close()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; the arguments are those of `concurrent.futures.Executor.shutdown`.

        The workers of an abandoned pool are ended at once, whether or not their tasks have ended.
        """
        if self.is_abandoned:
            self._hold.close()
        super().shutdown(wait, cancel_futures=cancel_futures)
        self._close_listener()


# Stop token of the pool to which this process belongs. In a worker process, `_initialize_worker`
# replaces it.
_pool_token = StopToken()

# Number of the task that this worker process runs, None between tasks and in other processes; and
# the last offer of a result, with the number of its task.
_task: int | None = None
_offer: tuple[int, object] | None = None


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


def offer_result(result: object) -> None:
    """Offer the best result so far of the running task.

    After a request to stop, it counts as the result of the task if the task does not end in time,
    as where a single iterate takes long. Outside a pool's worker process this has no effect.

    Args:
        result: A result as the task returns it; it can be pickled, and is not changed later.
    """
    global _offer
    if _task is not None:
        _offer = (_task, result)


def run_in_order(
    executor: Executor,
    function: Callable[[Order], T],
    orders: Sequence[Order],
    budget: Budget,
    here: Callable[[Order], T],
) -> Iterator[T]:
    """Carry out orders in the processes of an executor, within a budget.

    If a worker process is ended from outside, the orders that have no result are carried out in
    this process.

    Args:
        executor: Executor that runs the tasks.
        function: Carries out an order in a worker process; it can be pickled.
        orders: The orders.
        budget: As for `results_in_order`.
        here: Carries out an order in this process, and stops at the request of the budget's token.

    Yields:
        The result of every order that was not cancelled, in the given order.

    Raises:
        Exception: The error of a task that failed.
    """
    futures = [_submitted(executor, function, order) for order in orders]
    yield from results_in_order(executor, futures, budget, lambda index: here(orders[index]))


def _submitted(executor: Executor, function: Callable[[Order], T], order: Order) -> Future[T]:
    """Submit a task; in an executor whose processes have ended, it has failed at once."""
    try:
        return executor.submit(function, order)
    except BrokenExecutor as error:
        future: Future[T] = Future()
        future.set_exception(error)
        return future


def results_in_order(
    executor: Executor,
    futures: Sequence[Future[T]],
    budget: Budget,
    again: Callable[[int], T] | None = None,
) -> Iterator[T]:
    """Yield the results of tasks in the order of their submission, within a budget.

    Args:
        executor: Executor that runs the tasks.
        futures: Submitted tasks.
        budget: When it is exhausted, tasks that have not begun are cancelled, except the first
            one. After a request to stop, all running tasks return their best result so far.
        again: Does a task again in this process, by its index, where its process was ended from
            outside; None if that is an error.

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
            is_over = not is_first and budget.exhausted is not None
            if is_over and (waiting[0].cancel() or _is_lost(waiting[0])):
                waiting.pop(0)
                continue

            done, _ = wait(waiting[:1], timeout=POLL_INTERVAL)
            if done and again is not None and _is_lost(waiting[0]):
                if isinstance(executor, Pool):
                    executor.give_up()
                index = len(futures) - len(waiting)
                waiting.pop(0)
                yield again(index)
            elif done:
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


def _is_lost(future: Future[T]) -> bool:
    """Return whether a task failed because a worker process was ended from outside."""
    return future.done() and isinstance(future.exception(), BrokenExecutor)


def collect_finished(executor: Executor, futures: Iterable[Future[T]]) -> list[T]:
    """Stop all tasks and collect their results so far.

    Args:
        executor: Executor that runs the tasks; a `Pool` asks them to stop.
        futures: Submitted tasks; those that have not begun are cancelled.

    Returns:
        Results of the tasks that ended without an error within `GRACE` seconds, and what the others
        have offered until then, in the given order.
    """
    waiting = list(futures)
    for future in waiting:
        future.cancel()

    if isinstance(executor, Pool):
        executor.stop()
    _, running = _wait_for_all(waiting)

    found: list[T] = []
    for future in waiting:
        if future in running:
            found += executor.offered(future) if isinstance(executor, Pool) else []
        elif not future.cancelled() and future.exception() is None:
            found.append(future.result())

    # The request is withdrawn, so that the pool can be used again, unless a task is still running.
    # Such a task does not look at the request, so nobody waits for it any longer.
    if isinstance(executor, Pool):
        if running:
            executor.is_abandoned = True
        else:
            executor.resume()
    return found


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


def _run_task(number: int, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Run a task in a worker process."""
    global _task, _offer
    _task = number
    try:
        return function(*args, **kwargs)
    finally:
        _task = _offer = None


def _initialize_worker(stop: ctypes.c_bool, lifeline: connection.Connection, address: str) -> None:
    """Prepare a new worker process.

    It ignores Ctrl-C, its token follows that of the pool, and it ends with its parent process.

    Args:
        stop: The request to stop, in memory that all processes of the pool share.
        lifeline: Connection that ends when the pool gives up its workers.
        address: Where results so far are heard.
    """
    global _pool_token
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _pool_token = StopToken(also=lambda: stop.value)

    _run_in_background(_end_with_parent, lifeline)
    _run_in_background(_hand_over, stop, address)
    _delay_termination()


def _private_address() -> str:
    """Return an unused address for processes of this computer."""
    name = f"mjfim-{uuid.uuid4().hex}"
    return (
        rf"\\.\pipe\{name}" if sys.platform == "win32" else str(Path(tempfile.gettempdir()) / name)
    )


def _receive(heard: connection.Connection, offers: dict[int, Any]) -> None:
    """Receive one offer; a worker that is killed meanwhile offers nothing."""
    with suppress(OSError, EOFError), heard:
        number, result = heard.recv()
        offers[number] = result


def _hand_over(stop: ctypes.c_bool, address: str) -> None:
    """Send what the running task has offered, whenever a stop is requested."""
    sent: tuple[int, object] | None = None
    key = multiprocessing.current_process().authkey
    while True:
        time.sleep(POLL_INTERVAL)
        offer = _offer
        if not stop.value or offer is None or offer is sent:
            continue

        # Nobody listens any more where the parent process has what it needs.
        with suppress(OSError, EOFError), connection.Client(address, authkey=key) as parent:
            parent.send(offer)
        sent = offer


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
