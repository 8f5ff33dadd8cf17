"""Executors that are stated in words, as on the command line: `local:4`, `dask://host:8786`."""

from __future__ import annotations

import importlib
import runpy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from mjfim.errors import ExperimentError
from mjfim.parallel.workers import Workers

# Time in which the scheduler of a Dask cluster has to answer [s].
CONNECTION_SECONDS = 10.0

# What can be stated.
FORMS = "local, local:N, dask://HOST:PORT, dask:FILE.json or python:MODULE:FACTORY"


class ExecutorKind(Enum):
    """Kind of an executor; the value is the word with which it is stated."""

    LOCAL = "local"
    DASK = "dask"
    PYTHON = "python"


@dataclass(frozen=True, kw_only=True)
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
            raise ExperimentError(f"executor: {text!r} has no known form; state {FORMS}")

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
        is_count = not self.place or (self.place.isdecimal() and int(self.place) >= 1)
        if self.kind is ExecutorKind.LOCAL and not is_count:
            raise ExperimentError(
                f"executor: {self.text!r}: {self.place!r} is not a number of processes; state a "
                "whole number from 1, such as local:2"
            )

        if self.kind is ExecutorKind.DASK and not self.place:
            raise ExperimentError(
                f"executor: {self.text!r} states no scheduler; state its address, such as "
                "dask://host:8786, or the file that it writes, such as dask:scheduler.json"
            )

        is_file = self.kind is ExecutorKind.DASK and "//" not in self.place
        if is_file and not Path(self.place).is_file():
            raise ExperimentError(
                f"executor: {self.text!r}: there is no file {self.place}; `dask scheduler "
                f"--scheduler-file {self.place}` writes it"
            )

        module, colon, name = self.place.rpartition(":")
        if self.kind is ExecutorKind.PYTHON and not (module and colon and name.isidentifier()):
            raise ExperimentError(
                f"executor: {self.text!r} names no function; state a module or a file and a "
                "function that returns an executor, such as python:cluster.py:make"
            )

    # ---- Dask

    def _cluster(self) -> Any:
        """A client of the stated Dask cluster."""
        # An address may state its protocol, such as dask:tls://host:8786.
        if self.place.startswith("//"):
            address = {"address": f"tcp:{self.place}"}
        elif "//" in self.place:
            address = {"address": self.place}
        else:
            address = {"scheduler_file": self.place}

        try:
            from distributed import Client
        except ImportError as error:
            raise ExperimentError(
                f"executor: {self.text!r} needs Dask, which is not installed: "
                "pip install 'mjfim[dask]'"
            ) from error

        try:
            client = Client(**address, timeout=CONNECTION_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ExperimentError(
                f"executor: {self.text!r}: no scheduler answers there within "
                f"{CONNECTION_SECONDS:g} s; start one with `dask scheduler`, and check the address "
                "and the firewall"
            ) from error
        except TypeError as error:
            # Dask refuses an encrypted address so where it has no certificates.
            raise ExperimentError(
                f"executor: {self.text!r}: Dask cannot use this address: {error}; for tls:// state "
                "the certificates in the configuration of Dask, under distributed.comm.tls"
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
        except (ImportError, OSError) as error:
            raise ExperimentError(
                f"executor: {self.text!r}: {place} cannot be imported: {error}; state the name of "
                "an installed module, or the path of a file that ends with .py"
            ) from error
        factory = known.get(name)
        if not callable(factory):
            raise ExperimentError(
                f"executor: {self.text!r}: {place} has no function {name}; it must return an "
                "executor of the kind of concurrent.futures"
            )
        return factory()


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
