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


def main() -> NoReturn:
    """Entry point."""
    app(prog_name="mjfim")
    sys.exit(0)
