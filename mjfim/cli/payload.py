"""`mjfim payload`: mass and centre of mass of an unknown payload on a robot that is known."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, Run, verb
from mjfim.cli.progress import progress


@verb(without=("executor",))
def payload(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path],
        typer.Argument(metavar="RECORDING", help="Logs of the robot with the payload."),
    ],
    run: Run,
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
) -> None:
    """Estimate mass and centre of mass of an unknown payload on a known robot.

    It writes the files of `identify`, and `identified.xml` holds the payload. The exit code is 1 if
    the recordings show no payload, or where `identify` would exit with 1.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.experiment.packing import with_model
    from mjfim.output.folders import identified_models
    from mjfim.recordings.read import read_recording, recording_paths
    from mjfim.studies.payload import PayloadTask

    task = PayloadTask.of(
        with_model(stated),
        body=body,
        robot=None if robot is None else mjfim.Estimate.load(robot),
        size=size,
        threads=run.threads,
        source="the earlier estimate" if robot is None else f"the estimate in {robot}",
    )
    # All logs hold the same signals, whether the payload is there or not.
    system = task.system()
    paths = recording_paths(recordings, system.channels)
    unloaded = recording_paths(without or [], system.channels)
    models = identified_models(run.output, system.model_path)
    run.claim(mjfim.Estimate, stated, [*recordings, *(without or []), robot], models)

    with progress("reading"):
        logs = [read_recording(path, system.channels) for path in (*paths, *unloaded)]
    with progress("fitting the payload") as display:
        result, loaded = task.identify(
            logs[: len(paths)], without=logs[len(paths) :], callback=display
        )

    raise typer.Exit(run.finish(result, loaded))
