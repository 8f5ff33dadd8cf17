"""Kills at a random time of small studies, which end by themselves, of the verbs that write.

No file at a final name is corrupt, no process outlives its parent, and the same call again gives
what an undisturbed call gives. `compare` ends by time alone, so that it cannot be repeated with the
same result.
"""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from mjfim.parallel.budget import NOTHING_SENTENCE
from tests.fuzz.inputs import make_study
from tests.fuzz.outcome import Case, Outcome, announce
from tests.fuzz.result_files import faults_in
from tests.support.cli import PROCESS, write_experiment, write_wrong_guess
from tests.support.contents import contents
from tests.support.paths import ROOT

Process = subprocess.Popen[bytes]

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


# Calls of `mjfim` that are killed.
CALLS = (
    "check study.toml -o out",
    "design study.toml -o out",
    "design limited.toml -o out",
    "design wanted.toml --shortest -o out",
    "simulate study.toml design.npz -o out/made.csv",
    "identify study.toml run.csv -o out",
    "montecarlo study.toml design.npz -o out --trials 40",
    "rehearse made -o out --robots 3",
    "campaign guess.toml -o out --wanted 0.0055 --seed 5",
    "replay made --save out/view.rrd",
)

# Those with worker processes, and what is added to a call when it is repeated after a kill.
WITH_WORKERS = CALLS[2:3]
AGAIN = {CALLS[8]: " --resume"}


def prepare(folder: Path) -> None:
    """Copy the inputs of all calls into an empty folder."""
    shutil.copytree(valid_study(), folder, dirs_exist_ok=True)
    (folder / OUTPUT).mkdir()


# The calls find the package wherever they run.
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def results_of(folder: Path) -> dict[str, Any]:
    """Contents of the results of a call in its folder, by name."""
    found = contents(folder / OUTPUT)
    return {name: value for name, value in found.items() if Path(name).name not in BOOKKEEPING}


