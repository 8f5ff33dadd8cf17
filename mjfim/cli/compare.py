"""`mjfim compare`: the design compared with parametric excitations of equal budget."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Force,
    Pictures,
    Threads,
    Verbose,
    claim_folder,
    errors,
    is_elsewhere,
    print_result,
    progress,
    say_written,
    verb,
    writing,
)
from mjfim.cli.executors import (
    LOCAL,
    MAX_PARTS,
    ExecutorPlace,
    started_if_stated,
    stated_executor,
)
from mjfim.errors import NoResultError
from mjfim.output.picture_format import PictureFormat
from mjfim.studies.baseline_titles import TITLES


@verb
def compare(
    experiment: ExperimentFile,
    output: Folder,
    seconds: Annotated[float, typer.Option(min=0.0, help="Time of each method in seconds.")] = 60.0,
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help=f"Baselines to run before the design: {', '.join(TITLES)}."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    threads: Threads = None,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Compare the design with chirps, multisines, Fourier series and splines of equal budget.

    The exit code is 1 if one of them is better than the design.
    """
    from mjfim.excitation.task import DesignTask
    from mjfim.experiment.input_files import input_files
    from mjfim.output import archive
    from mjfim.output.folders import comparison_files
    from mjfim.output.presentation import describe
    from mjfim.studies.compare import chosen_methods, compare_task

    place = stated_executor(executor)
    task = DesignTask.resolve(mjfim.Experiment.from_file(experiment), threads=threads)
    chosen = (
        None if methods is None else [name.strip() for name in methods.split(",") if name.strip()]
    )
    baselines = chosen_methods(task.system, chosen)
    names = comparison_files(baselines)
    claim_folder(output, pictures.files(names), input_files(task.experiment), force=force)
    with started_if_stated(place, MAX_PARTS) as workers, progress("comparing") as show:
        result = compare_task(
            task,
            seconds=seconds,
            seed=seed,
            methods=chosen,
            callback=show,
            executor=workers,
        )

    if not result.rows:
        raise NoResultError
    values = archive.summary_with_origin(result, task.system, output)
    print_result(as_json, values, describe(result), verbose=verbose)
    with writing(output) as results:
        results.write_result(output, result, task.system, pictures)
    say_written(output)
    if is_elsewhere(as_json) and not result.ok:
        errors.print(f"mjfim: {' '.join(result.verdict)}", markup=False)
    raise typer.Exit(0 if result.ok else 1)
