"""`python -m mjfim` and the command `mjfim`.

Reacts to signals while the program is imported, and takes no code from the current folder, which
may hold a file `signal.py` beside the experiment.
"""

import os
import sys

# Folder from which this package is imported.
HOME = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))

# `python -m` searches modules in the current folder first. This comes before all other imports.
if sys.path and os.path.realpath(sys.path[0]) == os.path.realpath(os.curdir) != HOME:
    del sys.path[0]

# Processes that libraries start shall not search there either.
os.environ["PYTHONSAFEPATH"] = "1"

import signal  # noqa: E402
from contextlib import suppress  # noqa: E402
from types import FrameType  # noqa: E402
from typing import NoReturn  # noqa: E402

from mjfim.parallel.budget import (  # noqa: E402
    INTERRUPTED_CODE,
    NOTHING_SENTENCE,
    SIGNALS,
    heard_signals,
)


def main() -> NoReturn:
    """Run the command line, the entry point of `mjfim`."""
    for number in heard_signals():
        signal.signal(number, _end_at_once)

    # No file gets the number of stdin, stdout or stderr where they are closed.
    while (file := os.open(os.devnull, os.O_RDONLY)) <= 2:
        os.set_inheritable(file, True)
    os.close(file)

    _limit_memory()
    from mjfim.cli.main import main as run_command_line

    # Verbs have a handler of their own. After a verb, the program ends by itself.
    try:
        run_command_line()
    finally:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


def _limit_memory() -> None:
    """Let work that needs more memory than the computer has fail, before the computer stands still.

    Workers have the same limit. Systems without it, such as Windows, are left as they are.
    """
    with suppress(ImportError, AttributeError, OSError, ValueError):
        import resource

        most = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        if soft == resource.RLIM_INFINITY or soft > most:
            resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def _end_at_once(number: int, frame: FrameType | None) -> None:
    """End the process; there is nothing to write or to tidy up yet."""
    with suppress(OSError):
        os.write(2, f"mjfim: {NOTHING_SENTENCE}\n".encode())
    os._exit(INTERRUPTED_CODE)


if __name__ == "__main__":
    main()
