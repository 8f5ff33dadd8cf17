"""`mjfim simulate`: a synthetic recording of a design."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentFile,
    Force,
    InitialOrDesign,
    VideoFile,
    claim_file,
    claim_video,
    keep_result,
    verb,
    write_wanted_video,
)
from mjfim.cli.progress import say


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
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    video: VideoFile = None,
    force: Force = False,
) -> None:
    """Simulate a recording of a design at the `true` parameter values, with noise.

    Without a design it is a recording of the initial control, of the references that it states for
    the control laws, or of the motion of a model without actuators from its initial state.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.excitation.evaluation import motion_of
    from mjfim.experiment.given import check_fits
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
        trajectory = archive.read_design(design_file)["final"]
        check_fits(design_file, trajectory, system)

    recording = simulate_system(system, trajectory, seed)
    keep_result(output.parent)
    archive.write_recording(output, recording, system)
    say(f"wrote {output}")
    if video is not None:
        # The motion of the recording, without its noise.
        released = system.released_as(trajectory.state[0])
        motion = released.plant.simulate(released.parameters.true, trajectory.ctrl)
        write_wanted_video(video, system, motion)
