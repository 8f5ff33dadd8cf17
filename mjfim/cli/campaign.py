"""`mjfim campaign`: rounds of design, recording and estimate until all targets are reached."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentFile,
    Folder,
    Force,
    Pictures,
    Threads,
    Verbose,
    claim_folder,
    errors,
    out,
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
from mjfim.output.picture_format import PictureFormat
from mjfim.output.text import render


@verb
def campaign(
    experiment: ExperimentFile,
    output: Folder,
    rounds: Annotated[int, typer.Option(min=1, help="Largest number of rounds.")] = 10,
    wanted: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Target accuracy of parameters that state none, as a fraction of the guess.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated noise.")] = 0,
    real: Annotated[
        bool, typer.Option("--real", help="Record on a real robot, one round per call.")
    ] = False,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Recording of the last design; may be given several times; implies --real.",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue a simulated campaign, with its settings, after its last complete round.",
        ),
    ] = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    threads: Threads = None,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Repeat design, recording and estimate until every target accuracy is reached.

    Without --real, the robot is simulated at the `true` values. With --real, each call estimates
    the parameters from all recordings so far and writes the design of the next round into
    DIR/round_K/. Then play its design.csv on the robot, and call again with --recordings.

    A simulated campaign that was stopped or killed is continued with --resume.
    """
    from mjfim.cli.campaign_run import CampaignRun, with_target_accuracies
    from mjfim.excitation.task import DesignTask
    from mjfim.experiment.input_files import input_files
    from mjfim.output.campaign_parameters import CampaignParameters
    from mjfim.output.summaries.campaign import describe_campaign
    from mjfim.records.campaign import CampaignStatus

    place = stated_executor(executor)
    stated = with_target_accuracies(mjfim.Experiment.from_file(experiment), wanted)
    run = CampaignRun(output, DesignTask.resolve(stated, threads=threads), pictures)

    simulated = not (real or recordings)
    if simulated:
        run.require_simulation(seed, resume=resume)
    names = run.folder.next_files(simulated=simulated)
    claim_folder(output, names, input_files(stated, recordings or []), force=force)

    with (
        started_if_stated(place, MAX_PARTS) as workers,
        progress("designing") as display,
    ):
        display.count_rounds(rounds)
        run.display, run.executor = display, workers
        found = run.simulated(rounds, seed) if simulated else run.real(rounds, recordings or [])

    parameters = CampaignParameters.stated(run.task.parameters, simulated=simulated)
    out.print(render(describe_campaign(found, parameters), verbose=verbose))
    with writing(output):
        remarks = run.folder.write_campaign(found, simulated=simulated)
    for remark in remarks:
        errors.print(f"warning: {remark}", markup=False)
    if found.status is CampaignStatus.WAITING:
        waiting = run.folder.round(run.folder.designed)
        out.print(
            f"next: play {waiting}/design.csv on the robot and record it, then repeat this call "
            "with --recordings FILE.csv",
            markup=False,
            soft_wrap=True,
        )
    say_written(output)
    raise typer.Exit(0 if found.reached else 1)
