"""Kills at a random time: no corrupt file at a final name, no process that outlives its parent."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from tests.fuzz.outcome import Case, Outcome
from tests.fuzz.result_files import faults_of, is_temporary
from tests.fuzz.workers import announce
from tests.support.cli import PROCESS, write_experiment
from tests.support.cli import run as run_here
from tests.support.paths import ROOT

# Time after which no process of a killed call may be alive [s].
ORPHAN_TIME = 5.0

# Time within which a call has to end after SIGINT or SIGTERM [s]: 5 s for the work, the rest for
# pictures on a busy machine.
END_TIME = 30.0

# Time in which Python starts, before the first line of the package can handle a signal [s].
START_OF_PYTHON = 1.0

# Longest time before the kill [s], about the time that each call takes or longer.
LONGEST = {"design": 15.0, "design in a pool": 20.0, "identify": 8.0, "montecarlo": 14.0}

# Words of the calls. The designs would never end by themselves.
CALLS = {
    "design": ("design", "long.toml", "-o", "out"),
    "design in a pool": ("design", "limited.toml", "-o", "out"),
    "identify": ("identify", "study.toml", "run.csv", "-o", "out"),
    "montecarlo": ("montecarlo", "study.toml", "design.npz", "-o", "out", "--trials", "800"),
}

SIGNALS = ("SIGKILL", "SIGINT", "SIGTERM")


def run(case: Case, folder: Path) -> Outcome:
    """Start a call, kill it after a random time, and look at what is left."""
    rng = case.rng
    name = str(rng.choice(list(CALLS)))
    kill = str(rng.choice(SIGNALS))
    seconds = LONGEST[name] * float(rng.random())
    description = f"{name}, {kill} after {seconds:.2f} s"
    announce(description)
    if os.name != "posix":
        return Outcome(case=case, group="skipped", description=f"{description}: not on this system")

    for file in valid_study().iterdir():
        shutil.copy(file, folder)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (folder / "stderr").open("wb") as errors:
        # A new session makes the children recognisable: they stay in its process group.
        process = subprocess.Popen(
            [*PROCESS, *CALLS[name]],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=environment,
            start_new_session=True,
        )
    try:
        is_killed = _send(process, kill, seconds)
        complaints = [*_ending(process, kill, seconds), *_orphans(process.pid)]
    finally:
        _end(process)

    text = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    if "Traceback" in text and seconds >= START_OF_PYTHON:
        complaints.append("Traceback: " + "\n".join(text.splitlines()[-4:]))
    complaints += _files(folder / "out", kill)
    return Outcome(
        case=case,
        group=kill if is_killed else "ended before",
        description=description,
        complaint="; ".join(complaints),
    )


def _send(process: subprocess.Popen[bytes], kill: str, seconds: float) -> bool:
    """Send a signal to a process after some seconds; False if it has ended before."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.Signals[kill])
        return True
    return False


def _ending(process: subprocess.Popen[bytes], kill: str, seconds: float) -> list[str]:
    """Describe what is wrong with the end of a process that got a signal after some seconds."""
    try:
        code = process.wait(END_TIME)
    except subprocess.TimeoutExpired:
        return [f"no end {END_TIME:g} s after {kill}"]
    is_fatal = kill == "SIGKILL" or seconds < START_OF_PYTHON
    allowed = (0, 1, -signal.Signals[kill]) if is_fatal else (0, 1)
    return [] if code in allowed else [f"exit code {code} after {kill}"]


def _orphans(group: int) -> list[str]:
    """Describe the processes of a group that are still alive after some seconds."""
    deadline = time.monotonic() + ORPHAN_TIME
    while alive := _alive(group):
        if time.monotonic() > deadline:
            return [f"{len(alive)} processes alive after {ORPHAN_TIME:g} s: {'; '.join(alive)}"]
        time.sleep(0.2)
    return []


def _alive(group: int) -> list[str]:
    """The commands of the processes of a group; ended ones that nobody has waited for count not."""
    listing = subprocess.run(
        ["ps", "-A", "-o", "pgid=,stat=,args="], capture_output=True, text=True, check=True
    ).stdout
    rows = [line.split(None, 2) for line in listing.splitlines()]
    return [row[-1][:100] for row in rows if row[0] == str(group) and not row[1].startswith("Z")]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End everything that a call has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _files(folder: Path, kill: str) -> list[str]:
    """Describe the files that are not whole, and temporary files that should have been removed."""
    found: list[str] = []
    for path in sorted(folder.rglob("*")):
        if not path.is_file():
            continue
        # Only SIGKILL leaves no time to remove a temporary file.
        if not is_temporary(path):
            found += faults_of(path)
        elif kill != "SIGKILL":
            found.append(f"{path.name} is a temporary file that stayed")
    return found


@functools.cache
def valid_study() -> Path:
    """Folder with a study, its design and its recording, and with studies that run for long."""
    folder = Path(tempfile.mkdtemp(dir=Path.cwd()))
    long = write_experiment(folder, tolerance="1e-12", max_iterations="200\nstarts = 10000")
    text = long.read_text(encoding="utf-8")
    long.rename(folder / "long.toml")

    # Only the initial controls of a design under hard limits run in worker processes.
    limits = "\n[limits]\nposition = { slide = [-1.0, 1.0] }\ncontrol = { force = [-5.0, 5.0] }\n"
    (folder / "limited.toml").write_text(text + limits, encoding="utf-8")

    study = write_experiment(folder)
    made = run_here("design", study, "-o", folder / "made", "--threads", 1)
    npz = folder / "made" / "design.npz"
    simulated = run_here("simulate", study, npz, "-o", folder / "run.csv")
    if made.exit_code not in (0, 1) or simulated.exit_code:
        raise RuntimeError(f"the valid study fails: {made.stderr} {simulated.stderr}")
    shutil.move(npz, folder / "design.npz")
    shutil.rmtree(folder / "made")
    return folder
