"""`mjfim compare`: compare the design with parametric excitations of equal budget."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, Run, verb
from mjfim.cli.progress import progress
from mjfim.errors import NoResultError

# Longest time of a method [s]: a week.
MAX_SECONDS = 604_800.0


@verb()
def compare(
    experiment: ExperimentFile,
    run: Run,
    seconds: Annotated[
        float, typer.Option(min=0.0, max=MAX_SECONDS, help="Time of each method in seconds.")
    ] = 60.0,
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Baselines to run before the design: chirp, multisine, steps, fourier5, "
            "fourier15, splines.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
) -> None:
    """Compare the design with chirps, multisines, Fourier series and splines of equal budget.

    The exit code is 1 if one of them is better than the design.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.experiment.system import System
    from mjfim.studies.compare import chosen_methods

    system = System.resolve(stated, threads=run.threads)
    chosen = None
    if methods is not None:
        chosen = [name.strip() for name in methods.split(",") if name.strip()]
    controls = (f"control_{name}.csv" for name in chosen_methods(system, chosen))
    run.claim(mjfim.Comparison, stated, further=(*controls, "control_design.csv"))

    with run.workers() as workers, progress("comparing") as show:
        result = mjfim.compare(
            stated,
            seconds=seconds,
            seed=seed,
            methods=chosen,
            callback=show,
            executor=workers,
            threads=run.threads,
        )
    if not result.rows:
        raise NoResultError

    raise typer.Exit(run.finish(result, system))
