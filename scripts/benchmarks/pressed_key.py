"""Ctrl-C in a terminal at random moments of each command, and the time until it has ended.

A terminal sends SIGINT to all processes of a command. Each command is run once without a press, to
find out how long it takes, and then again and again with a press at a random moment.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mjfim
from mjfim.experiment.system import System
from mjfim.interruption import NOTHING_SENTENCE
from mjfim.output.archive import write_recording
from scripts.benchmarks.benchmark_hour import played

MODELS = Path(__file__).resolve().parents[2] / "models"

# Duration of the recording that is identified [s].
RECORDED_SECONDS = 20.0

# Time after which a command is ended that does not end by itself [s].
LONGEST = 120.0

# Share of a command's time in which no key is pressed: while Python starts, a press ends the
# command at once.
EARLIEST, LATEST = 0.1, 0.95

# Exit codes of a command that has done its work, or a part of it.
USUAL_CODES = (0, 1)


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command that is interrupted.

    Attributes:
        name: Name of the verb.
        words: Words of the command line after `mjfim`; OUT is the folder of its results.
        data: Names of the files that hold the result.
    """

    name: str
    words: tuple[str, ...]
    data: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Press:
    """Outcome of a command that a pressed key has interrupted.

    Attributes:
        moment: Time from the start of the command to the press [s].
        seconds: Time from the press to the end of the command [s].
        code: Exit code.
        missing: Names of the files of the result that are not there.
        said: What the command wrote on stderr.
        files: Names of the files in its folder.
    """

    moment: float
    seconds: float
    code: int
    missing: tuple[str, ...]
    said: str
    files: tuple[str, ...]

    @property
    def is_excused(self) -> bool:
        """True where the command said that there was nothing to keep, and wrote nothing."""
        return NOTHING_SENTENCE in self.said and not self.files

    @property
    def fault(self) -> str:
        """Faults, in words; empty where the data are complete, or where there were none."""
        faults = [] if self.code in USUAL_CODES else [f"exit code {self.code}"]
        if self.missing and not self.is_excused:
            faults.append(f"{', '.join(self.missing)} missing")
        return "; ".join(faults)

    @property
    def last_line(self) -> str:
        """Last line of what the command wrote on stderr; empty where it wrote nothing."""
        return (self.said.strip().splitlines() or [""])[-1]


def commands(inputs: Path) -> list[Command]:
    """List the commands, with inputs that are made in a folder.

    Args:
        inputs: Folder for their inputs.
    """
    shutil.copytree(MODELS, inputs, dirs_exist_ok=True)
    limits = _varied(inputs / "cart_pendulum_limits.toml", "seconds = 600", "seconds = 8")
    cart = _varied(inputs / "cart_pendulum.toml", "max_iterations = 200", "max_iterations = 5")
    arm = inputs / "two_joint_arm.toml"
    design, recorded = inputs / "design", inputs / "recorded.csv"
    _run(("design", str(cart), "-o", str(design)))
    system = System.resolve(mjfim.Experiment.from_file(arm), threads=1)
    write_recording(recorded, played(system, RECORDED_SECONDS, 1), system)
    return [
        Command(
            name="design",
            words=("design", str(limits), "-o", "OUT"),
            data=("design.json", "design.npz"),
        ),
        Command(
            name="identify",
            words=("identify", str(arm), str(recorded), "-o", "OUT"),
            data=("estimate.json", "estimate.npz"),
        ),
        Command(
            name="robustness",
            words=("robustness", str(cart), str(design), "-o", "OUT", "--runs", "20"),
            data=("playback.json", "playback.npz"),
        ),
        Command(
            name="montecarlo",
            words=("montecarlo", str(cart), str(design), "-o", "OUT", "--trials", "200"),
            data=("montecarlo.json", "montecarlo.npz"),
        ),
        Command(
            name="check",
            words=("check", str(limits), "-o", "OUT"),
            data=("check.json", "check.npz"),
        ),
        Command(
            name="compare",
            words=("compare", str(limits), "-o", "OUT", "--seconds", "1"),
            data=("compare.json", "compare.npz"),
        ),
        Command(
            name="campaign",
            words=("campaign", str(cart), "-o", "OUT", "--wanted", "0.002", "--rounds", "3"),
            data=("campaign.json",),
        ),
    ]


def _varied(path: Path, before: str, after: str) -> Path:
    """Write a variant of an experiment beside it."""
    variant = path.with_stem(f"{path.stem}_varied")
    variant.write_text(path.read_text().replace(before, after))
    return variant


def undisturbed_seconds(command: Command, folder: Path) -> float:
    """Time of a command that nobody disturbs [s].

    Args:
        command: The command.
        folder: Folder for its results; it is removed.
    """
    clock = time.perf_counter()
    try:
        _run(_words(command, folder))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return time.perf_counter() - clock


def pressed(command: Command, folder: Path, moment: float) -> Press | None:
    """Press Ctrl-C while a command runs.

    Args:
        command: The command.
        folder: Folder for its results; it is removed.
        moment: Time from the start to the press [s].

    Returns:
        What became of it; None where it had ended before.
    """
    try:
        return _pressed(command, folder, moment)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _pressed(command: Command, folder: Path, moment: float) -> Press | None:
    """Press Ctrl-C while a command runs, whose folder remains."""
    with _started(_words(command, folder)) as process:
        try:
            process.wait(moment)
            return None
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGINT)

        clock = time.perf_counter()
        try:
            _, said = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            said = f"no end after {LONGEST:g} s"
        seconds = time.perf_counter() - clock

    files = tuple(sorted(path.name for path in folder.rglob("*") if path.is_file()))
    return Press(
        moment=moment,
        seconds=seconds,
        code=process.returncode,
        missing=tuple(name for name in command.data if name not in files),
        said=said,
        files=files,
    )


def moments(seconds: float, count: int, rng: np.random.Generator) -> Sequence[float]:
    """Random moments of a command.

    Args:
        seconds: Time of the command [s].
        count: Their number.
        rng: Source of random numbers.
    """
    return [float(each) for each in rng.uniform(EARLIEST * seconds, LATEST * seconds, count)]


def _words(command: Command, folder: Path) -> tuple[str, ...]:
    """Words of a command that writes into a folder."""
    return tuple(str(folder) if word == "OUT" else word for word in command.words)


def _run(words: Sequence[str]) -> None:
    """Run a command until its end.

    Raises:
        RuntimeError: It did not do its work.
    """
    with _started(words) as process:
        _, said = process.communicate()
    if process.returncode not in USUAL_CODES:
        raise RuntimeError(f"mjfim {' '.join(words)}: exit code {process.returncode}: {said}")


@contextmanager
def _started(words: Sequence[str]) -> Iterator[subprocess.Popen[str]]:
    """Start a command with a process group of its own, all of which has ended afterwards."""
    process = subprocess.Popen(
        [sys.executable, "-B", "-m", "mjfim", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stderr is not None:
            process.stderr.close()
