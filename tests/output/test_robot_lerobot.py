"""Designs as LeRobot datasets: the files of format v3.0, and back by `identify`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import ExperimentError
from mjfim.experiment import System
from mjfim.recordings import read_recording
from tests.output.conftest import Designed
from tests.support.cli import done, misused, run
from tests.support.paths import MODELS

CART = MODELS / "cart_pendulum.toml"

# Files of a dataset that LeRobot 0.4 writes for one episode.
FILES = {
    "meta/info.json",
    "meta/stats.json",
    "meta/tasks.parquet",
    "meta/episodes/chunk-000/file-000.parquet",
    "data/chunk-000/file-000.parquet",
}

# Columns that LeRobot adds to every dataset, with their types.
DEFAULTS = {
    "timestamp": "float",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}

# Keys of info.json that LeRobot 0.4 writes, and statistics of each feature.
INFO_KEYS = {
    "codebase_version",
    "robot_type",
    "total_episodes",
    "total_frames",
    "total_tasks",
    "chunks_size",
    "data_files_size_in_mb",
    "video_files_size_in_mb",
    "fps",
    "splits",
    "data_path",
    "video_path",
    "features",
}
STATISTICS = {"min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"}


def described(folder: Path) -> dict[str, Any]:
    """The contents of info.json."""
    info: dict[str, Any] = json.loads((folder / "meta" / "info.json").read_text(encoding="utf-8"))
    return info


def table(folder: Path, file: str) -> Any:
    """A table of the dataset."""
    return pyarrow.parquet.read_table(folder / file, partitioning=None)


def test_the_files_follow_the_format(arm: Designed, tmp_path: Path) -> None:
    """Files, keys, columns and types are those of LeRobot 0.4; each feature has statistics."""
    mjfim.export_design(*arm, tmp_path, to="lerobot")
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")}
    assert files == FILES

    info = described(tmp_path)
    assert set(info) == INFO_KEYS
    assert (info["codebase_version"], info["fps"], info["total_frames"]) == ("v3.0", 100, 51)
    assert info["splits"] == {"train": "0:1"} and info["video_path"] is None
    joints = ["yaw", "shoulder", "elbow", "wrist"]
    features = info["features"]
    data = table(tmp_path, "data/chunk-000/file-000.parquet")
    assert set(features) == set(data.column_names)
    for feature, endings in (("action", ["pos"]), ("observation.state", ["pos", "vel"])):
        stated, names = features[feature], [f"{j}.{e}" for e in endings for j in joints]
        assert (stated["dtype"], stated["names"]) == ("float32", names)
        assert stated["shape"] == [len(names)]
        assert data.schema.field(feature).type == pa.list_(pa.float32(), len(names))
    types = {name: str(data.schema.field(name).type) for name in DEFAULTS}
    assert types == DEFAULTS
    assert data.column("timestamp").to_pylist()[-1] == 0.5

    stats = json.loads((tmp_path / "meta" / "stats.json").read_text(encoding="utf-8"))
    assert set(stats) == set(features)
    for feature, numbers in stats.items():
        assert set(numbers) == STATISTICS
        assert numbers.pop("count") == [51]
        assert {len(value) for value in numbers.values()} == {features[feature]["shape"][0]}

    (episode,) = table(tmp_path, "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert episode["tasks"] == ["mjfim design servo_arm"]
    assert (episode["dataset_from_index"], episode["dataset_to_index"]) == (0, 51)
    assert episode["stats/action/max"] == stats["action"]["max"]
    for place in ("data", "meta/episodes"):
        assert {f"{place}/chunk_index", f"{place}/file_index"} <= set(episode)

    # pandas makes the texts the index of the table of tasks.
    tasks = table(tmp_path, "meta/tasks.parquet")
    (index,) = json.loads(tasks.schema.metadata[b"pandas"])["index_columns"]
    assert tasks.to_pydict() == {"task_index": [0], index: ["mjfim design servo_arm"]}


def test_actions_are_the_controls_in_the_unit(arm: Designed, tmp_path: Path) -> None:
    mjfim.export_design(*arm, tmp_path, to="lerobot", unit="deg")
    data = table(tmp_path, "data/chunk-000/file-000.parquet")
    curve = arm[1].trajectory
    actions = np.array(data.column("action").to_pylist())
    states = np.array(data.column("observation.state").to_pylist())
    assert_allclose(actions[:-1], np.degrees(curve.ctrl), rtol=1e-6, atol=1e-6)
    assert_array_equal(actions[-1], actions[-2])
    wanted = np.degrees(np.concatenate([curve.qpos, curve.qvel], axis=1))
    assert_allclose(states, wanted, rtol=1e-6, atol=1e-5)


def test_the_dataset_is_read_as_a_recording(cart: Designed, tmp_path: Path) -> None:
    """Names are found without a table `[recording]`; the values have single precision."""
    mjfim.export_design(*cart, tmp_path, to="lerobot")
    recording = read_recording(tmp_path, System.resolve(cart[0]).channels)
    curve = cart[1].trajectory
    assert_allclose(recording.ctrl, curve.ctrl, rtol=1e-6)
    assert recording.outputs == ("qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")
    planned = np.concatenate([curve.qpos, curve.qvel], axis=1)
    assert_allclose(recording.y, planned, rtol=1e-6, atol=1e-12)


def test_the_verb_replaces_its_own_dataset(cart: Designed, tmp_path: Path) -> None:
    """Twice into one folder; a file of the user is refused."""
    cart[1].save(tmp_path / "design")
    words = ("export", tmp_path / "design", "--experiment", CART, "--to", "lerobot")
    for _ in range(2):
        done(*words, "-o", tmp_path / "set")
    assert described(tmp_path / "set")["total_frames"] == 401

    (tmp_path / "set" / "meta" / "info.json").write_text("{}", encoding="utf-8")
    misused(run(*words, "-o", tmp_path / "set"), "info.json", "--force")


def test_a_rate_that_is_no_whole_number_is_refused(cart: Designed, tmp_path: Path) -> None:
    stated = cart[0].replace(rate=100.0 / 3.0, measure_rate=100.0 / 3.0, horizon=0.3)
    with pytest.raises(ExperimentError, match=r"33\.3333 rows per second; state another rate"):
        mjfim.export_design(stated, mjfim.design(stated), tmp_path, to="lerobot")
