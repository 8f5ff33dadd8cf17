"""Videos of results."""

from __future__ import annotations

from pathlib import Path

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import measured_trajectory
from mjfim.output.video.film import (
    Film,
    film_of_design,
    film_of_estimate,
    film_of_trajectories,
)
from mjfim.output.video.record import (
    NoVideoError,
    Video,
    format_of,
    require_encoder,
)
from mjfim.output.video.rendering import WANTED, render
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Trajectory

# What a video can show: a trajectory is a simulated motion.
Filmed = Design | Estimate | Trajectory


def save_video(experiment: Experiment, result: Filmed, path: str | Path) -> Video:
    """Write a video of the robot, drawn by MuJoCo without a display.

    A design is shown as the initial motion beside the designed one, an estimate as the measured
    robot as a ghost over the identified one.

    Args:
        experiment: The experiment of the result.
        result: A design, an estimate, or a trajectory.
        path: The file, which ends in .mp4 or .gif.

    Returns:
        The video, with a caption that says how fast it is played.

    Raises:
        NoVideoError: Nothing can be drawn on this computer, or a package is missing.
        RecordingError: The ending of the file is another one.
    """
    require_encoder(format_of(Path(path)))
    return write_video(Path(path), System.resolve(experiment), result)


def write_video(path: Path, system: System, result: Filmed) -> Video:
    """Write a video of a result. See `save_video`.

    Args:
        path: The file.
        system: The experiment, resolved.
        result: The result.
    """
    video = render(film_of(system, result), format_of(path), WANTED)
    video.save(path)
    return video


def film_of(system: System, result: Filmed) -> Film:
    """Film a result.

    Args:
        system: The experiment, resolved.
        result: The result.

    Raises:
        NoVideoError: The result holds no motion.
    """
    if isinstance(result, Design):
        return film_of_design(system.model_at(system.theta), result)
    if isinstance(result, Trajectory):
        return film_of_trajectories(system.model_at(system.theta), {"simulated": result})

    if result.motion is None:
        raise NoVideoError("the estimate holds no motion of a recording")
    recording = result.recordings[0]
    measured = measured_trajectory(system, recording, float(result.motion.t[-1]))
    duration = float(recording.t[-1] - recording.t[0])
    return film_of_estimate(system.model_at(result.theta), result.motion, measured, duration)
