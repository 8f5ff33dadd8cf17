"""Pool of worker processes that can be asked to stop and to return their best result so far.

A task that cannot end in time offers its best result so far, see `offer_result`. After a worker
process was killed from outside, the pool has new processes for the tasks that follow.
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
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from threadpoolctl import threadpool_limits

from mjfim.errors import MAX_THREADS, ExperimentError
from mjfim.parallel.budget import SIGNALS, StopToken

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
    if threads is not None and not 1 <= threads <= MAX_THREADS:
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


class _BlasLimit:
    """Limit of the linear algebra libraries while at least one thread of Python asks for it.

    The limit holds for the whole process. If each thread set and restored it by itself, the one
    that ends first would lift it under the others.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._limit: threadpool_limits | None = None

    def enter(self) -> None:
        """Set the limit for the first user."""
        with self._lock:
            if not self._users:
                self._limit = threadpool_limits(1, user_api="blas")
            self._users += 1

    def leave(self) -> None:
        """Lift the limit after the last user."""
        with self._lock:
            self._users -= 1
            if not self._users and self._limit is not None:
                self._limit.restore_original_limits()
                self._limit = None


_blas_limit = _BlasLimit()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Use one thread of the linear algebra libraries; also a decorator of functions.

    Several threads divide long sums differently, so results would depend on their number. The
    matrices are small, so that more threads would not be quicker.
    """
    _blas_limit.enter()
    try:
        yield
    finally:
        _blas_limit.leave()


T = TypeVar("T")

# What the user reads after a worker process was killed.
LOST_SENTENCE = (
    "a worker process was ended from outside (killed, perhaps because the memory was full); its "
    "work was done again"
)

# Period at which a worker looks whether its offer is wanted [s].
OFFER_INTERVAL = 0.2


class Pool(Executor):
    """Worker processes, at most one per core, that share one request to stop.

    Only the parent process reacts to Ctrl-C; the workers continue until `stop` is called. If the
    parent process is killed, its workers end by themselves. After a worker process was ended from
    outside, its tasks and those of the other workers fail with `BrokenExecutor`, and new processes
    are started for the next task.

    Another executor of `concurrent.futures` can be used instead of a pool, see `Workers`.

    Args:
        count: Number of processes; the default and the maximum are one per core.

    Attributes:
        max_workers: Number of processes.
        has_lost_worker: True after a worker process was ended from outside.
    """

    def __init__(self, count: int | None = None) -> None:
        self.max_workers = process_count(count)
        self.has_lost_worker = False

        # Tasks that cannot end in time send their results so far to this address, at which somebody
        # listens after a request to stop only.
        name = f"mjfim-{uuid.uuid4().hex}"
        self._address = str(Path(tempfile.gettempdir()) / name)
        if sys.platform == "win32":
            self._address = rf"\\.\pipe\{name}"
        self._listener: connection.Listener | None = None
        self._offers: dict[int, Any] = {}
        self._next_number = itertools.count()
        self._numbers: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()
        self._lock = threading.Lock()
        self._start()

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; the arguments are those of `concurrent.futures.Executor.submit`.

        Where a worker process was ended from outside, new processes are started for the task.
        """
        if self._hold.closed:
            self._start()
        number = next(self._next_number)
        words = (number, fn, *args)
        with _starting_processes():
            try:
                future = self._processes.submit(run_task, *words, **kwargs)
            except BrokenExecutor:
                self.has_lost_worker = True
                self.end_running()
                self._start()
                future = self._processes.submit(run_task, *words, **kwargs)
        self._numbers[future] = number
        future.add_done_callback(partial(self._end_if_broken, self._hold))
        return future

    def stop(self) -> None:
        """Ask all running and later tasks to return their best result so far."""
        if self._listener is None:
            # Only processes that have the key of this process are heard.
            key = multiprocessing.current_process().authkey
            with suppress(OSError):
                self._listener = connection.Listener(self._address, authkey=key)
                _in_background(self._listen, self._listener)
        self._stop.value = True

    def resume(self) -> None:
        """Withdraw the request to stop. No task may be running."""
        self._stop.value = False
        self._close_listener()

    def end_running(self, *, wait: bool = False) -> None:
        """End the processes at once with their tasks; the next task starts new processes.

        Args:
            wait: Return after they have ended.
        """
        self._release(self._hold)
        self._processes.shutdown(wait=wait, cancel_futures=True)
        self._close_listener()

    def offered(self, future: Future[T]) -> list[T]:
        """Read what a running task has offered as its best result so far after `stop`.

        Returns:
            The result, or nothing where the task has offered none.
        """
        number = self._numbers[future]
        return [self._offers[number]] if number in self._offers else []

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; the arguments are those of `concurrent.futures.Executor.shutdown`."""
        self._processes.shutdown(wait, cancel_futures=cancel_futures)
        self._close_listener()

    def _listen(self, listener: connection.Listener) -> None:
        """Collect what workers offer, until the listener is closed."""
        while self._listener is listener:
            # A worker that is killed while it connects ends its own connection only.
            with suppress(OSError, EOFError, multiprocessing.AuthenticationError):
                _in_background(_receive, listener.accept(), self._offers)

    def _close_listener(self) -> None:
        """Hear no more offers."""
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()

    def _start(self) -> None:
        """Prepare new processes, which are started by their first tasks."""
        context = multiprocessing.get_context("spawn")

        # The request to stop has no lock: a process that is killed while it holds a lock would
        # block all others.
        self._stop = context.RawValue(ctypes.c_bool, False)

        # The workers end when nobody holds the writing end of this pipe any more.
        lifeline, self._hold = context.Pipe(duplex=False)
        with _starting_processes():
            self._processes = ProcessPoolExecutor(
                self.max_workers, context, initialize_worker, (self._stop, lifeline, self._address)
            )

    def _end_if_broken(self, hold: connection.Connection, future: Future[Any]) -> None:
        """End the other processes at once after one of them was ended from outside."""
        if not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
            self.has_lost_worker |= not hold.closed
            self._release(hold)

    def _release(self, hold: connection.Connection) -> None:
        """Close the end of the pipe on which the workers wait; several threads ask for it."""
        with self._lock:
            hold.close()


@contextmanager
def _starting_processes() -> Iterator[None]:
    """Start processes that do not hear the signals of their parent, and import nothing from here.

    Otherwise they would take a file `signal.py` or `socket.py` in the current folder for the
    module of this name.
    """
    with ExitStack() as restored:
        if hasattr(signal, "pthread_sigmask"):
            before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            restored.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        if "PYTHONSAFEPATH" not in os.environ:
            os.environ["PYTHONSAFEPATH"] = "1"
            restored.callback(os.environ.pop, "PYTHONSAFEPATH", None)
        yield


def _receive(heard: connection.Connection, offers: dict[int, Any]) -> None:
    """Receive one offer; a worker that is killed meanwhile offers nothing."""
    with suppress(OSError, EOFError), heard:
        number, result = heard.recv()
        offers[number] = result


def _in_background(function: Callable[..., None], *arguments: object) -> None:
    """Run a function in a thread that does not keep the process alive."""
    threading.Thread(target=function, args=arguments, daemon=True).start()


# ---- in a worker process

# Stop token of the pool to which this process belongs. In a worker process, `initialize_worker`
# replaces it.
_pool_token = StopToken()

# Number of the task that this worker process runs, None between tasks and in other processes; and
# the last offer of a result, with the number of its task.
_task: int | None = None
_offer: tuple[int, object] | None = None


def pool_stop_token() -> StopToken:
    """Return the stop token of the pool to which this process belongs; never set in others."""
    return _pool_token


def offer_result(result: object) -> None:
    """Offer the best result so far of the running task.

    It is the result if the task does not end in time after a request to stop. Outside of a worker
    process of a pool, this does nothing.
    """
    global _offer
    if _task is not None:
        _offer = (_task, result)


def run_task(number: int, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Run a task in a worker process."""
    global _task, _offer
    _task = number
    try:
        return function(*args, **kwargs)
    finally:
        _task = _offer = None


