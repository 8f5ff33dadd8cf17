"""`mjfim worth`: which sensor, which data and which limit would help."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentOfDesign, Run, draw_elsewhere, verb
from mjfim.cli.progress import progress
from mjfim.errors import ExperimentError


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
    from mjfim.output.folders import find_experiment_file

    is_design = source.is_dir() or source.suffix == ".npz"
    file = source / "design.npz" if source.is_dir() else source
    stated = mjfim.Experiment.from_file(
        experiment or (find_experiment_file(file) if is_design else source)
    )
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
