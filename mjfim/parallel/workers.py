"""One view of all executors: how many workers there are, and how a task reaches them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from contextlib import suppress
from typing import Any, Protocol, TypeVar

from mjfim.errors import ExperimentError
from mjfim.parallel.pool import Pool

T = TypeVar("T")

# Attributes with the number of workers: of mjfim and executorlib, of mpi4py, and of
# `concurrent.futures` and loky, which have no public name for it.
COUNT_NAMES = ("max_workers", "num_workers", "_max_workers")

# Tasks that are submitted at once for each worker, so that it need not wait for the next one.
TASKS_PER_WORKER = 2


class ExecutorLike(Protocol):
    """Executor of the work of a verb: one of `concurrent.futures`, a Dask client, or `Workers`.

    Every argument `executor` of mjfim takes one. None means this process; a number of processes is
    stated by `mjfim.Pool(4)`. A verb does not end the executor: its owner does.
    """

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Any:
        """Submit a task; see `concurrent.futures.Executor.submit`."""


class Workers(Executor):
    """Workers of an executor, each of which does one task at a time.

    Every function of mjfim with an argument `executor` takes the executor itself as well. Wrap it
    to state what cannot be found out: the number of workers, or the threads that a task may use.

    Args:
        executor: An executor of the kind of `concurrent.futures` (`mjfim.Pool`, loky, mpi4py,
            executorlib, threads), a Dask `Client`, or what its method `get_executor` returns.
        count: Number of tasks that run at once; default: what the executor says, else 1. A Dask
            cluster may grow and shrink meanwhile.
        threads: Threads that each task may use; default: an equal share of the workers where there
            are fewer tasks than workers and all of them are on this computer, else 1.

    Raises:
        ExperimentError: The object cannot run tasks or is wrapped already, or a number is not
            positive.

    Attributes:
        has_answered: Whether any task has ended so far.
    """

    def __init__(
        self, executor: ExecutorLike, count: int | None = None, threads: int | None = None
    ) -> None:
        for name, number in (("count", count), ("threads", threads)):
            if number is not None and number < 1:
                raise ExperimentError(f"Workers: {name} is {number}; it must be at least 1")
        if isinstance(executor, Workers):
            raise ExperimentError(
                "Workers: the executor is wrapped already; state count and threads where it is "
                "wrapped first"
            )
        if not callable(getattr(executor, "submit", None)):
            is_count = isinstance(executor, int) and not isinstance(executor, bool)
            raise ExperimentError(
                f"executor: {executor!r} has no method `submit`; pass an executor of the kind of "
                f"concurrent.futures, such as mjfim.Pool({executor if is_count else ''}), or a "
                "Dask Client"
            )

        # A client of Dask has futures of its own; its executor has those of concurrent.futures.
        made: Any = executor
        if hasattr(made, "get_executor"):
            made = made.get_executor()
        self._executor: Executor = made
        self._client: Any = getattr(made, "_client", None)
        self._stated_count = count
        self._stated_threads = threads
        self._known_count = 0
        self.has_answered = False

    @classmethod
    def of(cls, executor: ExecutorLike) -> Workers:
        """View an executor as workers; what is viewed so already remains as it is."""
        return executor if isinstance(executor, Workers) else cls(executor)

    @classmethod
    def of_any(cls, executor: ExecutorLike | None) -> Workers | None:
        """View an executor as workers; None remains None.

        A study of several parts does so once, so that an executor that is made anew in one part is
        also used by the next one.
        """
        return None if executor is None else cls.of(executor)

    @property
    def pool(self) -> Pool | None:
        """The pool, whose tasks can be asked to stop; None for other executors."""
        return self._executor if isinstance(self._executor, Pool) else None

    @property
    def is_cluster(self) -> bool:
        """True for a Dask cluster, whose tasks can always be cancelled, even while they run."""
        return self._client is not None

    @property
    def is_empty(self) -> bool:
        """True for a Dask cluster without any worker."""
        return self.is_cluster and not self._found_count()

    @property
    def count(self) -> int:
        """Number of tasks that run at once, at least 1."""
        return max(self._stated_count or self._found_count(), 1)

    @property
    def window(self) -> float:
        """Number of tasks that are submitted at once; infinite where the count is not known."""
        known = self._stated_count or self._found_count() or self.is_cluster
        return TASKS_PER_WORKER * self.count if known else float("inf")

    def threads_for(self, tasks: int) -> int:
        """Number of threads that each task may use.

        Args:
            tasks: Number of tasks that are to be done.
        """
        if self._stated_threads is not None:
            return self._stated_threads
        return max(self.count // max(tasks, 1), 1) if self.is_local else 1

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        """Submit a task; the arguments are those of `concurrent.futures.Executor.submit`.

        A broken executor is made anew where that is possible.
        """
        # Dask would take the result of an equal task, even of one that failed.
        if self.is_cluster:
            kwargs = {**kwargs, "pure": False}
        return self._executor.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the executor; the arguments are those of `concurrent.futures.Executor.shutdown`."""
        # The executor of Dask has no such option: without waiting, it cancels everything.
        options = {"cancel_futures": True} if cancel_futures and not self.is_cluster else {}
        self._executor.shutdown(wait, **options)

    @property
    def probable_fault(self) -> str:
        """Why processes of the workers have ended, in words: what is probable."""
        words = "its process was ended from outside, perhaps because the memory was full"
        if self.pool is None or self.has_answered:
            return words
        return f'{words}, or because a script calls mjfim outside `if __name__ == "__main__":`'

    @property
    def shares_memory(self) -> bool:
        """True for threads of this process, which have all that it has."""
        return isinstance(self._executor, ThreadPoolExecutor)

    @property
    def is_local(self) -> bool:
        """True where all workers are known to be on this computer, so that they share its cores."""
        return isinstance(self._executor, Pool | ProcessPoolExecutor | ThreadPoolExecutor)

    def _found_count(self) -> int:
        """Number of workers that the executor states; 0 where it is not known."""
        if self._client is not None:
            # A cluster may grow. Where its scheduler does not answer, it is as large as before.
            with suppress(OSError):
                self._known_count = sum(self._client.nthreads().values())
            return self._known_count
        for name in COUNT_NAMES:
            number = getattr(self._executor, name, None)
            if isinstance(number, int):
                return number
        return 0


# Errors of other packages with which a task fails whose worker has gone. Only the names are needed,
# so that these packages need not be installed.
LOSSES_BY_NAME = ("KilledWorker", "CommClosedError", "WorkerCrashedError", "NodeDiedError")


def is_loss(error: BaseException | None) -> bool:
    """Check whether a task failed because its worker has gone, so that it can be done again.

    A worker that the user interrupts in the terminal fails with KeyboardInterrupt.
    """
    if isinstance(error, BrokenExecutor | CancelledError | KeyboardInterrupt):
        return True
    return any(kind.__name__ in LOSSES_BY_NAME for kind in type(error).__mro__)


def is_refused_by_pickle(error: BaseException | None) -> bool:
    """Check whether a task could not be sent to a worker; the words are those of pickle."""
    if type(error).__name__ == "PicklingError":
        return True
    text = str(error).lower() if isinstance(error, AttributeError | TypeError) else ""
    return "pickle" in text or "local object" in text
