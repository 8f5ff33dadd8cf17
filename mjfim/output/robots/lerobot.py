"""A design as a LeRobot dataset of format v3.0, with one episode.

The frames are the rows of design.csv. `action` holds the controls, `observation.state` the planned
positions and velocities; the last frame continues the last control. The files are those that
LeRobot 0.4 writes, with the names that its robots use: `<motor>.pos` for the command of a servo.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.files import replacing, write_json
from mjfim.model.coordinates import state_components
from mjfim.output.robots.plan import RobotPlan

# Files of a dataset with one episode, relative to its folder.
INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
TASKS_FILE = "meta/tasks.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
DATA_FILE = "data/chunk-000/file-000.parquet"
DATASET_FILES = (DATA_FILE, EPISODES_FILE, TASKS_FILE, STATS_FILE, INFO_FILE)

# Endings of names by what the control of a motor or the component of a state means.
CONTROL_ENDINGS = {"position": ".pos", "velocity": ".vel", "force": ".effort", "other": ""}
STATE_ENDINGS = {"qpos": ".pos", "qvel": ".vel"}

# Quantiles of the statistics, by their names.
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

# Index of the table of tasks, which pandas restores from this description.
TASK_INDEX = "__index_level_0__"
PANDAS: dict[str, Any] = {
    "index_columns": [TASK_INDEX],
    "column_indexes": [],
    "columns": [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": None,
            "field_name": TASK_INDEX,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ],
    "pandas_version": "2.0.0",
}

# Largest relative deviation of the rate from a whole number of frames per second.
RATE_TOLERANCE = 1e-6


def write_lerobot_dataset(folder: Path, plan: RobotPlan, unit: str = "rad") -> None:
    """Write a design as a LeRobot dataset.

    Args:
        folder: Folder of the dataset.
        plan: The design.
        unit: Unit of angles, `rad` or `deg`; angular velocities follow.

    Raises:
        ExperimentError: The rate of the rows is not a whole number of frames per second.
    """
    rate = 1.0 / plan.playback.period
    fps, rows = round(rate), len(plan.playback.t)
    if fps < 1 or abs(rate - fps) > RATE_TOLERANCE * rate:
        raise ExperimentError(
            f"a LeRobot dataset has a whole number of frames per second, but the design has "
            f"{rate:.6g} rows per second; state another rate or playback_rate"
        )

    factor = 180.0 / np.pi if unit == "deg" else 1.0
    named = {"action": _actions(plan, factor), "observation.state": _states(plan, factor)}
    index = np.arange(rows)
    defaults: dict[str, np.ndarray] = {
        "timestamp": (index / fps).astype(np.float32),
        "frame_index": index,
        "episode_index": np.zeros_like(index),
        "index": index,
        "task_index": np.zeros_like(index),
    }
    columns = {name: values.astype(np.float32) for name, (_, values) in named.items()} | defaults
    stats = {name: _statistics(values) for name, values in columns.items()}
    task = f"mjfim design {plan.name}"
    tasks = {"task_index": [0], TASK_INDEX: [task]}
    _write_parquet(folder / DATA_FILE, {name: _column(each) for name, each in columns.items()})
    _write_parquet(folder / EPISODES_FILE, _episode(task, rows, stats))
    _write_parquet(folder / TASKS_FILE, tasks, {b"pandas": json.dumps(PANDAS).encode()})
    write_json(folder / STATS_FILE, stats)

    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": names}
        for key, (names, _) in named.items()
    }
    for key, values in defaults.items():
        features[key] = {"dtype": values.dtype.name, "shape": [1], "names": None}
    write_json(folder / INFO_FILE, _info(plan.name, rows, fps, features))


def _episode(task: str, rows: int, stats: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The table of episodes, with one row."""
    episode: dict[str, Any] = {
        "episode_index": [0],
        "tasks": [[task]],
        "length": [rows],
        "data/chunk_index": [0],
        "data/file_index": [0],
        "dataset_from_index": [0],
        "dataset_to_index": [rows],
        "meta/episodes/chunk_index": [0],
        "meta/episodes/file_index": [0],
    }
    for name, numbers in stats.items():
        episode |= {f"stats/{name}/{key}": [value] for key, value in numbers.items()}
    return episode


def _info(name: str, rows: int, fps: int, features: Mapping[str, Any]) -> dict[str, Any]:
    """The contents of info.json."""
    return {
        "codebase_version": "v3.0",
        "robot_type": name,
        "total_episodes": 1,
        "total_frames": rows,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }


def _actions(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nu) values of the controls; factor converts angles."""
    names = [f"{drive.name}{CONTROL_ENDINGS[drive.meaning]}" for drive in plan.drives]
    are_angles = [
        drive.meaning in ("position", "velocity")
        and drive.joint is not None
        and drive.joint.unit == "rad"
        for drive in plan.drives
    ]
    return names, plan.held_control * np.where(are_angles, factor, 1.0)


def _states(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nq+nv) values of positions and velocities; factor converts angles."""
    names, columns = [], []
    for component in state_components(plan.system.model):
        field, _, name = component.name.partition(":")
        scale = factor if component.unit in ("rad", "rad/s") else 1.0
        names.append(f"{name}{STATE_ENDINGS[field]}")
        columns.append(scale * plan.playback.state[:, component.address])
    return names, np.column_stack(columns)


def _column(values: np.ndarray) -> Any:
    """A column of numbers, or of lists of equal length if each frame has several numbers."""
    width = values.shape[1] if values.ndim > 1 else 1
    numbers = pa.array(values.ravel())
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
    for name, share in QUANTILES.items():
        found[name] = np.quantile(rows.astype(np.float64), share, axis=0).tolist()
    return found


def _write_parquet(
    path: Path, columns: Mapping[str, Any], metadata: Mapping[bytes, bytes] | None = None
) -> None:
    """Write a table."""
    table = pa.table(dict(columns)).replace_schema_metadata(metadata)
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)
