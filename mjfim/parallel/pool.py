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
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import connection
from pathlib import Path
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

from mjfim.interruption import SIGNALS
from mjfim.parallel.threads import process_count
from mjfim.parallel.worker_process import initialize_worker, run_in_background, run_task

T = TypeVar("T")

# What the user reads after a worker process was killed.
LOST_SENTENCE = (
    "a worker process was ended from outside (killed, perhaps because the memory was full); its "
    "work was done again"
)


class _Processes(ProcessPoolExecutor):
    """Worker processes that are started together, and end together when one of them is killed.

    Args:
        count: Number of processes.
        address: Address to which the processes send their results so far after a request to stop.
    """

    def __init__(self, count: int, address: str) -> None:
        context = multiprocessing.get_context("spawn")

        # The request to stop has no lock: a process that is killed while it holds a lock would
        # block all others.
        self.stop = context.RawValue(ctypes.c_bool, False)

        # The workers end when nobody holds the writing end of this pipe any more.
        lifeline, hold = context.Pipe(duplex=False)
        self._hold: connection.Connection | None = hold
        self._lock = threading.Lock()
        with _safe_path():
            super().__init__(count, context, initialize_worker, (self.stop, lifeline, address))

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; a process that is started for it ignores Ctrl-C from the beginning."""
        with _interrupts_blocked(), _safe_path():
            future = super().submit(fn, *args, **kwargs)
        future.add_done_callback(self._end_if_broken)
        return future

    def end(self, *, wait: bool = False) -> None:
        """End the processes at once, whether or not their tasks have ended.

        Args:
            wait: Return after they have ended.
        """
        self._release()
        self.shutdown(wait=wait, cancel_futures=True)

    def _end_if_broken(self, future: Future[Any]) -> None:
        """End the other processes at once after one of them was ended from outside."""
        if not future.cancelled() and isinstance(future.exception(), BrokenExecutor):
            self._release()

    def _release(self) -> None:
        """Close the end of the pipe on which the workers wait, once: several threads ask for it."""
        with self._lock:
            hold, self._hold = self._hold, None
        if hold is not None:
            hold.close()


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
        self._address = _private_address()
        self._listener: connection.Listener | None = None
        self._offers: dict[int, Any] = {}
        self._next_number = itertools.count()
        self._numbers: WeakKeyDictionary[Future[Any], int] = WeakKeyDictionary()

        self._processes = _Processes(self.max_workers, self._address)
        self._has_ended = False

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; the arguments are those of `concurrent.futures.Executor.submit`.

        Where a worker process was ended from outside, new processes are started for the task.
        """
        if self._has_ended:
            self._start_anew()

        number = next(self._next_number)
        try:
            future = self._processes.submit(run_task, number, fn, *args, **kwargs)
        except BrokenExecutor:
            self.has_lost_worker = True
            self._processes.end()
            self._start_anew()
            future = self._processes.submit(run_task, number, fn, *args, **kwargs)

        self._numbers[future] = number
        return future

    def stop(self) -> None:
        """Ask all running and later tasks to return their best result so far."""
        if self._listener is None:
            # Only processes that have the key of this process are heard.
            key = multiprocessing.current_process().authkey
            with suppress(OSError):
                self._listener = connection.Listener(self._address, authkey=key)
                run_in_background(self._listen, self._listener)
        self._processes.stop.value = True

    def resume(self) -> None:
        """Withdraw the request to stop. No task may be running."""
        self._processes.stop.value = False
        self._close_listener()

    def end_running(self, *, wait: bool = False) -> None:
        """End the processes at once with their tasks; the next task starts new processes.

        Args:
            wait: Return after they have ended. A program that ends at once has to wait: Python's
                own end of a program may otherwise print an error (a write to a closed pipe).
        """
        self._processes.end(wait=wait)
        self._has_ended = True
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

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers; the arguments are those of `concurrent.futures.Executor.shutdown`."""
        self._processes.shutdown(wait, cancel_futures=cancel_futures)
        self._close_listener()

    def _start_anew(self) -> None:
        """Start new processes in place of those that have ended."""
        self._processes = _Processes(self.max_workers, self._address)
        self._has_ended = False

    def _listen(self, listener: connection.Listener) -> None:
        """Collect what workers offer, until the listener is closed."""
        while self._listener is listener:
            # A worker that is killed while it connects ends its own connection only.
            with suppress(OSError, EOFError, multiprocessing.AuthenticationError):
                run_in_background(_receive, listener.accept(), self._offers)

    def _close_listener(self) -> None:
        """Hear no more offers."""
        listener, self._listener = self._listener, None
        if listener is not None:
            listener.close()


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
