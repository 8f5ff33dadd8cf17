"""The command line: one function per verb.

Exit codes: 0 done, 1 ran but did not reach its goal, 2 misuse.
"""

from __future__ import annotations

import sys
from typing import NoReturn

from mjfim.cli import (  # noqa: F401 - each registers its verbs
    campaign,
    check,
    compare,
    design,
    export_sysid,
    identify,
    replay,
    robustness,
    simulate,
)
from mjfim.cli.common import app

# Verbs in the order of an experiment, in which the help lists them; further ones come last.
ORDER = (
    "check",
    "design",
    "simulate",
    "identify",
    "montecarlo",
    "compare",
    "robustness",
    "campaign",
    "export-sysid",
    "replay",
)


def _place(name: str | None) -> int:
    """Return the place of a verb in the help."""
    return ORDER.index(name) if name in ORDER else len(ORDER)


app.registered_commands.sort(key=lambda command: _place(command.name))


def main() -> NoReturn:
    """Entry point."""
    app(prog_name="mjfim")
    sys.exit(0)
