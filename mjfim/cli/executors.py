"""The option `--executor` of verbs that do much work: where it is done."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated

import typer

from mjfim.cli.common import errors

if TYPE_CHECKING:
    from mjfim.parallel import Pool, Workers
    from mjfim.parallel.stated import StatedExecutor

ExecutorPlace = Annotated[
    str,
    typer.Option(
        "--executor",
        metavar="WHERE",
        help="Where the work is done: local, local:N (processes), dask://HOST:PORT, "
        "dask:FILE.json, or python:MODULE:FACTORY (an executor of your own).",
    ),
]

# Processes of this computer, one for each core.
LOCAL = "local"

# Number of tasks where it is not known before the work begins: as many processes as there may be.
MAX_PARTS = 1_000_000


def stated_executor(place: str) -> StatedExecutor:
    """Read the option, at the beginning of a verb.

    Args:
        place: What the user states.

    Raises:
        ExperimentError: It has no known form.
    """
    from mjfim.parallel.stated import StatedExecutor

    return StatedExecutor.parse(place)


@contextmanager
def started_executor(
    stated: StatedExecutor, tasks: int, threads: int | None = None
) -> Iterator[Workers | None]:
    """Start the executor that the user states, and say at the end if a worker was killed.

    Args:
        stated: The executor.
        tasks: Number of tasks that can be done side by side.
        threads: Threads that the user allows on this computer; None for one per core.

    Yields:
        The workers; None where this process does all work, because there is one task or one core.

    Raises:
        ExperimentError: The executor cannot be started, or nobody answers at its address.
    """
    from mjfim.parallel import Workers, cores
    from mjfim.parallel.stated import ExecutorKind

    if stated.kind is not ExecutorKind.LOCAL:
        with stated.started() as workers:
            yield workers
        return

    count = min(stated.processes or threads or cores(), tasks)
    if count <= 1:
        yield None
        return

    with worker_processes(count) as pool:
        yield Workers(pool)


@contextmanager
def started_if_stated(stated: StatedExecutor, tasks: int) -> Iterator[Workers | None]:
    """Start the executor of work that one process does on all cores where none is stated.

    Args:
        stated: The executor.
        tasks: Number of tasks that can be done side by side.

    Yields:
        The workers; None for `local` without a number, and where there is one task.

    Raises:
        ExperimentError: As for `started_executor`.
    """
    if stated.text == LOCAL:
        yield None
        return

    with started_executor(stated, tasks) as workers:
        yield workers


@contextmanager
def worker_processes(count: int) -> Iterator[Pool]:
    """Yield a pool of worker processes; say at the end if one of them was killed.

    Args:
        count: Largest number of processes.
    """
    from mjfim.parallel import LOST_SENTENCE, Pool

    with Pool(count) as pool:
        yield pool
    if pool.has_lost_worker:
        errors.print(f"mjfim: {LOST_SENTENCE}", markup=False)