def completed(call: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """A call in a folder that has ended by itself."""
    return subprocess.run(
        [*PROCESS, *call.split()],
        cwd=folder,
        env=ENVIRONMENT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LONGEST_CALL,
        check=False,
    )


@functools.cache
def reference(call: str) -> tuple[float, int, dict[str, Any]]:
    """Duration [s], exit code and results of a call that nobody disturbs."""
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as place:
        folder = Path(place)
        prepare(folder)
        begin = time.monotonic()
        done = completed(call, folder)
        seconds = time.monotonic() - begin
        if done.returncode not in (0, 1) or "Traceback" in done.stderr:
            raise RuntimeError(f"{call} fails without a kill: {done.stderr[-2000:]}")
        return seconds, done.returncode, results_of(folder)


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
    write_wrong_guess(folder / "guess.toml")

    make_study(folder, folder / "made")
    shutil.copy(folder / "made" / "design.npz", folder)
    return folder


# Time after which no process of a killed call may be alive [s].
ORPHAN_TIME = 5.0

# Time within which a call has to end after SIGINT or SIGTERM [s]: 5 s for the work, the rest for
# pictures on a busy machine.
END_TIME = 30.0

# Time within which a call has to end after the second signal [s]: 5 s, and the rest for a busy
# machine.
SECOND_END_TIME = 10.0

# Longest time between two signals [s].
LONGEST_GAP = 5.0

# Time of the kill, at most, relative to the time that the undisturbed call takes.
LATEST = 1.05

# Signals to the call, one after the other; WORKER is SIGKILL to one of its worker processes.
WORKER = "worker"
KILLS = (
    ("SIGKILL",),
    ("SIGINT",),
    ("SIGINT",),
    ("SIGTERM",),
    ("SIGTERM",),
    ("SIGHUP",),
    ("SIGHUP",),
    ("SIGHUP", "SIGTERM"),
    ("SIGINT", "SIGINT"),
    ("SIGINT", "SIGTERM"),
    ("SIGTERM", "SIGINT"),
    ("SIGINT", "SIGKILL"),
    (WORKER,),
)


def run(case: Case, folder: Path) -> Outcome:
    """Start a call, kill it after a random time, look at what is left, and repeat the call."""
    rng = case.rng
    signals = KILLS[rng.integers(len(KILLS))]
    call = str(rng.choice(WITH_WORKERS if signals == (WORKER,) else CALLS))
    share, gap = LATEST * float(rng.random()), LONGEST_GAP * float(rng.random())
    # Half of the calls ignore SIGINT from their begin, as a background job of a shell.
    is_deaf = bool(rng.integers(2))
    heard = tuple(each for each in signals if not (is_deaf and each == "SIGINT"))
    group = "+".join(signals) + " deaf" * is_deaf
    description = f"{call}, {group} after {100 * share:.0f} %, {gap:.2f} s between signals"
    announce(description)
    if os.name != "posix":
        reason = f"{description}: not on this system"
        return Outcome(case=case, group="skipped", description=reason)

    duration, _, wanted = reference(call)
    prepare(folder)
    seconds = share * duration
    can_hear = seconds >= START_OF_PYTHON
    with _started(call, folder, is_deaf=is_deaf) as process:
        is_killed = _send(process, signals, seconds, gap)
        complaints = [*_ending(process, heard, can_hear), *_orphans(process.pid)]

    told = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
    if "Traceback" in told and can_hear:
        complaints.append("Traceback: " + "\n".join(told.splitlines()[-4:]))
    results = (folder / OUTPUT).rglob("*")
    # Only SIGKILL leaves no time to remove a temporary file.
    complaints += faults_in(results, may_be_temporary="SIGKILL" in signals)
    if not heard or heard == (WORKER,):
        complaints += _differences(folder, wanted)
    elif "SIGKILL" not in heard and can_hear:
        complaints += _lost(folder, told)
    complaints += [f"again: {fault}" for fault in _again(call, folder)]
    return Outcome(
        case=case,
        group=group if is_killed else "ended before",
        description=f"{description} = {seconds:.2f} s",
        complaint="; ".join(complaints),
    )


@contextlib.contextmanager
def _started(call: str, folder: Path, *, is_deaf: bool) -> Iterator[Process]:
    """Start a call in a session of its own; end everything that it has started at the end.

    In a new session, the children are recognised by their process group.
    """
    with (folder / "stderr").open("wb") as errors:
        process = subprocess.Popen(
            [*PROCESS, *call.split()],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=ENVIRONMENT,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(
                signal.SIGINT, signal.SIG_IGN if is_deaf else signal.SIG_DFL
            ),
        )
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _send(process: Process, signals: tuple[str, ...], seconds: float, gap: float) -> bool:
    """Send all signals; False if the process has ended before the first one."""
    if not _runs_on(process, seconds):
        return False
    if signals == (WORKER,):
        return _kill_worker(process)

    process.send_signal(signal.Signals[signals[0]])
    for name in signals[1:]:
        if _runs_on(process, gap):
            process.send_signal(signal.Signals[name])
    return True


def _runs_on(process: Process, seconds: float) -> bool:
    """Wait, and return whether a process is still running after some seconds."""
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return True
    return False


def _kill_worker(process: Process) -> bool:
    """Kill the first worker of a process that there is; False if the process ends before."""
    while process.poll() is None:
        with contextlib.suppress(psutil.NoSuchProcess):
            children = psutil.Process(process.pid).children()
            workers = [each for each in children if "spawn_main" in " ".join(each.cmdline())]
            if workers:
                workers[-1].kill()
                return True
        time.sleep(0.05)
    return False


def _ending(process: Process, heard: tuple[str, ...], can_hear: bool) -> list[str]:
    """Describe what is wrong with the end of a process that heard some signals."""
    limit = END_TIME if len(heard) == 1 else SECOND_END_TIME
    limit = LONGEST_CALL if not heard or heard == (WORKER,) else limit
    try:
        code = process.wait(limit)
    except subprocess.TimeoutExpired:
        return [f"no end {limit:g} s after the last signal"]

    # Python itself cannot handle a signal while it starts.
    fatal = [each for each in heard if each == "SIGKILL" or not (can_hear or each == WORKER)]
    allowed = (0, 1, *(-signal.Signals[name] for name in fatal))
    return [] if code in allowed else [f"exit code {code}"]


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
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getpgid(process.pid) == group and process.status() != psutil.STATUS_ZOMBIE:
                found.append(" ".join(process.cmdline())[:100])
    return found


def _again(call: str, folder: Path) -> list[str]:
    """Repeat a call, and describe in what it differs from one that nobody disturbed."""
    _, code, wanted = reference(call)
    try:
        done = completed(call + AGAIN.get(call, ""), folder)
    except subprocess.TimeoutExpired:
        return [f"no end after {LONGEST_CALL:g} s"]

    if done.returncode != code:
        return [f"exit code {done.returncode} instead of {code}: {done.stderr[-600:]}"]
    return [*faults_in((folder / OUTPUT).rglob("*")), *_differences(folder, wanted)]


def _lost(folder: Path, told: str) -> list[str]:
    """Describe a call that was asked to stop and left no result, though it did not say so."""
    is_told = NOTHING_SENTENCE in told
    is_written = any((folder / OUTPUT).iterdir())
    return [] if is_told or is_written else [f"the result is lost: {told[-300:]}"]


def _differences(folder: Path, wanted: dict[str, Any]) -> list[str]:
    """Describe the results that differ from those of an undisturbed call."""
    found, names = results_of(folder), sorted(wanted)
    faults = [f"{name} is missing" for name in names if name not in found]
    faults += [f"{name} is left over" for name in found if name not in wanted]
    differ = [name for name in names if name in found and found[name] != wanted[name]]
    return faults + [f"{name} differs" for name in differ]
