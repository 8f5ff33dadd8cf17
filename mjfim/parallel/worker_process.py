"""Duties of a process of a `Pool` beside its tasks: it follows the pool, and offers its results."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import connection
from queue import SimpleQueue
from typing import Any, TypeVar

from mjfim.budget import StopToken

T = TypeVar("T")

# Time after a signal to terminate at which a worker ends, whether or not its task has ended [s]. It
# is twice the time for which the parent process waits.
TERMINATION_SECONDS = 8.0

# Period at which a worker looks whether its offer is wanted [s].
OFFER_INTERVAL = 0.2

# Stop token of the pool to which this process belongs. In a worker process, `initialize_worker`
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


def run_task(number: int, function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    """Run a task in a worker process.

    Args:
        number: Number of the task, under which its offers are sent.
        function: The task.
        *args: Its arguments.
        **kwargs: Its named arguments.

    Returns:
        The result of the task.
    """
    global _task, _offer
    _task = number
    try:
        return function(*args, **kwargs)
    finally:
        _task = _offer = None


def initialize_worker(stop: ctypes.c_bool, lifeline: connection.Connection, address: str) -> None:
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

    run_in_background(_end_with_parent, lifeline)
    run_in_background(_hand_over, stop, address)
    _delay_termination()


def run_in_background(function: Callable[..., None], *arguments: object) -> None:
    """Run a function in a thread that does not keep the process alive.

    Args:
        function: The function.
        *arguments: Its arguments.
    """
    threading.Thread(target=function, args=arguments, name="mjfim-watch", daemon=True).start()


def _hand_over(stop: ctypes.c_bool, address: str) -> None:
    """Send what the running task has offered, whenever a stop is requested."""
    sent: tuple[int, object] | None = None
    key = multiprocessing.current_process().authkey
    while True:
        time.sleep(OFFER_INTERVAL)
        offer = _offer
        if not stop.value or offer is None or offer is sent:
            continue

        # Nobody listens any more where the parent process has what it needs.
        with suppress(OSError, EOFError), connection.Client(address, authkey=key) as parent:
            parent.send(offer)
        sent = offer


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

    run_in_background(end_later)
    signal.signal(signal.SIGTERM, lambda number, frame: received.put(number))

    # The parent process blocked the signals while it started this process.
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
