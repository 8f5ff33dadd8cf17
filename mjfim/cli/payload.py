"""`mjfim payload`: mass and centre of mass of an unknown payload on a robot that is known."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Force,
    Pictures,
    Threads,
    Verbose,
    claim_folder,
    errors,
    print_result,
    progress,
    say_written,
    verb,
    writing,
)
from mjfim.errors import ExperimentError
from mjfim.output.picture_format import PictureFormat

# Options by the names of the arguments that their messages begin with.
OPTIONS = {"body": "--body", "size": "--size"}


@verb
def payload(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING", help="Logs of the robot with the payload."),
    ],
    output: Folder,
    body: Annotated[
        str | None,
        typer.Option(
            "--body",
            metavar="BODY",
            help="Body that carries the payload; default: the one at which the experiment states "
            "a term of the kind `payload`.",
            show_default=False,
        ),
    ] = None,
    robot: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="DIR",
            help="Folder of `mjfim identify` of the robot without the payload; its uncertainty "
            "becomes part of the payload's.",
        ),
    ] = None,
    without: Annotated[
        list[Path] | None,
        typer.Option(
            "--without",
            metavar="FILE",
            help="Log of the robot without the payload, from which its parameters are estimated "
            "first; may be given several times.",
        ),
    ] = None,
    size: Annotated[
        float | None,
        typer.Option(
            "--size",
            metavar="METRES",
            help="Edge of a cube with the payload's volume in metres, for its rotational inertia "
            "where the logs do not determine it. Default: a cube of water.",
            show_default=False,
        ),
    ] = None,
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    threads: Threads = None,
) -> None:
    """Estimate mass and centre of mass of an unknown payload on a known robot.

    It writes the files of `identify`, and `identified.xml` holds the payload. The exit code is 1 if
    the recordings show no payload, or where `identify` would exit with 1.
    """
    from mjfim.experiment.input_files import input_files
    from mjfim.output import archive
    from mjfim.output.folders import estimate_files, parts_of_identified
    from mjfim.output.presentation import describe
    from mjfim.recordings.read import read_log, recording_paths
    from mjfim.records.estimate import Estimate
    from mjfim.studies.payload import PayloadTask

    earlier = None if robot is None else Estimate.load(robot)
    try:
        task = PayloadTask.of(
            mjfim.Experiment.from_file(experiment),
            body=body,
            robot=earlier,
            size=size,
            threads=threads,
            source="the earlier estimate" if robot is None else f"the estimate in {robot}",
        )
    except ExperimentError as error:
        argument, separator, fault = str(error).partition(": ")
        if argument in OPTIONS:
            raise ExperimentError(f"{OPTIONS[argument]}{separator}{fault}") from None
        raise

    # All logs hold the same signals, whether the payload is there or not.
    system = task.system()
    inputs = input_files(system.experiment, [*recordings, *(without or []), robot])
    logs = recording_paths(recordings, system.channels)
    unloaded = recording_paths(without or [], system.channels)
    names = (
        *estimate_files(len(logs)),
        *parts_of_identified(output, system.model_path),
    )
    claim_folder(output, pictures.files(names), inputs, force=force)

    with progress("reading"):
        loaded = [read_log(path, system.channels).recording for path in logs]
        reference = [read_log(path, system.channels).recording for path in unloaded]
    with progress("fitting the payload") as display:
        found = task.identify(loaded, without=reference, callback=display)

    result = found.estimate
    values = archive.summary_with_origin(result, found.system, output)
    print_result(as_json, values, describe(result), verbose=verbose)
    with writing(output) as results:
        remarks = results.write_result(output, result, found.system, pictures)
    for sentence in remarks:
        errors.print(f"warning: {sentence}", markup=False)
    say_written(output)
    is_good = result.success and not result.misfit and not result.interrupted
    is_seen = result.payload is not None and result.payload.is_seen
    raise typer.Exit(0 if is_good and is_seen else 1)
