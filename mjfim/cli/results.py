"""`mjfim export`, `mjfim report` and `mjfim replay`: what is made from a folder of results."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentOfDesign,
    Force,
    Pictures,
    claim_file,
    claim_folder,
    experiment_of,
    keep_result,
    verb,
)
from mjfim.cli.progress import progress, say
from mjfim.errors import RecordingError
from mjfim.files import replacing
from mjfim.output.export import TARGETS
from mjfim.output.page import REPORT, PictureFormat


@verb()
def export(
    design_folder: Annotated[
        Path,
        typer.Argument(metavar="DESIGN", help="Folder of a design, or its design.npz."),
    ],
    to: Annotated[
        str,
        typer.Option("--to", metavar="TARGET", help=f"What is written: {', '.join(TARGETS)}."),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="PATH", help="File to write, or folder of a bag or dataset."
        ),
    ],
    positions: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help="Positions of a joint trajectory: motion (as planned) or command (of position "
            "servos); default: command where every driven joint has a position servo.",
        ),
    ] = None,
    storage: Annotated[str, typer.Option(help="Format of a bag: mcap or sqlite3.")] = "mcap",
    unit: Annotated[
        str, typer.Option(help="Unit of angles in a LeRobot dataset: rad or deg.")
    ] = "rad",
    experiment: ExperimentOfDesign = None,
    force: Force = False,
) -> None:
    """Write a design for ROS 2 or LeRobot, or as a stand-alone Python program that plays it."""
    from mjfim.experiment.packing import input_files
    from mjfim.experiment.system import System
    from mjfim.output.export.design import (
        exported_files,
        is_folder,
        require_options,
        write_export,
    )
    from mjfim.output.export.trajectories import RobotPlan

    require_options(to, positions, storage, unit)
    file = design_folder / "design.npz" if design_folder.is_dir() else design_folder
    stated = experiment_of(file, experiment)
    inputs = input_files(stated, [design_folder])
    if is_folder(to):
        claim_folder(output, exported_files(to, output), inputs, force=force)
    else:
        claim_file(output, inputs, force=force)

    with progress("exporting"):
        design = mjfim.Design.load(file)
        plan = RobotPlan.of(design, System.resolve(stated), file)
        keep_result(output if is_folder(to) else output.parent)
        remarks = write_export(plan, output, to, positions, storage, unit)

    for sentence in remarks:
        say(f"note: {sentence}")
    say(f"wrote {output}{'/' if is_folder(to) else ''}")


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


@verb()
def replay(
    source: Annotated[
        Path, typer.Argument(metavar="DIR | FILE.rrd | DESIGN.npz", help="What to show.")
    ],
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a file instead of opening the viewer."),
    ] = None,
    experiment: ExperimentOfDesign = None,
    force: Force = False,
) -> None:
    """Show a result in the Rerun viewer."""
    from mjfim.experiment.system import System, labels_of_system
    from mjfim.output import archive, rerun
    from mjfim.output.folders import find_rerun_file

    target = save or Path(tempfile.mkdtemp(prefix="mjfim-")) / "replay.rrd"
    if save is not None:
        if save.suffix != ".rrd":
            raise RecordingError(f"--save {save}: a Rerun file ends in .rrd")
        inputs = sorted(source.iterdir()) if source.is_dir() else [source]
        claim_file(save, inputs, force=force)
    if source.suffix == ".npz":
        system = System.resolve(experiment_of(source, experiment))
        named = archive.read_design(source, system)
        rerun.log_trajectories(
            target, system.model_at(system.theta), named, labels_of_system(system)
        )
    else:
        found = find_rerun_file(source)
        if save is None:
            target = found
        else:
            with replacing(save) as temporary:
                shutil.copyfile(found, temporary)
    if save is None:
        rerun.show(target)
    else:
        say(f"wrote {target}")
