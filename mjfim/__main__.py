"""`python -m mjfim` and the command `mjfim`: reacts to Ctrl-C while the program is imported."""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import NoReturn

from mjfim.interruption import INTERRUPTED_CODE, NOTHING_SENTENCE, SIGNALS


def main() -> NoReturn:
    """Run the command line, the entry point of `mjfim`."""
    # A process that ignores Ctrl-C continues to ignore it.
    handled = callable(signal.getsignal(signal.SIGINT))
    for number in SIGNALS if handled else ():
        signal.signal(number, _end_at_once)

    from mjfim.cli.main import main as run_command_line

    # Verbs have a handler of their own. After a verb, the program ends by itself.
    try:
        run_command_line()
    finally:
        for number in SIGNALS if handled else ():
            signal.signal(number, signal.SIG_IGN)


def _end_at_once(number: int, frame: FrameType | None) -> None:
    """End the process; there is nothing to write or to tidy up yet."""
    os.write(2, f"mjfim: {NOTHING_SENTENCE}\n".encode())
    os._exit(INTERRUPTED_CODE)


if __name__ == "__main__":
    main()