def initialize_worker(stop: ctypes.c_bool, lifeline: connection.Connection, address: str) -> None:
    """Prepare a new worker process: it stops and ends with its pool alone."""
    global _pool_token
    _pool_token = StopToken(also=lambda: stop.value)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)

    # `timeout` and cluster managers send it to all processes; a running task hands over its result.
    signal.signal(signal.SIGTERM, lambda number, frame: None if _task is not None else os._exit(1))
    _in_background(_end_with_parent, lifeline)
    _in_background(_hand_over, address)

    # The parent process blocked the signals while it started this process.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def _hand_over(address: str) -> None:
    """Send what the running task has offered, whenever a stop is requested."""
    sent = None
    key = multiprocessing.current_process().authkey
    while True:
        time.sleep(OFFER_INTERVAL)
        offer = _offer
        if not _pool_token.requested or offer is None or offer is sent:
            continue
        # Nobody listens any more where the parent process has what it needs.
        with suppress(OSError, EOFError), connection.Client(address, authkey=key) as parent:
            parent.send(offer)
        sent = offer


def _end_with_parent(lifeline: connection.Connection) -> None:
    """Wait until the parent process or its pool is gone, then end this process at once."""
    parent = multiprocessing.parent_process()
    sentinels = [] if parent is None else [parent.sentinel]
    connection.wait([lifeline, *sentinels])
    os._exit(1)
