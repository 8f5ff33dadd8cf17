"""Run cases in worker processes, each with a time limit; a crash ends one case only."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import queue
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

from tests.fuzz.outcome import TIME_LIMITS, Case, Outcome
from tests.support.paths import ROOT

# Memory that a worker may use [bytes]; a case that wants more fails with MemoryError.
MEMORY = 8 * 2**30

# Time that a new worker may take for its imports and its inputs [s].
PREPARATION = 180.0


def run_case(case: Case, folder: Path) -> Outcome:
    """Run a case in this process.

    Args:
        case: The case.
        folder: Empty folder for its files.
    """
    from tests.fuzz import inputs, kills, problems

    begin = time.monotonic()
    runs = {
        "problem": problems.run,
        "input": inputs.run,
        "kill": kills.run,
        "mechanism": problems.run,
        "permission": inputs.run,
        "log": inputs.run,
    }
    try:
        outcome = runs[case.kind](case, folder)
    except Exception:
        lines = traceback.format_exc().strip().splitlines()
        outcome = Outcome(
            case=case, group="error", description="", complaint="\n".join(lines[-14:])
        )

    # MuJoCo's memory counts for nothing in Python's collector, which would wait too long.
    gc.collect()
    return replace(outcome, seconds=time.monotonic() - begin)


def run_cases(cases: Iterable[Case], workers: int, seconds: float) -> Iterator[Outcome]:
    """Run cases side by side.

    Args:
        cases: The cases.
        workers: Number of worker processes.
        seconds: Time after which no further case begins [s].

    Yields:
        The outcomes, in the order in which they end.
    """
    waiting: queue.SimpleQueue[Case] = queue.SimpleQueue()
    for case in cases:
        waiting.put(case)
    ended: queue.SimpleQueue[Outcome | None] = queue.SimpleQueue()
    deadline = time.monotonic() + seconds

    def work() -> None:
        """Run cases one after the other until there is none, or until the time is up."""
        worker = Worker()
        try:
            while time.monotonic() < deadline:
                ended.put(worker.run(waiting.get_nowait()))
        except queue.Empty:
            pass
        finally:
            worker.stop()
            ended.put(None)

    threads = [threading.Thread(target=work) for _ in range(workers)]
    for thread in threads:
        thread.start()
    running = len(threads)
    while running:
        outcome = ended.get()
        if outcome is None:
            running -= 1
        else:
            yield outcome


class Worker:
    """A process that runs one case after the other; it is replaced when it crashes or hangs."""

    def __init__(self) -> None:
        # The parent removes the folder: a process that is killed cannot.
        self._home = tempfile.TemporaryDirectory(prefix="mjfim-fuzz-", ignore_cleanup_errors=True)
        self._start()

    def _start(self) -> None:
        """Start the process, and wait until it is ready."""
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, self._home.name))
        self._process.start()
        theirs.close()
        if not self._connection.poll(PREPARATION):
            raise TimeoutError("a worker of the fuzz suite does not start")
        self._connection.recv()

    def run(self, case: Case) -> Outcome:
        """Run a case; a crash and a case without an end are outcomes."""
        limit = TIME_LIMITS[case.kind]
        self._connection.send(case)
        description = ""
        while self._connection.poll(limit):
            try:
                received = self._connection.recv()
            except (EOFError, ConnectionError):
                self._process.join(10.0)
                fault = f"the process crashed, exit code {self._process.exitcode}"
                break
            if isinstance(received, Outcome):
                return received
            description = received
        else:
            fault = f"no end after {limit:g} s"

        self._kill()
        self._start()
        return Outcome(case=case, group="crash", description=description, complaint=fault)

    def stop(self) -> None:
        """End the process and what it has started, and remove its files."""
        self._kill()
        self._home.cleanup()

    def _kill(self) -> None:
        """End the process and what it has started."""
        if hasattr(os, "killpg") and self._process.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.join()
        self._connection.close()


# Sends the description of the running case to the parent process, which needs it after a crash.
_parent: list[Connection] = []


def announce(description: str) -> None:
    """Tell the parent process what the running case is."""
    for connection in _parent:
        connection.send(description)


def _serve(connection: Connection, home: str) -> None:
    """Run the cases that arrive, each in an empty folder inside `home`, until the parent ends."""
    if hasattr(os, "setsid"):
        os.setsid()
    _limit_memory()

    # MuJoCo writes its log into the current folder; processes still have to find the package.
    sys.path.insert(0, str(ROOT))
    os.environ["PYTHONPATH"] = str(ROOT)
    os.chdir(home)
    _parent.append(connection)
    connection.send("ready")

    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            case = connection.recv()
            with tempfile.TemporaryDirectory(dir=home, ignore_cleanup_errors=True) as folder:
                connection.send(run_case(case, Path(folder)))


def _limit_memory() -> None:
    """Limit the memory of this process, where the system can."""
    try:
        import resource
    except ImportError:
        return
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, hard))
