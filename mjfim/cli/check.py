"""`mjfim check`, `rehearse` and `worth`: what a motion tells, its safety, and what would help."""

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
    experiment_of,
    verb,
)
from mjfim.cli.progress import progress
from mjfim.errors import MAX_ROBOTS, ExperimentError


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
) -> int:
    """Say which parameters can be identified, how accurately, and which only in combination."""
    stated = mjfim.Experiment.from_file(experiment)
    if run.output:
        draw_elsewhere()

    from mjfim.experiment.given import recordings_of
    from mjfim.experiment.system import System
    from mjfim.output import archive

    system = System.resolve(stated, threads=run.threads)
    with progress("reading"):
        loaded = recordings_of(system, recordings or [])
    trajectory = None
    if design_file is not None:
        trajectory = archive.read_design(design_file, system)["final"]
    run.claim(mjfim.Check, stated, [*(recordings or []), design_file])

    with run.workers() as workers, progress("checking"):
        result = mjfim.check(stated, loaded, trajectory, threads=run.threads, executor=workers)

    return run.finish(result, system, design=design_file and design_file.parent)


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
) -> int:
    """Play a design on simulated robots that differ from the model, and say whether it is safe."""
    changed = {
        "robots": robots,
        "wrong": wrong,
        "latency": latency,
        "feedback": feedback or None,
        "seed": seed,
    }
    stated = experiment_of(design_file, experiment).replace(
        rehearsal={key: value for key, value in changed.items() if value is not None}
    )

    from mjfim.experiment.system import System

    run.claim(mjfim.Rehearsal, stated, [design_file])
    with progress("playing the design"):
        result = mjfim.rehearse(stated, mjfim.Design.load(design_file), threads=run.threads)
    return run.finish(result, System.resolve(stated), design=design_file.parent)


@verb(without=("executor",), needs_folder=False)
def worth(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="DESIGN|EXPERIMENT",
            help="Folder of `mjfim design`, its file design.npz, or an experiment file (TOML), "
            "whose initial control is played then.",
        ),
    ],
    run: Run,
    experiment: ExperimentOfDesign = None,
    add: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SENSOR=SIGMA",
            help="Sensor that the model lacks, and its noise [SI unit]: torque, acceleration (all "
            "joints) or torque:JOINT; gyro:PLACE, accelerometer:PLACE, force:PLACE, moment:PLACE "
            "at a site or body. Several times for several sensors.",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(min=0.0, help="Time in which new designs check the prices of limits."),
    ] = 60.0,
) -> None:
    """Say which sensor, which data and which limit would make the parameters more accurate."""
    from mjfim.experiment.system import System

    is_design = source.is_dir() or source.suffix == ".npz"
    file = source / "design.npz" if source.is_dir() else source
    stated = experiment_of(file, experiment if is_design else experiment or source)
    design = mjfim.Design.load(file) if is_design else None
    added = dict(map(_sensor, add or []))
    if run.output:
        draw_elsewhere()
    run.claim(mjfim.Worth, stated, [file])
    with progress("comparing"):
        result = mjfim.worth(stated, design, add=added, seconds=seconds, threads=run.threads)
    run.finish(result, System.resolve(stated), design=file.parent if is_design else None)


def _sensor(text: str) -> tuple[str, float]:
    """Read a sensor and its noise."""
    name, _, sigma = text.partition("=")
    try:
        value = float(sigma)
    except ValueError:
        value = 0.0
    if not value > 0.0:
        raise ExperimentError(f"--add {text}: expected SENSOR=SIGMA, for example torque=0.1")
    return name, value
