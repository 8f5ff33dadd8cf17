"""Bad inputs through the command line: exit code 0, 1 or 2, one message, nothing half-written."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import subprocess
import tempfile
import traceback
import warnings
from dataclasses import dataclass
from pathlib import Path

from mjfim.files import replacing
from mjfim.output.plots import draw
from tests.fuzz.bad_inputs import Call, bad_input
from tests.fuzz.faults import fault
from tests.fuzz.outcome import TIME_LIMITS, Case, Outcome
from tests.fuzz.result_files import PIXEL, faults_of, is_temporary
from tests.fuzz.workers import announce
from tests.support.cli import PROCESS, write_experiment
from tests.support.cli import run as run_here

# Share of the calls that run in a new process; the others run in the process of the suite.
NEW_PROCESS = 0.04

# Longest message of a refusal [characters].
LONGEST_MESSAGE = 600

# Files of the valid study.
STUDY = ("study.toml", "cart_pendulum.xml", "cart_pendulum.csv", "run.csv", "design.npz")


@dataclass(frozen=True, kw_only=True)
class Ending:
    """How a call ended.

    Attributes:
        code: Exit code.
        errors: What it wrote to stderr.
        results: What it wrote to stdout.
        fault: Traceback or Python warning, which no user should see; empty without one.
    """

    code: int
    errors: str
    results: str = ""
    fault: str = ""


def run(case: Case, folder: Path) -> Outcome:
    """Spoil something, call the command line, and judge how it ends."""
    rng = case.rng
    spoil = fault if case.kind == "fault" else bad_input
    for name in STUDY:
        shutil.copy(valid_study() / name, folder)
    call = spoil(rng, folder)
    is_new = rng.random() < NEW_PROCESS or call.room is not None or not call.has_home
    description = f"{call.words[0] if call.words else ''}: {call.spoiled}"
    announce(description)

    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    ending = in_new_process(call, folder) if is_new else in_this_process(call, folder)
    complaints = [*judge(call, ending), *changes(folder, before)]
    return Outcome(
        case=case,
        group=f"exit {ending.code}",
        description=description,
        complaint="; ".join(complaints),
    )


@functools.cache
def valid_study() -> Path:
    """Folder with the files of a valid study, made once in each process."""
    folder = Path(tempfile.mkdtemp(dir=Path.cwd()))
    file = write_experiment(folder, max_iterations="2")
    for words in (
        ("design", file, "-o", folder, "--threads", 1),
        ("simulate", file, folder / "design.npz", "-o", folder / "run.csv"),
    ):
        result = run_here(*words)
        if result.exit_code not in (0, 1):
            raise RuntimeError(f"the valid study fails: {result.stderr}")
    return folder


def _save_pixel(figure: object, path: Path, dpi: float = 0.0) -> Path:
    """Write a picture of one pixel in place of a figure, which takes seconds to draw."""
    with replacing(path) as temporary:
        temporary.write_bytes(PIXEL)
    return path


def in_this_process(call: Call, folder: Path) -> Ending:
    """Call the command line in this process, with figures of one pixel."""
    home, save = Path.cwd(), draw.save
    os.chdir(folder)
    draw.save = _save_pixel
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            result = run_here(*call.words)
    finally:
        draw.save = save
        os.chdir(home)

    fault = "; ".join(
        f"{w.category.__name__}: {w.message} ({w.filename}:{w.lineno})" for w in warned
    )
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        lines = traceback.format_exception(result.exception)
        fault = "Traceback: " + "".join(lines[-5:]).strip()
    return Ending(code=result.exit_code, errors=result.stderr, results=result.stdout, fault=fault)


def in_new_process(call: Call, folder: Path) -> Ending:
    """Call the command line in a new process, with a time limit."""
    with subprocess.Popen(
        [*PROCESS, *call.words],
        cwd=folder,
        env=dict(os.environ) if call.has_home else _without_home(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        preexec_fn=None if call.room is None else functools.partial(_limit_files, call.room),
    ) as process:
        try:
            results, errors = process.communicate(timeout=TIME_LIMITS["input"] - 5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            results, errors = process.communicate()
            return Ending(code=process.returncode, errors=errors, fault="no end within the limit")
    return Ending(code=process.returncode, errors=errors, results=results)


def _without_home() -> dict[str, str]:
    """The environment without a home folder, and without folders for the settings of programs."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "MPL"))}
    return {**kept, "HOME": "/dev/null/home", "MPLBACKEND": "Agg"}


def _limit_files(room: int) -> None:
    """Limit the size of the files that this process writes. room: the limit [bytes]."""
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))


def judge(call: Call, ending: Ending) -> list[str]:
    """Describe what is wrong with the ending of a call."""
    found = [ending.fault] if ending.fault else []
    errors = ending.errors.strip()
    if "Traceback" in errors and not ending.fault:
        found.append("Traceback: " + "\n".join(errors.splitlines()[-5:]))
    if ending.code not in (0, 1, 2):
        found.append(f"exit code {ending.code}")
    if found:
        return found

    if ending.code == 1 and not (errors or ending.results.strip()):
        found.append(f"exit code {ending.code} without a message")
    if ending.code == 0 and call.fails:
        found.append("exit code 0, although it cannot succeed")
    if ending.code == 2:
        found += _judge_refusal(errors)
        if call.accepted:
            found.append(f"refused: {errors[-300:]}")
    elif call.refused:
        found.append(f"accepted: exit code {ending.code} in place of a refusal: {errors[-200:]}")
    return found


def _judge_refusal(errors: str) -> list[str]:
    """Describe what is wrong with the message of a refusal."""
    own = re.findall(r"^mjfim: ", errors, flags=re.MULTILINE)
    is_usage = "Usage:" in errors or "─ Error ─" in errors
    if len(own) + is_usage != 1:
        return [f"{len(own)} messages: {errors[:300]}"]
    if len(errors) > LONGEST_MESSAGE and not is_usage:
        return [f"long message: {len(errors)} characters: {errors[:200]}"]
    return []


def changes(folder: Path, before: dict[Path, bytes]) -> list[str]:
    """Describe what is wrong with the files after a call.

    Args:
        folder: The folder.
        before: Content of the files before the call.
    """
    found = [
        f"{path.name} of the user was {'changed' if path.exists() else 'removed'}"
        for path, content in before.items()
        if not path.is_file() or path.read_bytes() != content
    ]
    for path in folder.rglob("*"):
        if not path.is_file() or path in before:
            continue
        found += faults_of(path)
        if is_temporary(path):
            found.append(f"{path.name} is a temporary file that stayed")
    return found
