"""A design as a LeRobot dataset of format v3.0, with one episode.

The frames are the rows of design.csv. `action` holds the controls, `observation.state` the planned
positions and velocities; the last frame continues the last control. The files are those that
LeRobot 0.4 writes, with the names that its robots use: `<motor>.pos` for the command of a servo.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.files import replacing, write_json
from mjfim.model.coordinates import state_components
from mjfim.output.robot.plan import Drive, DriveKind, RobotPlan

# Units of angles in a dataset.
AngleUnit = Literal["rad", "deg"]
ANGLE_UNITS: tuple[AngleUnit, ...] = get_args(AngleUnit)

# Version of the format.
VERSION = "v3.0"

# Files of a dataset with one episode, relative to its folder.
INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
TASKS_FILE = "meta/tasks.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
DATA_FILE = "data/chunk-000/file-000.parquet"
DATASET_FILES = (DATA_FILE, EPISODES_FILE, TASKS_FILE, STATS_FILE, INFO_FILE)

# Columns that every dataset has, with their types.
DEFAULT_COLUMNS = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}

# Endings of names by what the control of a motor or the component of a state means.
CONTROL_ENDINGS = {
    DriveKind.POSITION: ".pos",
    DriveKind.VELOCITY: ".vel",
    DriveKind.FORCE: ".effort",
    DriveKind.OTHER: "",
}
STATE_ENDINGS = {"qpos": ".pos", "qvel": ".vel"}

# Quantiles of the statistics, by their names.
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

# Limits of the format, which LeRobot writes into every dataset.
FORMAT_LIMITS = {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200}

# Largest relative deviation of the rate from a whole number of frames per second.
RATE_TOLERANCE = 1e-6


def write_lerobot_dataset(folder: Path, plan: RobotPlan, unit: AngleUnit = "rad") -> None:
    """Write a design as a LeRobot dataset.

    Args:
        folder: Folder of the dataset.
        plan: The design.
        unit: Unit of angles; angular velocities follow.

    Raises:
        ExperimentError: The rate of the rows is not a whole number of frames per second.
    """
    fps = _frames_per_second(plan)
    factor = 180.0 / np.pi if unit == "deg" else 1.0
    features = {"action": _actions(plan, factor), "observation.state": _states(plan, factor)}
    columns = {**{name: values for name, (_, values) in features.items()}, **_frames(plan, fps)}
    task = f"mjfim design {plan.name}"
    stats = {name: _statistics(values) for name, values in columns.items()}
    rows = len(plan.playback.t)

    _write_parquet(folder / DATA_FILE, {name: _column(v) for name, v in columns.items()})
    _write_parquet(folder / EPISODES_FILE, _episode(rows, task, stats))
    _write_tasks(folder / TASKS_FILE, task)
    write_json(folder / STATS_FILE, stats)
    write_json(folder / INFO_FILE, _info(plan.name, rows, fps, features))


def _frames_per_second(plan: RobotPlan) -> int:
    """Rate of the rows, which a dataset states as a whole number [Hz]."""
    rate = 1.0 / plan.playback.period
    fps = round(rate)
    if fps < 1 or abs(rate - fps) > RATE_TOLERANCE * rate:
        raise ExperimentError(
            f"a LeRobot dataset has a whole number of frames per second, but the design has "
            f"{rate:.6g} rows per second; state another rate or playback_rate"
        )
    return fps


def _actions(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nu) values of the controls; factor converts angles."""
    names = [f"{drive.name}{CONTROL_ENDINGS[drive.kind]}" for drive in plan.drives]
    factors = [factor if _is_angular(drive) else 1.0 for drive in plan.drives]
    return names, plan.held_control * np.array(factors)


def _is_angular(drive: Drive) -> bool:
    """Whether a control is an angle or an angular velocity."""
    is_servo = drive.kind in (DriveKind.POSITION, DriveKind.VELOCITY)
    return is_servo and drive.joint is not None and drive.joint.unit == "rad"


