"""`mjfim report`: the report of a folder of results, made again from its files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mjfim.cli.common import Force, Pictures, claim_file, keep_result, verb
from mjfim.cli.progress import say
from mjfim.output.page import REPORT, PictureFormat


@verb()
def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of results of any verb.")],
    missing: Annotated[
        bool,
        typer.Option(
            "--pictures",
            help="Also draw the pictures that are missing, such as after Ctrl-C, or older than "
            "their results.",
        ),
    ] = False,
    pictures: Pictures = PictureFormat.PNG,
    force: Force = False,
) -> None:
    """Write the report of a folder of results again, without computing anything anew."""
    # The parts of a report take a while to import; other verbs need them only when they write.
    from mjfim.output.folders import missing_pictures, write_pictures
    from mjfim.output.report import kinds_in, write_report

    kinds_in(folder)
    drawn = missing_pictures(folder) if missing else {}

    # A picture that is older than its result is replaced, in whatever format it is.
    replaced = {folder / ending.file_of(name) for name in drawn for ending in PictureFormat}
    present = [path for path in sorted(folder.iterdir()) if path.name != REPORT]
    inputs = [path for path in present if path not in replaced]
    for file in (folder / REPORT, *(folder / pictures.file_of(name) for name in drawn)):
        claim_file(file, inputs, force=force)

    # From here on, files are there after Ctrl-C.
    keep_result(folder)
    for file in (write_report(folder), *write_pictures(folder, drawn, pictures)):
        say(f"wrote {file}")
