"""Run cases in worker processes, each with a time limit; a crash ends one case only."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from dataclasses import replace
from multiprocessing.pool import ThreadPool
from pathlib import Path

import psutil

from tests.fuzz import inputs, kills, problems
from tests.fuzz.outcome import RUNNING, TIME_LIMITS, Case, Outcome, announce
from tests.support.paths import ROOT

# Memory that a worker may use [bytes]; a case that wants more fails with MemoryError.
MEMORY = 8 * 2**30


def run_case(case: Case, folder: Path) -> Outcome:
    """Run a case in this process.

    Args:
        case: The case.
        folder: Empty folder for its files.
    """
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
    deadline = time.monotonic() + seconds
    here, started = threading.local(), []

    def run(case: Case) -> Outcome | None:
        """Run a case in the worker of this thread, unless the time is up."""
        if time.monotonic() > deadline:
            return None
        if not hasattr(here, "worker"):
            here.worker = Worker()
            started.append(here.worker)
        return here.worker.run(case)

    with ThreadPool(workers) as threads:
        try:
            yield from filter(None, threads.imap_unordered(run, cases))
        finally:
            for worker in started:
                worker.stop()


class Worker:
    """A process that runs one case after the other; it is replaced when it crashes or hangs."""

    def __init__(self) -> None:
        # The parent removes the folder: a process that is killed cannot.
        self._home = tempfile.TemporaryDirectory(prefix="mjfim-fuzz-", ignore_cleanup_errors=True)
        self._start()

    def _start(self) -> None:
        """Start the process, and wait until it is ready."""
        context = multiprocessing.get_context("spawn")
        self._executor = ProcessPoolExecutor(1, context, _begin, (self._home.name,))
        self._pid = self._executor.submit(os.getpid).result()

    def run(self, case: Case) -> Outcome:
        """Run a case; a crash and a case without an end are outcomes."""
        limit = TIME_LIMITS[case.kind]
        try:
            return self._executor.submit(_run_in_folder, case).result(limit)
        except BrokenExecutor:
            fault = "the process crashed"
        except TimeoutError:
            fault = f"no end after {limit:g} s"

        self._kill()
        self._start()
        description = (self._home.name / RUNNING).read_text(encoding="utf-8")
        return Outcome(case=case, group="crash", description=description, complaint=fault)

    def stop(self) -> None:
        """End the process and what it has started, and remove its files."""
        self._kill()
        self._home.cleanup()

    def _kill(self) -> None:
        """End the process and what it has started."""
        with contextlib.suppress(psutil.NoSuchProcess):
            process = psutil.Process(self._pid)
            for each in (*process.children(recursive=True), process):
                each.kill()
        self._executor.shutdown()


def _begin(home: str) -> None:
    """Prepare a worker process."""
    # Where the system can limit it.
    if sys.platform != "win32":
        import resource

        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, hard))

    # MuJoCo writes its log into the current folder; processes still have to find the package.
    sys.path.insert(0, str(ROOT))
    os.environ["PYTHONPATH"] = str(ROOT)
    os.chdir(home)
    announce("")


def _run_in_folder(case: Case) -> Outcome:
    """Run a case in a folder of its own."""
    with tempfile.TemporaryDirectory(dir=Path.cwd(), ignore_cleanup_errors=True) as folder:
        return run_case(case, Path(folder))
