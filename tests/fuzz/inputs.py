"""Bad inputs through the command line: exit code 0, 1 or 2, one message, nothing half-written."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from mjfim.files import replacing
from mjfim.output.plots import draw
from mjfim.parallel.budget import LAST_SECONDS
from tests.fuzz.bad_inputs import Call
from tests.fuzz.odd_inputs import bad_input, long_log, no_permission
from tests.fuzz.outcome import TIME_LIMITS, Case, Outcome, announce
from tests.fuzz.result_files import PIXEL, faults_in
from tests.support.cli import PROCESS, write_experiment
from tests.support.cli import run as run_here

# Share of the calls that run in a new process; the others run in the process of the suite.
NEW_PROCESS = 0.04

# What `prctl` calls to take a right (capability) from programs that are started, and the rights to
# write, and to read and search, where permissions forbid it.
DROP_RIGHT, RIGHTS_BEYOND_PERMISSIONS = 24, (1, 2)

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
    spoils = {"permission": no_permission, "log": long_log}
    spoil = spoils.get(case.kind, bad_input)
    # Linux takes the rights of root away.
    may_be_refused = sys.platform == "linux" or (hasattr(os, "geteuid") and os.geteuid() != 0)
    if case.kind == "permission" and not may_be_refused:
        reason = "skipped: this user may do everything"
        return Outcome(case=case, group="skipped", description=reason)
    for name in STUDY:
        shutil.copy(valid_study() / name, folder)
    call = spoil(rng, folder)
    is_new = rng.random() < NEW_PROCESS or call.room is not None or not call.has_home
    is_new |= case.kind in ("permission", "log")
    description = f"{call.words[0] if call.words else ''}: {call.spoiled}"
    announce(description)

    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    ending = in_new_process(call, folder, case.kind) if is_new else in_this_process(call, folder)
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
    make_study(folder, folder, max_iterations="2")
    return folder


def make_study(folder: Path, designed: Path, **lines: str) -> None:
    """Write a valid study, its design into a folder of its own, and a recording of it.

    Args:
        folder: Folder of the study.
        designed: Folder of the design.
        **lines: Values of keys of the experiment file.
    """
    file = write_experiment(folder, **lines)
    for words in (
        ("design", file, "-o", designed, "--threads", 1),
        ("simulate", file, designed / "design.npz", "-o", folder / "run.csv"),
    ):
        result = run_here(*words)
        if result.exit_code not in (0, 1):
            raise RuntimeError(f"the valid study fails: {result.stderr}")


def _save_pixel(figure: object, path: Path, dpi: float = 0.0) -> Path:
    """Write a picture of one pixel in place of a figure, which takes seconds to draw."""
    with replacing(path) as temporary:
        temporary.write_bytes(PIXEL)
    return path


def in_this_process(call: Call, folder: Path) -> Ending:
    """Call the command line in this process, with figures of one pixel."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings(record=True) as warned:
        patch.chdir(folder)
        patch.setattr(draw, "save", _save_pixel)
        warnings.simplefilter("always")
        result = run_here(*call.words)

    fault = "; ".join(
        f"{w.category.__name__}: {w.message} ({w.filename}:{w.lineno})" for w in warned
    )
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        lines = traceback.format_exception(result.exception)
        fault = "Traceback: " + "".join(lines[-5:]).strip()
    return Ending(code=result.exit_code, errors=result.stderr, results=result.stdout, fault=fault)


def in_new_process(call: Call, folder: Path, kind: str) -> Ending:
    """Call the command line in a new process, with a time limit."""
    with (
        _forbidden(call.forbidden),
        subprocess.Popen(
            [*PROCESS, *call.words],
            cwd=folder,
            env=dict(os.environ) if call.has_home else _without_home(folder),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            preexec_fn=functools.partial(_restrict, call) if hasattr(os, "fork") else None,
        ) as process,
    ):
        limit = TIME_LIMITS[kind] - 5.0
        try:
            if call.patience is not None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(call.patience)
                process.terminate()
                limit = LAST_SECONDS + 15.0
            results, errors = process.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            process.kill()
            results, errors = process.communicate()
            return Ending(code=process.returncode, errors=errors, fault="no end within the limit")
    return Ending(code=process.returncode, errors=errors, results=results)


def _without_home(folder: Path) -> dict[str, str]:
    """The environment without a home folder, and without folders for the settings of programs."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "MPL"))}
    home = folder / "home" if (folder / "home").is_dir() else "/dev/null/home"
    return {**kept, "HOME": str(home), "MPLBACKEND": "Agg"}


@contextlib.contextmanager
def _forbidden(paths: tuple[Path, ...]) -> Iterator[None]:
    """Forbid meanwhile to write in folders and to read files."""
    modes = {path: path.stat().st_mode for path in paths}
    try:
        for path in paths:
            path.chmod(0o555 if path.is_dir() else 0)
        yield
    finally:
        for path, mode in modes.items():
            path.chmod(stat.S_IMODE(mode))


def _restrict(call: Call) -> None:
    """Limit what this process may do: sizes of files, memory, and the rights of root."""
    import resource

    if call.room is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (call.room, call.room))
    if call.memory is not None:
        resource.setrlimit(resource.RLIMIT_DATA, (call.memory, call.memory))
    if call.forbidden and os.geteuid() == 0:
        library = ctypes.CDLL(None)
        for right in RIGHTS_BEYOND_PERMISSIONS:
            library.prctl(DROP_RIGHT, right, 0, 0, 0)


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
    return found + faults_in(set(folder.rglob("*")) - set(before))
