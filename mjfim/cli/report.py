"""`mjfim report`: the report of a folder of results, made again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mjfim.cli.common import Force, claim_file, errors, verb
from mjfim.output.report import is_report


@verb
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of results of any verb.")],
    force: Force = False,
) -> None:
    """Write the reports of a folder of results again, without computing anything anew."""
    # The parts of a report take a while to import; other verbs need them only when they write.
    from mjfim.output.report.build import report_files, rewrite_reports

    files = report_files(folder)
    inputs = [path for path in sorted(folder.iterdir()) if not is_report(path)]
    for file in files.values():
        claim_file(file, inputs, force=force)

    for file in rewrite_reports(folder):
        errors.print(f"wrote {file}", markup=False)
