"""`mjfim simulate` and `mjfim montecarlo`: synthetic recordings and the accuracy that they lead to."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    DesignFile,
    ExperimentFile,
    Folder,
    errors,
    print_result,
    progress,
    verb,
    writing,
)
from mjfim.errors import NoResultError
from mjfim.experiment.simulate import simulate_system
from mjfim.experiment.system import System
from mjfim.output import archive
from mjfim.output.folders import check_file, check_folder
from mjfim.output.summaries import describe_study
from mjfim.output.text import render
from mjfim.studies.monte_carlo import monte_carlo_system


@verb
def simulate(
    experiment: ExperimentFile,
    design_file: DesignFile,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.csv", help="Recording to write.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
) -> None:
    """Play a design on the model at its `true` values, with noise: a synthetic recording."""
    system = System.resolve(mjfim.Experiment.from_file(experiment))
    check_file(output)
    trajectory = archive.read_design(design_file)["final"]
    archive.check_fits(design_file, trajectory, system)
    archive.write_recording(output, simulate_system(system, trajectory, seed), system)
    errors.print(f"wrote {output}")


@verb
def montecarlo(
    experiment: ExperimentFile,
    design_file: DesignFile,
    output: Folder,
    trials: Annotated[int, typer.Option(min=2, help="Trials per trajectory.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    measure_rate: Annotated[
        float | None, typer.Option(min=0.0, help="Measurement rate [Hz]; divides the rate.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare the estimator with the Cramér-Rao bound, on the initial and the designed trajectory."""
    stated = mjfim.Experiment.from_file(experiment)
    system = System.resolve(
        stated if measure_rate is None else stated.replace(measure_rate=measure_rate)
    )
    named = archive.read_design(design_file)
    for trajectory in named.values():
        archive.check_fits(design_file, trajectory, system)
    check_folder(output)
    with progress(f"{trials} trials") as show:
        study = monte_carlo_system(system, named, trials=trials, seed=seed, callback=show)

    if not study.sets:
        raise NoResultError
    with writing(output) as results:
        results.write_study_folder(output, study, system)
    print_result(as_json, study.summary(), render(describe_study(study, system.units)))
    errors.print(f"wrote {output}/")
    if len(study.sets) < len(named):
        errors.print(f"mjfim: interrupted; only {', '.join(study.sets)} is finished")
    raise typer.Exit(
        0
        if len(study.sets) == len(named) and all(s.failed == 0 for s in study.sets.values())
        else 1
    )
