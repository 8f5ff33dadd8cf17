"""The package of this folder and that of an earlier commit, and commands that run with either."""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

# Top folder of the repository.
ROOT = Path(__file__).resolve().parents[2]


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


@contextmanager
def earlier_checkout(commit: str) -> Iterator[Path]:
    """Extract the files of an earlier commit into a temporary folder, which is removed afterwards.

    Args:
        commit: The commit.

    Yields:
        Top folder of these files.

    Raises:
        SystemExit: There is no such commit.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "before"
        git = ["git", "-C", str(ROOT), "archive", commit]
        packed = subprocess.run(git, capture_output=True, check=False)
        if packed.returncode != 0:
            raise SystemExit(f"{commit}: {packed.stderr.decode().strip()}")

        with tarfile.open(fileobj=io.BytesIO(packed.stdout)) as archive:
            archive.extractall(folder, filter="data")
        yield folder


def commit_hash(commit: str) -> str:
    """Return the whole hash of a commit, which no later commit changes.

    Args:
        commit: The commit, such as the name of a branch.

    Raises:
        SystemExit: There is no such commit.
    """
    git = ["git", "-C", str(ROOT), "rev-parse", "--verify", f"{commit}^{{commit}}"]
    found = subprocess.run(git, capture_output=True, text=True, check=False)
    if found.returncode != 0:
        raise SystemExit(f"{commit}: {found.stderr.strip()}")
    return found.stdout.strip()


def run_command(package: Path, words: Sequence[str]) -> CommandRun:
    """Run `mjfim` with the package of a folder, and measure it.

    The files of modules are compiled at their first import, as by an installation.

    Args:
        package: Folder that contains the package; it is the current folder of the command.
        words: Words of the command line after `mjfim`.
    """
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPATH"] = str(package)

    # Messages go to a file, because the process is awaited by a call that reads no pipe.
    with tempfile.TemporaryFile() as messages:
        clock = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "mjfim", *words],
            cwd=package,
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
