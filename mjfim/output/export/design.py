"""Export of a design for the programs that run robots."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path

import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.arguments import checked
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.files import replacing
from mjfim.model.coordinates import state_names
from mjfim.output.archive import design_columns
from mjfim.output.export import TARGETS
from mjfim.output.export.trajectories import (
    DATASET_FILES,
    ENDINGS,
    POSITIONS,
    RobotPlan,
    bag_files,
    joint_trajectory,
    write_bag,
    write_lerobot_dataset,
    write_trajectory_yaml,
)
from mjfim.records.design import GAIN_NOTE, Design

# The text in the player that stands for the design.
PLACE = 'r"""{}"""'


def write_player(path: Path, plan: RobotPlan) -> None:
    """Write a stand-alone program that plays a design.

    Args:
        path: File to write.
        plan: The design.
    """
    system, space, drives = plan.system, plan.system.space, plan.drives
    names = list(state_names(system.model))
    sigma = dict(zip(system.outputs.names, np.sqrt(np.diag(system.noise.covariance)), strict=True))
    rows = np.column_stack([*design_columns(plan.playback, plan.gain, system).values()])
    design = {
        "name": plan.name,
        "gains": GAIN_NOTE,
        "state": names,
        "controls": list(system.controls),
        "sizes": [space.nq, space.nv],
        "scalars": list(zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True)),
        "quaternions": list(space.quaternions),
        "sigma": [float(sigma.get(name, 0.0)) for name in names],
        "lower": [drive.lower for drive in drives],
        "upper": [drive.upper for drive in drives],
        # A servo keeps its last command, and a motor gets the control nearest to zero.
        "safe": [
            math.nan if drive.holds_position else min(max(0.0, drive.lower), drive.upper)
            for drive in drives
        ],
    }

    # Names of a model are arbitrary texts, in which JSON escapes every quotation mark.
    head = ",\n".join(f'  "{key}": {json.dumps(value)}' for key, value in design.items())
    text = ",\n".join(json.dumps(row) for row in rows.tolist())
    template = files("mjfim.output.export").joinpath("player.py").read_text(encoding="utf-8")
    program = template.replace(PLACE, f'r"""{{\n{head},\n  "rows": [\n{text}\n]}}"""', 1)
    with replacing(path) as temporary:
        temporary.write_text(program, encoding="utf-8")


@checked
def export_design(
    experiment: ExperimentLike,
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
    require_options(to, positions, storage, unit)
    plan = RobotPlan.of(design, System.resolve(experiment))
    return write_export(plan, Path(path), to, positions, storage, unit)


def write_export(
    plan: RobotPlan, path: Path, to: str, positions: str | None, storage: str, unit: str
) -> list[str]:
    """Write a design for a target. See `export_design`."""
    if to == "player":
        write_player(path, plan)
        return [f"`python {path}` says what the design needs, and how to play it"]
    if to == "lerobot":
        write_lerobot_dataset(path, plan, unit)
        return []

    trajectory = joint_trajectory(plan, positions)
    if to == "ros2":
        write_trajectory_yaml(path, trajectory, plan.name)
    else:
        write_bag(path, plan, trajectory, storage)
    return trajectory.remarks()


def require_options(to: str, positions: str | None, storage: str, unit: str) -> None:
    """Raise ExperimentError unless an export has a target and options that exist."""
    _require("--to", "target", to, TARGETS)
    _require("--positions", "kind", positions or POSITIONS[0], POSITIONS)
    _require("--storage", "format", storage, ENDINGS)
    _require("--unit", "unit", unit, ("rad", "deg"))


def _require(option: str, kind: str, word: str, valid: Iterable[str]) -> None:
    words = tuple(valid)
    if word not in words:
        raise ExperimentError(f"{option}: {unknown(kind, word, words)}")


def is_folder(to: str) -> bool:
    """Whether an export to a target is a folder instead of a file."""
    return to in ("ros2-bag", "lerobot")


def exported_files(to: str, path: Path) -> tuple[str, ...]:
    """List the files that an export may write into its folder.

    Args:
        to: The target.
        path: The folder, or the file, whose folder is its parent.
    """
    files = {"lerobot": DATASET_FILES, "ros2-bag": bag_files(path)}
    return files.get(to, (path.name,))
