"""`mjfim robustness`: a design on simulated robots that differ from the model."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, Run, verb
from mjfim.cli.progress import progress, say_from_program
from mjfim.errors import MAX_WRONG

# Largest number of robots; more would take days.
MAX_RUNS = 100_000


@verb(without=("as_json", "threads"))
def robustness(
    experiment: ExperimentFile,
    design_folder: Annotated[
        Path, typer.Argument(metavar="DESIGN_FOLDER", help="Folder of a design.")
    ],
    run: Run,
    runs: Annotated[int, typer.Option(min=1, max=MAX_RUNS, help="Number of robots.")] = 100,
    wrong: Annotated[
        float,
        typer.Option(
            help=f"Relative error of the nominal value of every parameter, from 0 to {MAX_WRONG:g}."
        ),
    ] = 0.2,
    latency: Annotated[
        float | None,
        typer.Option(
            help="Delay of the control in seconds, a multiple of the timestep; default: 0.005, "
            "rounded up."
        ),
    ] = None,
    feedback: Annotated[
        bool,
        typer.Option("--feedback", help="The controller adds the gains times the deviation."),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
) -> None:
    """Play a design on simulated robots that differ from the model.

    The result says how many robots keep the limits, and how many of the 95 % intervals contain the
    true values.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.experiment.packing import input_files
    from mjfim.experiment.system import System
    from mjfim.output.folders import ROBUSTNESS_FILES
    from mjfim.parallel import cores
    from mjfim.records.studies import RobotConditions
    from mjfim.studies.robustness import default_latency

    conditions = RobotConditions(
        wrong=wrong,
        latency=default_latency(stated) if latency is None else latency,
        feedback=feedback,
        seed=seed,
    )
    conditions.check()
    run.claim(ROBUSTNESS_FILES, input_files(stated, [design_folder]))

    begun = time.perf_counter()
    with run.workers(runs, cores()) as workers, progress("playing") as show:
        result = mjfim.assess_robustness(
            stated,
            design_folder,
            conditions=conditions,
            runs=runs,
            callback=show,
            executor=workers,
        )
    seconds = time.perf_counter() - begun

    remark = f" ({result.runs} runs in {seconds:.0f} s)"
    run.finish(
        result,
        System.resolve(stated),
        design=design_folder if design_folder.is_dir() else design_folder.parent,
        further={"seconds": seconds},
        remark=remark,
    )
    if result.runs < runs:
        say_from_program(f"interrupted; only {result.runs} of {runs} robots are done")
    raise typer.Exit(0 if result.ok and result.runs == runs else 1)
