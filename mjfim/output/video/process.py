"""The process that draws a film, which can be started before there is a film.

It takes some tenths of a second until it has imported what draws.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mjfim.output.video.record import NoVideoError

# Kinds of OpenGL contexts by system, in the order in which they are tried: without a display first.
BACK_ENDS = {"Linux": ("egl", "osmesa", "glfw")}
OTHER_BACK_ENDS = ("",)

# Program of the process. It searches modules in the same places as this one.
PROGRAM = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from mjfim.output.video.worker import main; main()"
)

# How many times its stated time a film may take until nobody waits for it any more.
PATIENCE = 2.0

# Exit code after an error of Python, as where a kind of context is not installed.
ERROR_CODE = 1

# On Windows, Ctrl-C does not reach a process that has a group of its own.
OWN_GROUP = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)

# Values of the variable MUJOCO_GL that turn drawing off.
TURNED_OFF = ("disable", "disabled", "off", "false", "0")

# Reason why there is no video; a complete part of a sentence.
IS_TURNED_OFF = "the variable MUJOCO_GL turns drawing off"

# The process that waits for a film, with its kind of context.
_waiting: dict[str, subprocess.Popen[bytes]] = {}


def back_ends() -> tuple[str, ...]:
    """List the kinds of contexts to try: that of the variable MUJOCO_GL, or those of the system.

    Raises:
        NoVideoError: The variable turns drawing off.
    """
    stated = os.environ.get("MUJOCO_GL", "").lower().strip()
    if stated in TURNED_OFF:
        raise NoVideoError(IS_TURNED_OFF)
    return (stated,) if stated else BACK_ENDS.get(platform.system(), OTHER_BACK_ENDS)


@contextmanager
def process_waiting() -> Iterator[None]:
    """Let a process wait for the first film that is drawn in the context, at whose end it ends.

    This has no effect where drawing is turned off, or no process can be started.
    """
    with ExitStack() as at_end:
        with suppress(NoVideoError):
            first = back_ends()[0]
            process = at_end.enter_context(_started(first))
            at_end.callback(process.kill)
            at_end.callback(_waiting.clear)
            _waiting[first] = process
        yield


def process_for(folder: Path, back_end: str) -> subprocess.Popen[bytes]:
    """Return a process that draws the film of a folder: the one that waits, or a new one.

    Args:
        folder: The folder.
        back_end: Kind of OpenGL context; empty for that of the system.

    Raises:
        NoVideoError: No process can be started.
    """
    process = _waiting.pop(back_end, None)

    # A process that was ended from outside says nothing about the kind of context.
    if process is None or process.poll() not in (None, ERROR_CODE):
        process = _started(back_end)
    assert process.stdin is not None

    # A process that has ended already leaves no result, as one that finds no context.
    with suppress(OSError):
        process.stdin.write(f"{json.dumps(str(folder))}\n".encode())
    return process


def _started(back_end: str) -> subprocess.Popen[bytes]:
    """Start a process, which waits for the name of a folder.

    Raises:
        NoVideoError: No process can be started.
    """
    environment = {**os.environ, "MUJOCO_GL": back_end}
    if back_end == "":
        environment.pop("MUJOCO_GL")

    # With a session or a group of the other process, Ctrl-C reaches only this one, which then ends
    # the other one.
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM, json.dumps(sys.path)],
            env=environment,
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            creationflags=OWN_GROUP,
        )
    except OSError as error:
        raise NoVideoError(f"the process that draws it cannot be started ({error})") from None