def _states(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nq+nv) values of positions and velocities; factor converts angles."""
    names, columns = [], []
    for component in state_components(plan.system.model):
        field, _, name = component.name.partition(":")
        scale = factor if component.unit in ("rad", "rad/s") else 1.0
        names.append(f"{name}{STATE_ENDINGS[field]}")
        columns.append(scale * plan.playback.state[:, component.address])
    return names, np.column_stack(columns)


def _frames(plan: RobotPlan, fps: int) -> dict[str, np.ndarray]:
    """(M+1,) values of the columns that every dataset has."""
    index = np.arange(len(plan.playback.t))
    values = {"timestamp": index / fps, "frame_index": index, "index": index}

    # The other columns number episodes and tasks, of which there is one.
    zeros = np.zeros_like(index)
    return {
        name: np.asarray(values.get(name, zeros), dtype=kind)
        for name, kind in DEFAULT_COLUMNS.items()
    }


def _column(values: np.ndarray) -> Any:
    """A column of numbers, or of lists of equal length if each frame has several numbers."""
    if values.ndim == 1:
        return pa.array(values)
    width = values.shape[1]
    numbers = pa.array(values.astype(np.float32).ravel())
    return numbers if width == 1 else pa.FixedSizeListArray.from_arrays(numbers, width)


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """Statistics of a column, each a list with one number for each component."""
    rows = values.reshape(len(values), -1)
    found = {
        "min": rows.min(axis=0).tolist(),
        "max": rows.max(axis=0).tolist(),
        "mean": rows.mean(axis=0, dtype=np.float64).tolist(),
        "std": rows.std(axis=0, dtype=np.float64).tolist(),
        "count": [len(rows)],
    }
    quantiles = np.quantile(rows.astype(np.float64), list(QUANTILES.values()), axis=0)
    return found | dict(zip(QUANTILES, quantiles.tolist(), strict=True))


def _episode(
    rows: int, task: str, stats: Mapping[str, Mapping[str, list[float]]]
) -> dict[str, Any]:
    """The table of episodes, with one row."""
    columns: dict[str, Any] = {
        "episode_index": [0],
        "tasks": [[task]],
        "length": [rows],
        "data/chunk_index": [0],
        "data/file_index": [0],
        "dataset_from_index": [0],
        "dataset_to_index": [rows],
    }
    for name, numbers in stats.items():
        columns |= {f"stats/{name}/{key}": [value] for key, value in numbers.items()}
    return columns | {"meta/episodes/chunk_index": [0], "meta/episodes/file_index": [0]}


def _write_tasks(path: Path, task: str) -> None:
    """Write the table of tasks, whose index pandas restores from the metadata."""
    index = "__index_level_0__"
    number = {"name": "task_index", "field_name": "task_index", "pandas_type": "int64"}
    text = {"name": None, "field_name": index, "pandas_type": "unicode"}
    described = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            {**number, "numpy_type": "int64", "metadata": None},
            {**text, "numpy_type": "object", "metadata": None},
        ],
        "pandas_version": "2.0.0",
    }
    metadata = {b"pandas": json.dumps(described).encode()}
    _write_parquet(path, {"task_index": pa.array([0]), index: pa.array([task])}, metadata)


def _write_parquet(
    path: Path, columns: Mapping[str, Any], metadata: Mapping[bytes, bytes] | None = None
) -> None:
    """Write a table."""
    table = pa.table(dict(columns)).replace_schema_metadata(metadata)
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)


def _info(
    name: str, rows: int, fps: int, features: Mapping[str, tuple[Sequence[str], Array]]
) -> dict[str, Any]:
    """The contents of info.json."""
    described: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": list(names)}
        for key, (names, _) in features.items()
    }
    described |= {
        key: {"dtype": kind, "shape": [1], "names": None} for key, kind in DEFAULT_COLUMNS.items()
    }
    return {
        "codebase_version": VERSION,
        "robot_type": name,
        "total_episodes": 1,
        "total_frames": rows,
        "total_tasks": 1,
        **FORMAT_LIMITS,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": described,
    }
