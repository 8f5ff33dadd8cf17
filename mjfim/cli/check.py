"""`mjfim check` and `mjfim rehearse`: what a motion tells, and whether it is safe."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    DesignFile,
    ExperimentFile,
    ExperimentOfDesign,
    OtherDesign,
    Run,
    draw_elsewhere,
    verb,
)
from mjfim.cli.progress import progress
from mjfim.errors import MAX_ROBOTS


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


@verb(without=("executor",), needs_folder=False)
def rehearse(
    design_file: DesignFile,
    run: Run,
    experiment: ExperimentOfDesign = None,
    robots: Annotated[
        int | None,
        typer.Option(min=0, max=MAX_ROBOTS, help="Number of robots; overrides rehearsal.robots."),
    ] = None,
    wrong: Annotated[
        float | None,
        typer.Option(
            min=0.0, help="How wrong the model may be: 0.2 is ±20 %. Overrides rehearsal.wrong."
        ),
    ] = None,
    latency: Annotated[
        float | None,
        typer.Option(min=0.0, help="Delay in seconds under feedback; overrides rehearsal.latency."),
    ] = None,
    feedback: Annotated[
        bool,
        typer.Option("--feedback", help="The controller adds the gains times the deviation."),
    ] = False,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the robots; overrides rehearsal.seed.")
    ] = None,
) -> None:
    """Play a design on simulated robots that differ from the model, and say whether it is safe."""
    from mjfim.output.folders import find_experiment_file

    stated = mjfim.Experiment.from_file(experiment or find_experiment_file(design_file))
    changed = {"robots": robots, "wrong": wrong, "latency": latency, "seed": seed}
    changed |= {"feedback": feedback or None}
    stated = stated.replace(
        rehearsal={key: value for key, value in changed.items() if value is not None}
    )

    from mjfim.experiment.system import System

    design = mjfim.Design.load(design_file)
    run.claim(mjfim.Rehearsal, stated, [design_file])
    with progress("playing the design"):
        result = mjfim.rehearse(stated, design, threads=run.threads)
    raise typer.Exit(run.finish(result, System.resolve(stated), design=design_file.parent))
