"""Export of a design for the programs that run robots."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.output.robot.joint_trajectory import (
    joint_trajectory,
    trajectory_remarks,
    write_trajectory_yaml,
)
from mjfim.output.robot.lerobot_dataset import ANGLE_UNITS, DATASET_FILES, write_lerobot_dataset
from mjfim.output.robot.options import Target, chosen
from mjfim.output.robot.plan import RobotPlan
from mjfim.output.robot.player_script import write_player
from mjfim.output.robot.ros2_bag import ENDINGS, bag_files, write_bag
from mjfim.records.design import Design


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """Options of an export, each of which concerns some targets only.

    Attributes:
        positions: What the positions of a joint trajectory are: `motion` or `command`; default: the
            commands where every driven joint has a position servo.
        storage: Format of the file in a ROS 2 bag: `mcap` or `sqlite3`.
        unit: Unit of angles in a LeRobot dataset: `rad` or `deg`.
    """

    positions: str | None = None
    storage: str = "mcap"
    unit: str = "rad"


def target_of(text: str) -> Target:
    """Return the target that a text names.

    Args:
        text: Name of the target.

    Raises:
        ExperimentError: There is no such target.
    """
    targets: tuple[Target, ...] = get_args(Target)
    return chosen("--to", "target", text, targets)


def is_folder(target: Target) -> bool:
    """Whether an export to a target is a folder instead of a file."""
    return target in ("ros2-bag", "lerobot")


def exported_files(target: Target, path: Path) -> tuple[str, ...]:
    """List the files that an export may write into its folder.

    Args:
        target: The target.
        path: The folder, or the file, whose folder is its parent.
    """
    if target == "lerobot":
        return DATASET_FILES
    return bag_files(path) if target == "ros2-bag" else (path.name,)


def export_design(
    experiment: Experiment,
    design: Design,
    path: str | Path,
    *,
    to: str,
    positions: str | None = None,
    storage: str = "mcap",
    unit: str = "rad",
) -> list[str]:
    """Write a design for a program that runs robots.

    `to` is `ros2` for a YAML file with a `trajectory_msgs/JointTrajectory`, `ros2-bag` for the
    folder of a ROS 2 bag with this message, the planned joint states and the controls, `player` for
    a stand-alone Python program that plays the controls, with or without feedback, or `lerobot` for
    the folder of a LeRobot dataset (v3.0) with one episode.

    Args:
        experiment: The experiment for which the design was made.
        design: The design.
        path: The file or the folder to write.
        to: The target.
        positions: What the positions of a joint trajectory are: `motion` or `command`; default: the
            commands where every driven joint has a position servo.
        storage: Format of the file in a ROS 2 bag: `mcap` or `sqlite3`.
        unit: Unit of angles in a LeRobot dataset: `rad` or `deg`.

    Returns:
        Sentences that the user of the export needs.

    Raises:
        ExperimentError: The target or an option is unknown, or the model has nothing that the
            target can hold.
        RecordingError: The design was made for another model or another rate, or a library that
            the target needs is not installed.
    """
    target = target_of(to)
    options = ExportOptions(positions=positions, storage=storage, unit=unit)
    plan = RobotPlan.of(design, System.resolve(experiment))
    return write_export(plan, Path(path), target, options)


def write_export(plan: RobotPlan, path: Path, target: Target, options: ExportOptions) -> list[str]:
    """Write a design for a target.

    Args:
        plan: The design.
        path: The file or the folder to write.
        target: The target.
        options: Options of the target.

    Returns:
        Sentences that the user of the export needs.
    """
    if target == "player":
        write_player(path, plan)
        return [f"`python {path}` says what the design needs, and how to play it"]

    if target == "lerobot":
        unit = chosen("--unit", "unit", options.unit, ANGLE_UNITS)
        write_lerobot_dataset(path, plan, unit)
        return []

    storage = chosen("--storage", "format", options.storage, ENDINGS)
    trajectory = joint_trajectory(plan, options.positions)
    if target == "ros2":
        write_trajectory_yaml(path, trajectory, plan.name)
    else:
        write_bag(path, plan, trajectory, storage)
    return trajectory_remarks(trajectory)
