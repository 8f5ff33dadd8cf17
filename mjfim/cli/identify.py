"""`mjfim identify` and `mjfim payload`: estimates of the parameters from recordings."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentFile,
    LiveView,
    Run,
    VideoFile,
    verb,
    write_wanted_video,
)
from mjfim.cli.progress import progress, watched
from mjfim.errors import MAX_SAMPLES, ExperimentError

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.records.estimate import Estimate


@verb()
def identify(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING",
            help="Logs: CSV, Parquet, npz, JSON, a ROS 2 bag, or a LeRobot dataset.",
        ),
    ],
    run: Run,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            metavar="FILE",
            help="Log that is predicted instead of fitted; may be given several times.",
        ),
    ] = None,
    method: Annotated[
        Literal["least_squares", "newton"],
        typer.Option(help="least_squares, which keeps bounds, or newton, the paper's method."),
    ] = "least_squares",
    select: Annotated[
        bool,
        typer.Option(
            "--select",
            help="Add terms that the model lacks, such as friction, as long as they improve the "
            "prediction of left-out data.",
        ),
    ] = False,
    predicted: Annotated[
        Path | None,
        typer.Option(
            "--predicted",
            metavar="DIR",
            help="Folder of the design or check whose predicted σ are shown beside the estimates.",
        ),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples",
            metavar="N",
            min=1,
            max=MAX_SAMPLES,
            help="Draw N robots from the uncertainty of the estimate, for domain randomisation, "
            "and write a table and a model for each of them.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the drawn robots.")] = 0,
    video: VideoFile = None,
    live: LiveView = None,
) -> int:
    """Estimate the parameters from recordings, with intervals, predictions and warnings."""
    stated = mjfim.Experiment.from_file(experiment)
    if select and method == "newton":
        raise ExperimentError("--select: fits with the method least_squares only, not newton")

    from mjfim.experiment.packing import with_model
    from mjfim.experiment.system import System
    from mjfim.output.folders import identified_models, sample_files
    from mjfim.output.pages.files import log_tables
    from mjfim.recordings.read import read_log, recording_paths
    from mjfim.records.check import Check
    from mjfim.records.design import Design

    stated = with_model(stated)  # it may be edited while it is identified
    prediction: Design | Check | None = None
    if predicted is not None:
        kind = Check if (predicted / "check.npz").is_file() else Design
        prediction = kind.load(predicted)
    system = System.resolve(stated, threads=run.threads)
    fitted_paths = recording_paths(recordings, system.channels.spec)
    held_out_paths = recording_paths(held_out or [], system.channels.spec)
    models = identified_models(run.output, system.model_path)
    drawn = sample_files(run.output) if samples else ()
    logs_read = [*recordings, *(held_out or [])]
    run.claim(mjfim.Estimate, stated, logs_read, (*models, *drawn), video)

    with progress("reading"):
        logs = [read_log(path, system.channels) for path in (*fitted_paths, *held_out_paths)]
    read = [recording for recording, _ in logs]
    fitted, kept = read[: len(fitted_paths)], read[len(fitted_paths) :]
    with (
        run.workers() as workers,
        progress("fitting") as display,
        watched(live, system, display) as show,
    ):
        estimated = mjfim.select_terms if select else partial(mjfim.identify, method=method)
        result = estimated(
            stated, fitted, held_out=kept, callback=show, threads=run.threads, executor=workers
        )
    if prediction is not None:
        result = result.with_prediction(prediction)
    if result.selection is not None:
        system = System.resolve(result.experiment, threads=run.threads)
    not_drawn = ""
    if samples:
        result, not_drawn = _with_draws(result, system, samples, seed)

    sections = {"Logs": log_tables([summary for _, summary in logs])} if run.verbose else {}
    remarks = [f"warning: --samples: no robots were drawn{not_drawn}"] if not_drawn else []
    code = run.finish(result, system, sections=sections, remarks=remarks)
    write_wanted_video(video, system, result)
    return code or int(bool(not_drawn))


def _with_draws(result: Estimate, system: System, count: int, seed: int) -> tuple[Estimate, str]:
    """Draw robots from the uncertainty of an estimate.

    Returns:
        The estimate, with the robots if they could be drawn. Beside it, the end of a warning that
        says why they were not drawn; empty if they were.
    """
    import numpy as np

    from mjfim.identification.assessment.parameter_draws import draw_parameters_system
    from mjfim.parallel.budget import run_optional

    # Drawing takes long for many bodies or robots, and Ctrl-C must not lose the fit.
    found = []
    rng = np.random.default_rng(seed)
    try:
        with progress("drawing robots"):
            run_optional(lambda: found.append(draw_parameters_system(system, result, count, rng)))
    except ExperimentError as error:
        return result, f": {error}"
    if not found:
        return result, (
            ", because the run was interrupted; in Python, mjfim.draw_parameters draws them from "
            "this estimate"
        )
    return replace(result, draws=replace(found[0], seed=seed)), ""


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
) -> int:
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
    paths = recording_paths(recordings, system.channels.spec)
    unloaded = recording_paths(without or [], system.channels.spec)
    models = identified_models(run.output, system.model_path)
    run.claim(mjfim.Estimate, stated, [*recordings, *(without or []), robot], models)

    with progress("reading"):
        logs = [read_recording(path, system.channels) for path in (*paths, *unloaded)]
    with progress("fitting the payload") as display:
        result, loaded = task.identify(
            logs[: len(paths)], without=logs[len(paths) :], callback=display
        )

    return run.finish(result, loaded)
