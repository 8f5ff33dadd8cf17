"""One view of all executors: how many workers there are, and how a task reaches them.

The command line states an executor in words: `local:4`, `dask://host:8786`.
"""

from __future__ import annotations

import importlib
import runpy
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from mjfim.arrays import record
from mjfim.errors import MAX_THREADS, ExperimentError, shortened
from mjfim.files import read_json
from mjfim.parallel.pool import Pool

T = TypeVar("T")

# Attributes with the number of workers: of mjfim and executorlib, of mpi4py, and of
# `concurrent.futures` and loky, which have no public name for it.
COUNT_NAMES = ("max_workers", "num_workers", "_max_workers")

# Tasks that are submitted at once for each worker, so that it need not wait for the next one.
TASKS_PER_WORKER = 2


@runtime_checkable
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
            raise ExperimentError(
                f"executor: {executor!r} has no method `submit`; pass an executor of the kind of "
                f"concurrent.futures, such as mjfim.Pool(), or a "
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


# Time in which the scheduler of a Dask cluster has to answer [s].
CONNECTION_SECONDS = 10.0

# What can be stated.
FORMS = "local, local:N, dask://HOST:PORT, dask:FILE.json or python:MODULE:FACTORY"


class ExecutorKind(Enum):
    """Kind of an executor; the value is the word with which it is stated."""

    LOCAL = "local"
    DASK = "dask"
    PYTHON = "python"


@record
class StatedExecutor:
    """An executor as the user states it, which is not started yet.

    Attributes:
        text: What the user states.
        kind: Its kind.
        place: What follows the first colon: a number of processes, the address or the file of a
            scheduler, or a module and the name of a function.
    """

    text: str
    kind: ExecutorKind
    place: str

    @classmethod
    def parse(cls, text: str) -> StatedExecutor:
        """Read what the user states.

        Args:
            text: One of `FORMS`.

        Returns:
            The executor, which is not started.

        Raises:
            ExperimentError: The text has another form, a number that is not positive, or a file
                that does not exist.
        """
        word, colon, place = text.partition(":")
        kinds = {kind.value: kind for kind in ExecutorKind}
        if word not in kinds or (colon and not place):
            raise ExperimentError(
                f"executor: {shortened(repr(text))} has no known form; state {FORMS}"
            )

        stated = cls(text=text, kind=kinds[word], place=place)
        stated._require_place()
        return stated

    @property
    def processes(self) -> int | None:
        """Stated number of local processes; None where none is stated."""
        return int(self.place) if self.kind is ExecutorKind.LOCAL and self.place else None

    @contextmanager
    def started(self) -> Iterator[Workers]:
        """Connect to the executor, which is not a local one; disconnect at the end.

        Yields:
            Its workers.

        Raises:
            ExperimentError: A package or a function is missing, nobody answers at the address, or
                the workers have other versions.
        """
        made = self._cluster() if self.kind is ExecutorKind.DASK else self._made()
        workers = Workers.of(made)
        try:
            yield workers
        finally:
            # Nobody waits for tasks that are not needed any more.
            workers.shutdown(wait=False, cancel_futures=True)
            if hasattr(made, "close"):
                made.close()

    def _require_place(self) -> None:
        """Raise ExperimentError where the place does not fit the kind."""
        counts = map(str, range(1, MAX_THREADS + 1))
        if self.kind is ExecutorKind.LOCAL and self.place not in ("", *counts):
            raise self._error(
                f"not a number of processes; state a whole number from 1 to {MAX_THREADS}, such as "
                "local:2"
            )

        if self.kind is ExecutorKind.DASK and not self.place:
            raise self._error(
                "states no scheduler; state its address, such as dask://host:8786, or the file "
                "that it writes, such as dask:scheduler.json"
            )

        is_file = self.kind is ExecutorKind.DASK and "//" not in self.place
        if is_file and not Path(self.place).is_file():
            raise self._error("no such file; `dask scheduler --scheduler-file FILE` writes it")

        module, colon, name = self.place.rpartition(":")
        if self.kind is ExecutorKind.PYTHON and not (module and colon and name.isidentifier()):
            raise self._error(
                "names no function; state a module or a file and a function that returns an "
                "executor, such as python:cluster.py:make"
            )

    def _error(self, words: str) -> ExperimentError:
        """Error that says what is wrong with the stated executor, and what would be right."""
        return ExperimentError(f"executor: {shortened(repr(self.text))}: {words}")

    # ---- Dask

    def _cluster(self) -> Any:
        """A client of the stated Dask cluster."""
        try:
            from distributed import Client
            from distributed.comm import resolve_address
        except ImportError as error:
            raise self._error(
                "needs Dask, which is not installed: pip install 'mjfim[dask]'"
            ) from error

        # An address may state its protocol, such as dask:tls://host:8786.
        address = f"tcp:{self.place}" if self.place.startswith("//") else self.place
        if "//" not in address:
            address = str(read_json(Path(address)).get("address"))
        try:
            # A client whose address has a wrong form waits long when the process ends.
            resolve_address(address)
            client = Client(address, timeout=CONNECTION_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise self._error(
                f"no scheduler answers there within {CONNECTION_SECONDS:g} s "
                f"({shortened(str(error))}); start one with `dask scheduler`, and check the "
                "address and the firewall"
            ) from error
        except TypeError as error:
            # Dask refuses an encrypted address so where it has no certificates.
            raise self._error(
                f"Dask cannot use this address: {error}; for tls:// state the certificates in the "
                "configuration of Dask, under distributed.comm.tls"
            ) from error

        try:
            _require_same_versions(client)
        except ExperimentError:
            client.close()
            raise
        return client

    # ---- an executor of the user

    def _made(self) -> Any:
        """The executor that the stated function returns."""
        place, _, name = self.place.rpartition(":")
        try:
            is_file = place.endswith(".py")
            known = runpy.run_path(place) if is_file else vars(importlib.import_module(place))
            return known[name]()
        except Exception as error:  # the code of the user may raise anything
            raise self._error(
                f"cannot call {shortened(name)} ({type(error).__name__}: {shortened(str(error))}); "
                "state a function without arguments that returns an executor of the kind of "
                "concurrent.futures, in an installed module or in a file that ends with .py"
            ) from error


def own_versions() -> tuple[str, str]:
    """Return the versions on which results depend: of mjfim and of MuJoCo."""
    import mujoco

    # The top of the package imports every floor, so that a lower floor looks it up by its name.
    package = importlib.import_module("mjfim")
    return str(package.__version__), mujoco.__version__


def _require_same_versions(client: Any) -> None:
    """Raise ExperimentError where a worker of a Dask cluster would give other results, or none."""
    here = own_versions()
    try:
        found = client.run(own_versions)
    except ImportError as error:
        raise ExperimentError(
            f"executor: the workers cannot import mjfim ({error}); install mjfim {here[0]} where "
            "they run"
        ) from error

    for worker, there in found.items():
        if tuple(there) != here:
            raise ExperimentError(
                f"executor: the worker {worker} has mjfim {there[0]} and MuJoCo {there[1]}, but "
                f"here are mjfim {here[0]} and MuJoCo {here[1]}; install the same versions"
            )
