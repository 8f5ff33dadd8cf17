"""`mjfim simulate` and `mjfim montecarlo`: synthetic recordings of a design."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    DesignFile,
    ExperimentFile,
    Force,
    InitialOrDesign,
    LiveView,
    NoiseSeed,
    Run,
    VideoFile,
    claim_file,
    claim_video,
    keep_result,
    verb,
    write_wanted_video,
)
from mjfim.cli.progress import progress, say, say_from_program, watched
from mjfim.errors import NoResultError


@verb()
def simulate(
    experiment: ExperimentFile,
    design_file: InitialOrDesign = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.csv",
            help="Recording to write; default: recording.csv beside the design or the experiment.",
        ),
    ] = None,
    seed: NoiseSeed = 0,
    video: VideoFile = None,
    force: Force = False,
) -> None:
    """Simulate a recording of a design at the `true` parameter values, with noise.

    Without a design, the recording is of `initial.control`. Under control laws this is a reference,
    and a model without actuators moves freely from its initial state.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.excitation.evaluation import motion_of
    from mjfim.experiment.packing import input_files
    from mjfim.experiment.system import System, simulate_system
    from mjfim.output import archive

    system = System.resolve(stated)
    output = output or (design_file or experiment).with_name("recording.csv")
    inputs = input_files(stated, [design_file])
    claim_video(video, inputs, force=force)
    claim_file(output, inputs, force=force)
    if design_file is None:
        trajectory = motion_of(system, None, "simulate without a design")
    else:
        trajectory = archive.read_design(design_file, system)["final"]

    recording = simulate_system(system, trajectory, seed)
    keep_result(output.parent)
    archive.write_recording(output, recording, system)
    say(f"wrote {output}")
    if video is not None:
        # The motion of the recording, without its noise.
        released = system.released_as(trajectory.state[0])
        motion = released.plant.simulate(released.parameters.true, trajectory.ctrl)
        write_wanted_video(video, system, motion)


@verb()
def montecarlo(
    experiment: ExperimentFile,
    design_file: DesignFile,
    run: Run,
    trials: Annotated[int, typer.Option(min=2, help="Number of recordings per trajectory.")] = 1500,
    seed: NoiseSeed = 0,
    measure_rate: Annotated[
        float | None,
        typer.Option(min=0.0, help="Rate of the measurements in Hz; overrides measure_rate."),
    ] = None,
    live: LiveView = None,
) -> int:
    """Compare estimates with the Cramér-Rao bound on the initial and on the designed trajectory."""
    stated = mjfim.Experiment.from_file(experiment)
    if measure_rate is not None:
        stated = stated.replace(measure_rate=measure_rate)

    from mjfim.experiment.system import System
    from mjfim.output import archive

    system = System.resolve(stated, threads=run.threads)
    named = archive.read_design(design_file, system)
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
    return code or int(not is_complete)
