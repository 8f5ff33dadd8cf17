"""The command line: one function per verb."""

from __future__ import annotations

import importlib
import sys
from typing import NoReturn

from mjfim.cli.common import FILES, ORDER, app, permit_processes
from mjfim.cli.progress import lose_what_cannot_be_written


def load_verbs() -> None:
    """Import the file of the given verb, which registers it; without one, those of all verbs."""
    given = sys.argv[1:2]
    for name in given if given and given[0] in ORDER else ORDER:
        importlib.import_module(f"mjfim.cli.{FILES.get(name, name)}")

    # Files register their verbs together; the help shows them in the order of an experiment.
    app.registered_commands.sort(key=lambda command: ORDER.index(str(command.name)))


load_verbs()


def main() -> NoReturn:
    """Run the command line, the entry point of `mjfim`."""
    lose_what_cannot_be_written()
    permit_processes()
    load_verbs()
    app(prog_name="mjfim")
    sys.exit(0)
