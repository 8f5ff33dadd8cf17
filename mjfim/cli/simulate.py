"""`mjfim simulate` and `mjfim montecarlo`: synthetic recordings, and estimates from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    DesignFile,
    ExperimentFile,
    Folder,
    Force,
    InitialOrDesign,
    LiveView,
    Pictures,
    Verbose,
    VideoFile,
    claim_file,
    claim_folder,
    claim_video,
    errors,
    keep_result,
    print_result,
    progress,
    say_written,
    verb,
    watched,
    write_wanted_video,
    writing,
)
from mjfim.cli.executors import (
    LOCAL,
    ExecutorPlace,
    started_if_stated,
    stated_executor,
)
from mjfim.errors import NoResultError
from mjfim.output.picture_format import PictureFormat

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.records.trajectory import Trajectory


@verb
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
    from mjfim.excitation.stated_inputs import stated_motion
    from mjfim.excitation.task import DesignTask
    from mjfim.excitation.task_parts import require_design_keys
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.simulate import simulate_system
    from mjfim.experiment.system import System
    from mjfim.output import archive

    system = System.resolve(mjfim.Experiment.from_file(experiment))
    output = output or (design_file or experiment).with_name("recording.csv")
    inputs = input_files(system.experiment, [design_file])
    claim_video(video, inputs, force=force)
    claim_file(output, inputs, force=force)
    if design_file is None and system.laws is not None:
        trajectory = stated_motion(system)
    elif design_file is None:
        require_design_keys(system, "simulate without a design")
        trajectory = DesignTask.of(system).initial
    else:
        trajectory = archive.read_design(design_file)["final"]
        archive.check_fits(design_file, trajectory, system)
    recording = simulate_system(system, trajectory, seed)
    keep_result(output.parent)
    archive.write_recording(output, recording, system)
    errors.print(f"wrote {output}")

    # The motion of the recording, without its noise.
    if video is not None:
        write_wanted_video(video, system, _true_motion(system, trajectory))


def _true_motion(system: System, trajectory: Trajectory) -> Trajectory:
    """The motion of a recording at the `true` parameter values."""
    released = system.released_as(trajectory.state[0])
    return released.plant.simulate(released.parameters.true, trajectory.ctrl)


@verb
def montecarlo(
    experiment: ExperimentFile,
    design_file: DesignFile,
    output: Folder,
    trials: Annotated[int, typer.Option(min=2, help="Number of recordings per trajectory.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    measure_rate: Annotated[
        float | None,
        typer.Option(min=0.0, help="Rate of the measurements in Hz; overrides measure_rate."),
    ] = None,
    live: LiveView = None,
    as_json: AsJson = False,
    pictures: Pictures = PictureFormat.PNG,
    verbose: Verbose = False,
    force: Force = False,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Compare estimates with the Cramér-Rao bound on the initial and on the designed trajectory."""
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.output import archive
    from mjfim.output.folders import study_files
    from mjfim.output.presentation import describe
    from mjfim.studies.monte_carlo import monte_carlo_system

    place = stated_executor(executor)
    stated = mjfim.Experiment.from_file(experiment)
    system = System.resolve(
        stated if measure_rate is None else stated.replace(measure_rate=measure_rate)
    )
    named = archive.read_design(design_file)
    for trajectory in named.values():
        archive.check_fits(design_file, trajectory, system)
    inputs = input_files(system.experiment, [design_file])
    claim_folder(output, pictures.files(study_files(system.parameters.names)), inputs, force=force)

    with (
        started_if_stated(place, trials) as workers,
        progress(f"{trials} trials") as display,
        watched(live, system, display) as show,
    ):
        study = monte_carlo_system(
            system, named, trials=trials, seed=seed, callback=show, executor=workers
        )

    if not study.sets:
        raise NoResultError
    summary = describe(study)
    values = archive.summary_with_origin(study, system, output)
    print_result(as_json, values, summary, verbose=verbose)
    with writing(output) as results:
        results.write_result(output, study, system, pictures)
    say_written(output)
    done = {name: found.trials for name, found in study.sets.items()}
    is_complete = done == dict.fromkeys(named, trials)
    if not is_complete:
        parts = ", ".join(f"{count} of {trials} trials of {name}" for name, count in done.items())
        errors.print(f"mjfim: interrupted; only {parts} are finished", markup=False)

    has_failures = any(trials.failed for trials in study.sets.values())
    raise typer.Exit(0 if is_complete and not has_failures else 1)
