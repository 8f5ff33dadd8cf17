"""Executors for tests: of several kinds, and such that lose tasks."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from typing import Any

import pytest

import mjfim

# Kinds of processes on which a verb must give the result of one process.
KINDS = ("pool", "loky", "dask")


class LosingThreads(ThreadPoolExecutor):
    """Threads that lose every second task, as if a worker had been killed."""

    def __init__(self) -> None:
        super().__init__(2)
        self.submitted = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.submitted += 1
        if self.submitted % 2:
            return super().submit(fn, *args, **kwargs)

        lost: Future[Any] = Future()
        lost.set_exception(BrokenExecutor("killed"))
        return lost


def processes(kind: str) -> AbstractContextManager[Any]:
    """Two worker processes of a kind; the test is skipped where its package is missing."""
    if kind == "pool":
        return mjfim.Pool(2)
    if kind == "loky":
        executor: AbstractContextManager[Any] = pytest.importorskip("loky").ProcessPoolExecutor(2)
        return executor

    client: AbstractContextManager[Any] = pytest.importorskip("distributed").Client(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", set_as_default=False
    )
    return client
