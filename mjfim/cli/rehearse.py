"""`mjfim rehearse`: a design on simulated robots that differ from the model."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import DesignFile, ExperimentOfDesign, Run, verb
from mjfim.cli.progress import progress
from mjfim.errors import MAX_ROBOTS


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
