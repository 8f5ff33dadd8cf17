"""`mjfim check`: which parameters can be identified, and how accurately."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Force,
    OtherDesign,
    Pictures,
    Threads,
    Verbose,
    claim_folder,
    draw_elsewhere,
    print_result,
    progress,
    say_written,
    verb,
    writing,
)
from mjfim.cli.executors import (
    LOCAL,
    MAX_PARTS,
    ExecutorPlace,
    started_if_stated,
    stated_executor,
)
from mjfim.output.picture_format import PictureFormat

if TYPE_CHECKING:
    pass


@verb
def check(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="RECORDING", help="Recordings to check instead of the initial control."
        ),
    ] = None,
    design_file: OtherDesign = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Folder for check.json, report.html and pictures."
        ),
    ] = None,
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    threads: Threads = None,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Say which parameters can be identified, how accurately, and which only in combination."""
    if output is not None:
        draw_elsewhere()
    from mjfim.excitation.task_parts import require_design_keys
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.output import archive
    from mjfim.output.folders import CHECK_FILES
    from mjfim.output.presentation import describe
    from mjfim.recordings.read import read_recording, recording_paths

    place = stated_executor(executor)
    stated = mjfim.Experiment.from_file(experiment)
    system = System.resolve(stated, threads=threads)
    with progress("reading"):
        logs = recording_paths(recordings or [], system.channels)
        loaded = [read_recording(path, system.channels) for path in logs]
    trajectory = None
    if design_file is not None:
        trajectory = archive.read_design(design_file)["final"]
        archive.check_fits(design_file, trajectory, system)
    if output is not None:
        inputs = input_files(stated, [*(recordings or []), design_file])
        claim_folder(output, pictures.files(CHECK_FILES), inputs, force=force)

    if not loaded and trajectory is None:
        require_design_keys(system, "check without recordings")
    with started_if_stated(place, MAX_PARTS) as workers, progress("checking"):
        result = mjfim.check(stated, loaded, trajectory, threads=threads, executor=workers)

    values = archive.summary_with_origin(result, system, output)
    print_result(as_json, values, describe(result), verbose=verbose)
    if output is not None:
        with writing(output) as results:
            results.write_result(output, result, system, pictures)
        say_written(output)
    raise typer.Exit(0 if result.ok else 1)
