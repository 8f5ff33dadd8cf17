"""Processors that this process may use, and threads of the linear algebra libraries."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

from mjfim.errors import MAX_THREADS, ExperimentError

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
