"""`mjfim report`: the report of a folder of results, made again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mjfim.cli.common import Force, claim_file, errors, verb
from mjfim.output.report import REPORT


@verb
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of results of any verb.")],
    force: Force = False,
) -> None:
    """Write report.html of a folder of results again, without computing anything anew."""
    # The parts of a report take a while to import; other verbs need them only when they write.
    from mjfim.output.report.build import newest_kind, rewrite_report

    newest_kind(folder)
    inputs = [path for path in sorted(folder.iterdir()) if path.name != REPORT]
    claim_file(folder / REPORT, inputs, force=force)

    errors.print(f"wrote {rewrite_report(folder)}", markup=False)
