"""`mjfim export`: a design for the programs that run robots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentOfDesign, Force, claim_file, claim_folder, keep_result, verb
from mjfim.cli.progress import progress, say
from mjfim.output.export import TARGETS


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
    from mjfim.output.folders import find_experiment_file

    require_options(to, positions, storage, unit)
    file = design_folder / "design.npz" if design_folder.is_dir() else design_folder
    stated = mjfim.Experiment.from_file(experiment or find_experiment_file(file))
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
