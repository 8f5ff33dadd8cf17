"""The command line: one function per verb.

Exit codes: 0 goal reached, or budget used up with a sound result; 1 the user must look at the
result; 2 misuse.
"""

from __future__ import annotations

import sys
from typing import NoReturn

from mjfim.cli import (  # noqa: F401 - each registers its verbs
    campaign,
    check,
    compare,
    compare_robots,
    design,
    export,
    identify,
    init,
    list,
    payload,
    replay,
    report,
    robustness,
    simulate,
    validate,
)
from mjfim.cli.common import app, permit_processes, replace_unencodable_characters

# Verbs in the order in which the help lists them, which is the order of an experiment.
ORDER = (
    "init",
    "list",
    "validate",
    "check",
    "design",
    "simulate",
    "identify",
    "payload",
    "montecarlo",
    "compare",
    "compare-robots",
    "robustness",
    "campaign",
    "export",
    "report",
    "replay",
)


def _place(name: str | None) -> int:
    """Return the position of a verb in the help; verbs that ORDER does not name come last."""
    return ORDER.index(name) if name in ORDER else len(ORDER)


app.registered_commands.sort(key=lambda command: _place(command.name))


def main() -> NoReturn:
    """Run the command line, the entry point of `mjfim`."""
    replace_unencodable_characters()
    permit_processes()
    app(prog_name="mjfim")
    sys.exit(0)
