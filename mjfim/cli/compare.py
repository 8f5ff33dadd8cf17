"""`mjfim compare`: the design beside parametric excitations with the same budget."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Threads,
    _say,
    errors,
    progress,
    verb,
    writing,
)
from mjfim.excitation.task import DesignTask
from mjfim.output.folders import check_folder
from mjfim.output.summaries import describe_comparison
from mjfim.output.text import render
from mjfim.studies.baselines.methods import METHODS
from mjfim.studies.compare import Glance, compare_task


@verb
def compare(
    experiment: ExperimentFile,
    output: Folder,
    seconds: Annotated[float, typer.Option(min=0.0, help="Budget of each method [s].")] = 60.0,
    steps: Annotated[
        float | None, typer.Option(min=1.0, help="Budget of MuJoCo steps; default: time alone.")
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...", help=f"Baselines to run before the design: {', '.join(METHODS)}."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Hold the design against chirps, multisines, Fourier series, splines with the same budget; exit code 1 if one is better."""
    task = DesignTask.resolve(mjfim.Experiment.from_file(experiment), threads=threads)
    chosen = (
        None if methods is None else [name.strip() for name in methods.split(",") if name.strip()]
    )
    check_folder(output)
    with progress() as bar:
        progress_task = bar.add_task("comparing", total=None)
        told = [-1]

        def monitor(glance: Glance) -> None:
            text = f"{glance.place + 1}/{glance.count} {glance.title}  best J {glance.cost:.5g}"
            bar.update(
                progress_task,
                description=text,
                total=glance.count,
                completed=glance.place + min(glance.used, 1.0),
            )
            if not errors.is_terminal and glance.place > told[0]:
                told[0] = glance.place
                errors.print(f"{glance.place + 1}/{glance.count} {glance.title}", markup=False)

        result = compare_task(task, seconds, steps, seed, chosen, monitor=monitor)
    if not result.rows:
        raise KeyboardInterrupt
    with writing(output) as results:
        results.leave_comparison(output, result, task.system)
    _say(as_json, result.summary(), render(describe_comparison(result)))
    errors.print(f"wrote {output}/")
    if not result.ok:
        errors.print(f"mjfim: {' '.join(result.verdict)}", markup=False)
    raise typer.Exit(0 if result.ok else 1)
