"""Tasks that are lost with their worker, and executors that replace broken ones."""

from __future__ import annotations

import sys
from concurrent.futures import BrokenExecutor, CancelledError, Executor, ProcessPoolExecutor
from typing import Any

# Errors of other packages with which a task fails whose worker has gone, by module and name. Only
# the names are needed, so that these packages need not be installed.
LOSSES_BY_NAME = frozenset(
    {
        ("distributed.scheduler", "KilledWorker"),
        ("distributed.comm.core", "CommClosedError"),
        ("ray.exceptions", "WorkerCrashedError"),
        ("ray.exceptions", "NodeDiedError"),
    }
)

# Words in the messages of other errors with which pickle refuses a function.
PICKLE_WORDS = ("pickle", "local object")


def is_loss(error: BaseException | None) -> bool:
    """Check whether a task failed because its worker has gone, so that it can be done again.

    A terminal sends Ctrl-C to the workers as well, and those of other executors than `Pool` do not
    ignore it. Their tasks are lost; the caller decides by its own token whether the work goes on.

    Args:
        error: Error of the task; None where it has none.
    """
    if isinstance(error, BrokenExecutor | CancelledError | KeyboardInterrupt):
        return True

    kinds = type(error).__mro__
    return any((kind.__module__, kind.__name__) in LOSSES_BY_NAME for kind in kinds)


def is_shared_loss(error: BaseException | None) -> bool:
    """Check whether all tasks of an executor are lost together, whichever of them was the cause.

    Args:
        error: Error of a task that is lost.
    """
    return isinstance(error, BrokenExecutor)


def is_refused_by_pickle(error: BaseException | None) -> bool:
    """Check whether a task could not be sent to a worker.

    Args:
        error: Error of the task; None where it has none.
    """
    if type(error).__name__ == "PicklingError":
        return True

    is_candidate = isinstance(error, AttributeError | TypeError)
    return is_candidate and any(word in str(error).lower() for word in PICKLE_WORDS)


def renewed(executor: Any) -> Executor | None:
    """Make an executor in place of one whose processes have ended.

    Args:
        executor: The broken executor: a `ProcessPoolExecutor`, or one of loky.

    Returns:
        A new executor with the same settings; None for other kinds, which only their owner can
        make anew.
    """
    kind = type(executor)
    if kind is ProcessPoolExecutor:
        return ProcessPoolExecutor(
            executor._max_workers,
            executor._mp_context,
            executor._initializer,
            executor._initargs,
            max_tasks_per_child=executor._max_tasks_per_child,
        )

    # joblib has a copy of loky, with the same names.
    *_, package, module = ["", *kind.__module__.split(".")]
    if package != "loky":
        return None

    settings = {
        "max_workers": executor._max_workers,
        "context": executor._context,
        "timeout": executor._timeout,
        "initializer": executor._initializer,
        "initargs": executor._initargs,
        "env": executor._env,
    }
    made: Executor
    if module == "reusable_executor":
        reusable = sys.modules[kind.__module__].get_reusable_executor
        made = reusable(**settings, kill_workers=True)
    else:
        made = kind(**settings)
    return made
