"""`mjfim compare`: the design compared with parametric excitations of equal budget."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.announcements import announce_comparison
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Force,
    Pictures,
    Threads,
    claim_folder,
    errors,
    print_result,
    progress,
    verb,
    writing,
)
from mjfim.errors import NoResultError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.input_files import input_files
from mjfim.output.folders import comparison_files
from mjfim.output.picture_format import PictureFormat
from mjfim.output.summaries.comparison import describe_comparison
from mjfim.output.text import render
from mjfim.studies.baselines.methods import METHODS
from mjfim.studies.compare import chosen_methods, compare_task


@verb
def compare(
    experiment: ExperimentFile,
    output: Folder,
    seconds: Annotated[float, typer.Option(min=0.0, help="Time of each method in seconds.")] = 60.0,
    steps: Annotated[
        float | None,
        typer.Option(min=1.0, help="MuJoCo steps of each method; default: not limited."),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help=f"Baselines to run before the design: {', '.join(METHODS)}."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    force: Force = False,
    threads: Threads = None,
) -> None:
    """Compare the design with chirps, multisines, Fourier series and splines of equal budget.

    The exit code is 1 if one of them is better than the design.
    """
    task = DesignTask.resolve(mjfim.Experiment.from_file(experiment), threads=threads)
    chosen = (
        None if methods is None else [name.strip() for name in methods.split(",") if name.strip()]
    )
    baselines = chosen_methods(task, chosen)
    names = comparison_files(baselines)
    claim_folder(output, pictures.files(names), input_files(task.experiment), force=force)
    announce_comparison(len(baselines) + 1, seconds)
    with progress("comparing") as show:
        result = compare_task(
            task, seconds=seconds, steps=steps, seed=seed, methods=chosen, callback=show
        )

    if not result.rows:
        raise NoResultError
    with writing(output) as results:
        results.write_comparison_folder(output, result, task.system, pictures)
    print_result(as_json, result.summary(), render(describe_comparison(result)))
    errors.print(f"wrote {output}/")
    if not result.ok:
        errors.print(f"mjfim: {' '.join(result.verdict)}", markup=False)
    raise typer.Exit(0 if result.ok else 1)
