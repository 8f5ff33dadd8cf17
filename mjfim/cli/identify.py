"""`mjfim identify`: estimates of the parameters from recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import mjfim
from mjfim.amounts import MAX_SAMPLES
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Force,
    LiveView,
    Pictures,
    Threads,
    Verbose,
    VideoFile,
    claim_folder,
    claim_video,
    errors,
    print_result,
    progress,
    say_written,
    verb,
    watched,
    write_wanted_video,
    writing,
)
from mjfim.cli.executors import (
    LOCAL,
    MAX_PARTS,
    ExecutorPlace,
    started_if_stated,
    stated_executor,
)
from mjfim.errors import ExperimentError
from mjfim.output.picture_format import PictureFormat

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.records.estimate import Estimate, ParameterDraws


@verb
def identify(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path],
        typer.Argument(
            metavar="RECORDING",
            help="Logs: CSV, Parquet, npz, JSON, a ROS 2 bag, or a LeRobot dataset.",
        ),
    ],
    output: Folder,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            metavar="FILE",
            help="Log that is predicted instead of fitted; may be given several times.",
        ),
    ] = None,
    method: Annotated[
        str,
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
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    threads: Threads = None,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Estimate the parameters from recordings, with intervals, predictions and warnings."""
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.identification.identify import identify_system
    from mjfim.output import archive
    from mjfim.output.folders import estimate_files, parts_of_identified
    from mjfim.output.presentation import describe
    from mjfim.output.robot_samples import sample_files
    from mjfim.output.summaries.logs import describe_logs
    from mjfim.recordings.read import read_log, recording_paths
    from mjfim.studies.selection import select_terms_system

    place = stated_executor(executor)
    if method not in ("least_squares", "newton"):
        raise ExperimentError(f"--method {method!r}: valid: least_squares, newton")
    if select and method == "newton":
        raise ExperimentError("--select: fits with the method least_squares only, not newton")
    system = System.resolve(mjfim.Experiment.from_file(experiment), threads=threads)
    inputs = input_files(system.experiment, [*recordings, *(held_out or [])])
    logs = recording_paths(recordings, system.channels)
    held_out_logs = recording_paths(held_out or [], system.channels)
    names = (
        *estimate_files(len(logs), len(held_out_logs), select=select, samples=bool(samples)),
        *parts_of_identified(output, system.model_path),
        *sample_files(output, samples or 0, system.model_path),
    )
    claim_video(video, inputs, force=force)
    claim_folder(output, pictures.files(names), inputs, force=force)

    with progress("reading"):
        fitted = [read_log(path, system.channels) for path in logs]
        predicted = [read_log(path, system.channels) for path in held_out_logs]
    with (
        started_if_stated(place, MAX_PARTS) as workers,
        progress("fitting") as display,
        watched(live, system, display) as show,
    ):
        recorded = [log.recording for log in fitted]
        kept = [log.recording for log in predicted]
        if select:
            selected = select_terms_system(
                system, recorded, held_out=kept, callback=show, executor=workers
            )
            result, system = selected.estimate, selected.system
        else:
            result = identify_system(
                system,
                recorded,
                method="newton" if method == "newton" else "least_squares",
                held_out=kept,
                callback=show,
                executor=workers,
            )

    result, not_drawn = _with_draws(result, system, samples or 0, seed)
    summary = describe(result)
    if verbose:
        logs_read = describe_logs([log.summary for log in (*fitted, *predicted)])
        summary = replace(summary, parts=(*summary.parts, *logs_read.parts))
    values = archive.summary_with_origin(result, system, output)
    print_result(as_json, values, summary, verbose=verbose)
    with writing(output) as results:
        remarks = results.write_result(output, result, system, pictures)
    for sentence in (*not_drawn, *remarks):
        errors.print(f"warning: {sentence}", markup=False)
    write_wanted_video(video, system, result)
    say_written(output)
    is_good = result.success and not result.misfit and not result.interrupted
    raise typer.Exit(0 if is_good and not not_drawn else 1)


def _with_draws(
    result: Estimate, system: System, count: int, seed: int
) -> tuple[Estimate, tuple[str, ...]]:
    """Draw robots from the uncertainty of an estimate.

    A fit takes long, so that its result is kept where no robots can be drawn.

    Args:
        result: The estimate.
        system: The system that was identified.
        count: Number of robots; 0 for none.
        seed: Seed of the draws.

    Returns:
        The estimate with its draws, and the sentence that says why there are none.
    """
    import numpy as np

    from mjfim.identification.parameter_draws import draw_parameters_system
    from mjfim.parallel.budget import run_optional

    if not count:
        return result, ()

    # Many bodies and robots take long, and Ctrl-C must not lose the fit.
    found: list[ParameterDraws] = []
    rng = np.random.default_rng(seed)
    try:
        with progress("drawing robots"):
            run_optional(lambda: found.append(draw_parameters_system(system, result, count, rng)))
    except ExperimentError as error:
        return result, (f"--samples: no robots were drawn: {error}",)
    if not found:
        return result, (
            "--samples: no robots were drawn, because the run was interrupted; in Python, "
            "mjfim.draw_parameters draws them from this estimate",
        )
    return replace(result, draws=replace(found[0], seed=seed)), ()
