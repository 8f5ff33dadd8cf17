"""`mjfim check`: which parameters can be identified, and how accurately."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, OtherDesign, Run, draw_elsewhere, verb
from mjfim.cli.progress import progress


@verb(needs_folder=False)
def check(
    experiment: ExperimentFile,
    run: Run,
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RECORDING", help="Recordings to check instead of the initial control."
        ),
    ] = None,
    design_file: OtherDesign = None,
) -> None:
    """Say which parameters can be identified, how accurately, and which only in combination."""
    stated = mjfim.Experiment.from_file(experiment)
    if run.output:
        draw_elsewhere()

    from mjfim.experiment.given import check_fits, recordings_of
    from mjfim.experiment.system import System
    from mjfim.output import archive

    system = System.resolve(stated, threads=run.threads)
    with progress("reading"):
        loaded = recordings_of(system, recordings or [])
    trajectory = None
    if design_file is not None:
        trajectory = archive.read_design(design_file)["final"]
        check_fits(design_file, trajectory, system)
    run.claim(mjfim.Check, stated, [*(recordings or []), design_file])

    with run.workers() as workers, progress("checking"):
        result = mjfim.check(stated, loaded, trajectory, threads=run.threads, executor=workers)

    raise typer.Exit(run.finish(result, system, design=design_file and design_file.parent))
