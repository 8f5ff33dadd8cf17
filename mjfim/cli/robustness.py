"""`mjfim robustness`: a design on simulated robots that differ from the model."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.amounts import MAX_NOISE, MAX_WRONG
from mjfim.cli.common import (
    ExperimentFile,
    Force,
    Pictures,
    Verbose,
    claim_folder,
    errors,
    out,
    progress,
    say_written,
    verb,
    writing,
)
from mjfim.cli.executors import LOCAL, ExecutorPlace, started_executor, stated_executor
from mjfim.errors import ExperimentError
from mjfim.output.picture_format import PictureFormat

# Largest number of robots; more would take days.
MAX_RUNS = 100_000

# Default reserve of a design, as fractions of half ranges. The servo arm needs these for parameters
# that are wrong by 20 %.
DEFAULT_RESERVE = ("position=0.05", "velocity=0.3", "force=0.25")


@verb
def robustness(
    experiment: ExperimentFile,
    design_folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="DESIGN_FOLDER", help="Folder of a design; default: a new design is made."
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results.")
    ] = Path("out/robustness"),
    runs: Annotated[int, typer.Option(min=1, max=MAX_RUNS, help="Number of robots.")] = 100,
    wrong: Annotated[
        float,
        typer.Option(
            help=f"Relative error of the nominal value of every parameter, from 0 to {MAX_WRONG:g}."
        ),
    ] = 0.2,
    latency: Annotated[
        float | None,
        typer.Option(
            help="Delay of the control in seconds, a multiple of the timestep; default: 0.005, "
            "rounded up."
        ),
    ] = None,
    feedback: Annotated[
        bool,
        typer.Option("--feedback", help="The controller adds the gains times the deviation."),
    ] = False,
    noise: Annotated[
        float,
        typer.Option(
            help=f"Ratio of the robots' noise to the stated noise, from 0 to {MAX_NOISE:g}."
        ),
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes; default: one per core.")
    ] = None,
    reserve: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND=SHARE",
            help=(
                "Distance of a new design from limits of a kind, as a fraction of half a range; "
                "may be given several times. Default: " + ", ".join(DEFAULT_RESERVE) + "."
            ),
        ),
    ] = None,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Play a design on simulated robots that differ from the model.

    The result says how many robots keep the limits, and how many of the 95 % intervals contain the
    true values.
    """
    from mjfim.cli.reserve import design_with_reserve, parse_reserve
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.output.folders import DESIGN_ARCHIVE, ROBUSTNESS_FILES
    from mjfim.output.presentation import describe
    from mjfim.output.text import render
    from mjfim.records.robustness import RobotConditions
    from mjfim.studies.robustness import assess_robustness, default_latency

    if reserve and design_folder is not None:
        raise ExperimentError(
            "--reserve is for a new design; leave out DESIGN_FOLDER, or leave out --reserve"
        )

    if jobs is not None and executor != LOCAL:
        raise ExperimentError(
            "--jobs states processes of this computer, and --executor another place; leave one of "
            "them out"
        )

    place = stated_executor(executor)
    stated = mjfim.Experiment.from_file(experiment)
    conditions = RobotConditions(
        wrong=wrong,
        latency=default_latency(stated) if latency is None else latency,
        feedback=feedback,
        loudness=noise,
        seed=seed,
    )
    conditions.check()

    # A new design stands in a folder of its own, below that of the study.
    new = [f"design/{name}" for name in DESIGN_ARCHIVE] if design_folder is None else []
    inputs = input_files(stated, [design_folder])
    claim_folder(output, (*pictures.files(ROBUSTNESS_FILES), *new), inputs, force=force)

    if design_folder is None:
        shares = parse_reserve(reserve or DEFAULT_RESERVE)
        design_folder = design_with_reserve(stated, shares, output / "design", place)

    begun = time.perf_counter()
    with started_executor(place, runs, jobs) as workers, progress("playing") as show:
        result = assess_robustness(
            stated,
            design_folder,
            conditions=conditions,
            runs=runs,
            callback=show,
            executor=workers,
        )
    seconds = time.perf_counter() - begun

    out.print(render(describe(result), verbose=verbose))
    with writing(output) as results:
        system = System.resolve(stated)
        results.write_result(output, result, system, pictures, {"seconds": seconds})
    say_written(output, f" ({result.runs} runs in {seconds:.0f} s)")
    if result.runs < runs:
        errors.print(f"mjfim: interrupted; only {result.runs} of {runs} robots are done")
    raise typer.Exit(0 if result.ok and result.runs == runs else 1)
