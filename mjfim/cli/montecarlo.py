"""`mjfim montecarlo`: estimates from many synthetic recordings against the Cramér-Rao bound."""

from __future__ import annotations

from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import DesignFile, ExperimentFile, LiveView, Run, verb
from mjfim.cli.progress import progress, say_from_program, watched
from mjfim.errors import NoResultError


@verb()
def montecarlo(
    experiment: ExperimentFile,
    design_file: DesignFile,
    run: Run,
    trials: Annotated[int, typer.Option(min=2, help="Number of recordings per trajectory.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    measure_rate: Annotated[
        float | None,
        typer.Option(min=0.0, help="Rate of the measurements in Hz; overrides measure_rate."),
    ] = None,
    live: LiveView = None,
) -> None:
    """Compare estimates with the Cramér-Rao bound on the initial and on the designed trajectory."""
    stated = mjfim.Experiment.from_file(experiment)
    if measure_rate is not None:
        stated = stated.replace(measure_rate=measure_rate)

    from mjfim.experiment.given import check_fits
    from mjfim.experiment.system import System
    from mjfim.output import archive

    system = System.resolve(stated, threads=run.threads)
    named = archive.read_design(design_file)
    for trajectory in named.values():
        check_fits(design_file, trajectory, system)
    run.claim(mjfim.MonteCarloStudy, stated, [design_file])

    with (
        run.workers(trials) as workers,
        progress(f"{trials} trials") as display,
        watched(live, system, display) as show,
    ):
        study = mjfim.monte_carlo(
            stated,
            named,
            trials=trials,
            seed=seed,
            callback=show,
            threads=run.threads,
            executor=workers,
        )
    if not study.sets:
        raise NoResultError

    code = run.finish(study, system, design=design_file)
    done = {name: found.trials for name, found in study.sets.items()}
    is_complete = done == dict.fromkeys(named, trials)
    if not is_complete:
        parts = ", ".join(f"{count} of {trials} trials of {name}" for name, count in done.items())
        say_from_program(f"interrupted; only {parts} are finished")
    raise typer.Exit(code or int(not is_complete))
