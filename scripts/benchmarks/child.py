"""Commands of mjfim, and Python code, in new processes whose time and memory are measured."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# Top folder of the repository.
ROOT = Path(__file__).resolve().parents[2]

# Beginning of the line of stdout that holds the result of code.
MARK = "RESULT "


@dataclass(frozen=True, kw_only=True)
class CommandRun:
    """A command that has ended.

    Attributes:
        wall: Wall time [s].
        processor: Time of the processors of the process and of all that it has started [s].
        gigabytes: Largest memory of the process, or of one that it has started [GiB]. Linux counts
            the memory that the calling process had when it started this one, so that it is never
            less.
        code: Exit code.
        messages: Text on stderr.
    """

    wall: float
    processor: float
    gigabytes: float
    code: int
    messages: str


def run_command(words: Sequence[str]) -> CommandRun:
    """Run `mjfim` in the top folder of the repository, and measure it.

    The files of modules are compiled at their first import, as by an installation.
    """
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = str(ROOT)

    # Messages go to a file, because the process is awaited by a call that reads no pipe.
    with tempfile.TemporaryFile() as messages:
        clock = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "mjfim", *words],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=messages,
        )
        _, status, used = os.wait4(process.pid, 0)
        wall = time.perf_counter() - clock
        process.returncode = os.waitstatus_to_exitcode(status)

        messages.seek(0)
        text = messages.read().decode(errors="replace")

    # Linux states the memory in KiB.
    return CommandRun(
        wall=wall,
        processor=used.ru_utime + used.ru_stime,
        gigabytes=used.ru_maxrss / 2**20,
        code=process.returncode,
        messages=text,
    )


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
