"""The calls that are killed: small studies, which end by themselves, of the verbs that write.

`compare` ends by time alone, so that it cannot be repeated with the same result.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.fuzz.inputs import make_study
from tests.support.cli import PROCESS, write_experiment
from tests.support.contents import contents
from tests.support.paths import MODELS, ROOT, SCRIPTS

# Hard limits of a study.
LIMITS = "[limits]\nposition = { slide = [-1.0, 1.0] }\ncontrol = { force = [-5.0, 5.0] }\n"

# Folder into which every call writes.
OUTPUT = "out"

# Files of a folder of results that are no results.
BOOKKEEPING = (".mjfim.json",)

# Time in which Python starts, before the first line of the package can handle a signal [s].
START_OF_PYTHON = 1.0

# Longest time of a call that nobody disturbs [s].
LONGEST_CALL = 120.0


@dataclass(frozen=True, kw_only=True)
class Call:
    """A call that is killed.

    Attributes:
        words: Its words, without the program.
        again: Words that are added when it is repeated after a kill.
        has_workers: Whether it has worker processes.
        script: File of scripts/ that is called instead of `mjfim`; empty for a verb.
    """

    words: tuple[str, ...]
    again: tuple[str, ...] = ()
    has_workers: bool = False
    script: str = ""

    def command(self, *, again: bool = False) -> list[str]:
        """The command line of the call, or of its repetition."""
        program = [sys.executable, str(SCRIPTS / self.script)] if self.script else PROCESS
        return [*program, *self.words, *(self.again if again else ())]


FOLDER = ("-o", OUTPUT)
CALLS = {
    "check": Call(words=("check", "study.toml", *FOLDER)),
    "design": Call(words=("design", "study.toml", *FOLDER)),
    "design in a pool": Call(words=("design", "limited.toml", *FOLDER), has_workers=True),
    "design --shortest": Call(words=("design", "wanted.toml", "--shortest", *FOLDER)),
    "simulate": Call(words=("simulate", "study.toml", "design.npz", "-o", f"{OUTPUT}/made.csv")),
    "identify": Call(words=("identify", "study.toml", "run.csv", *FOLDER)),
    "montecarlo": Call(words=("montecarlo", "study.toml", "design.npz", *FOLDER, "--trials", "40")),
    "rehearse": Call(words=("rehearse", "made", *FOLDER, "--robots", "3")),
    "campaign": Call(
        words=("campaign", "guess.toml", *FOLDER, "--wanted", "0.0055", "--seed", "5"),
        again=("--resume",),
    ),
    "replay --save": Call(words=("replay", "made", "--save", f"{OUTPUT}/view.rrd")),
    "identify_offline.py": Call(
        words=("study.toml", f"{OUTPUT}/run.csv"), script="identify_offline.py"
    ),
}


@dataclass(frozen=True, kw_only=True)
class Reference:
    """What a call does that nobody disturbs.

    Attributes:
        seconds: Its duration [s].
        code: Its exit code.
        files: Contents of its results by name.
    """

    seconds: float
    code: int
    files: dict[str, Any]


def prepare(folder: Path) -> None:
    """Copy the inputs of all calls into an empty folder."""
    shutil.copytree(valid_study(), folder, dirs_exist_ok=True)

    # The script writes beside the recording.
    (folder / OUTPUT).mkdir()
    shutil.copy(folder / "run.csv", folder / OUTPUT)


def environment() -> dict[str, str]:
    """Variables of the calls, which find the package wherever they run."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def results_of(folder: Path) -> dict[str, Any]:
    """Contents of the results of a call in its folder, by name."""
    found = contents(folder / OUTPUT)
    return {name: value for name, value in found.items() if Path(name).name not in BOOKKEEPING}


def completed(command: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """A call in a folder that has ended by itself."""
    return subprocess.run(
        command,
        cwd=folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LONGEST_CALL,
        check=False,
    )


@functools.cache
def reference(name: str) -> Reference:
    """Carry out a call without a kill."""
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as place:
        folder = Path(place)
        prepare(folder)
        begin = time.monotonic()
        done = completed(CALLS[name].command(), folder)
        seconds = time.monotonic() - begin
        if done.returncode not in (0, 1) or "Traceback" in done.stderr:
            raise RuntimeError(f"{name} fails without a kill: {done.stderr[-2000:]}")
        return Reference(seconds=seconds, code=done.returncode, files=results_of(folder))


@functools.cache
def valid_study() -> Path:
    """Folder with studies, a design and a recording."""
    folder = Path(tempfile.mkdtemp(dir=Path.cwd()))
    for name, lines, old, new in (
        # Under hard limits; its initial controls run in worker processes.
        ("limited", "8\nstarts = 3", "[parameters.m]", f"{LIMITS}[parameters.m]"),
        # With a target accuracy, which is reached at about its horizon.
        ("wanted", "3", "scale = ", "wanted = 0.04\nscale = "),
    ):
        study = write_experiment(folder, tolerance="1e-12", max_iterations=lines)
        text = study.read_text(encoding="utf-8").replace(old, new, 1)
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")

    # With a wrong guess, for campaigns.
    text = (MODELS / "cart_pendulum_guess.toml").read_text(encoding="utf-8")
    for old, new in (
        ("horizon = 4.0", "horizon = 1.0"),
        ('"cart_pendulum.csv"', '{ kind = "sine", amplitude = 2.0, frequency = 0.8 }'),
        ("starts = 4", "starts = 1"),
        ("tolerance = 1e-7", "tolerance = 1e-3"),
        ("max_iterations = 200", "max_iterations = 30"),
    ):
        text = text.replace(old, new, 1)
    (folder / "guess.toml").write_text(text, encoding="utf-8")

    make_study(folder, folder / "made")
    shutil.copy(folder / "made" / "design.npz", folder)
    return folder
