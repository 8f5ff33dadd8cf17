"""What several benchmarks need: options, jobs in processes, and code in a process of its own."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from rich.progress import track
from rich.table import Table

from mjfim.parallel import cores

# Top folder of the repository.
ROOT = Path(__file__).resolve().parents[2]

# Beginning of the line of stdout that holds the result of code.
MARK = "RESULT "


Job = TypeVar("Job")
Found = TypeVar("Found")


def options_of(description: str | None) -> argparse.ArgumentParser:
    """Parser of the options of a benchmark, whose help is the docstring of its module."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def new_table(title: str, *headings: str, texts: int = 1) -> Table:
    """Make an empty table.

    Args:
        title: Its title.
        *headings: Headings of the columns.
        texts: Number of the first columns, which hold text; the others hold numbers.
    """
    table = Table(title=title, title_justify="left")
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < texts else "right")
    return table


def in_processes(
    function: Callable[[Job], Found], jobs: Sequence[Job], processes: int | None = None
) -> Iterator[Found]:
    """Yield the results of a function for all jobs, in their order, with a bar of progress.

    Args:
        function: Function at the top of a module.
        jobs: The jobs.
        processes: Number of processes; default: one for each core.
    """
    context = get_context("spawn")
    with ProcessPoolExecutor(processes or cores(), mp_context=context) as pool:
        yield from track(pool.map(function, jobs), "runs", total=len(jobs))


def run_code(code: str, *arguments: object) -> Any:
    """Run Python code in a new process, in which BLAS has one thread from the start.

    The value of its variable `found`, which JSON can hold, is returned. None is returned, with a
    message on stderr, where the code fails, for instance because a library is missing.
    """
    last = f"import json, sys; print({MARK!r} + json.dumps(found))"
    command = [sys.executable, "-c", f"import sys\n{code}\n{last}\n", *(str(a) for a in arguments)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)

    line = next((text for text in done.stdout.splitlines() if text.startswith(MARK)), None)
    if done.returncode != 0 or line is None:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        print(f"left out: {reason}", file=sys.stderr)
        return None
    return json.loads(line.removeprefix(MARK))
