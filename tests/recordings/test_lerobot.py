"""LeRobot datasets of both formats: episodes, names, units, times, and damage."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import ExperimentError, RecordingError
from mjfim.experiment import System
from mjfim.recordings import RecordingSpec, read_recording, recording_paths
from mjfim.recordings.formats import read_columns
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import run
from tests.support.paths import MODELS

ALL = RecordingSpec()
NAMES = {"action": ["force.effort"], "observation.state": ["slide.pos", "hinge.pos"]}
both = pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])


def write_dataset(
    folder: Path,
    episodes: Sequence[dict[str, np.ndarray]],
    names: dict[str, Any],
    *,
    version: str = "v3.0",
    info: dict[str, Any] | None = None,
) -> Path:
    """Write a dataset with pyarrow alone, at 100 frames per second, and return its folder.

    Args:
        folder: Folder of the dataset.
        episodes: (M, n) values of each feature, by episode; (M,) values are written as numbers.
        names: The names in info.json, by feature.
        version: Version of the format.
        info: Further entries of info.json, and others than the right ones.
    """
    tables = []
    for number, features in enumerate(episodes):
        rows = len(next(iter(features.values())))
        columns = {
            feature: pa.array(values.astype(np.float32).tolist())
            for feature, values in features.items()
        }
        columns["timestamp"] = pa.array((np.arange(rows) / 100.0).astype(np.float32))
        columns["frame_index"] = pa.array(np.arange(rows))
        columns["episode_index"] = pa.array(np.full(rows, number))
        columns["observation.image"] = pa.array(["none"] * rows)
        tables.append(pa.table(columns))

    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version.startswith("v2"):
        for number, table in enumerate(tables):
            pyarrow.parquet.write_table(table, data / f"episode_{number:06d}.parquet")
    else:
        pyarrow.parquet.write_table(pa.concat_tables(tables), data / "file-000.parquet")

    described = {
        feature: {
            "dtype": "float32",
            "shape": [values.shape[1] if values.ndim > 1 else 1],
            "names": names.get(feature),
        }
        for feature, values in episodes[0].items()
    }
    described["observation.image"] = {"dtype": "video", "shape": [9, 9, 3], "names": None}
    contents = {
        "codebase_version": version,
        "total_episodes": len(episodes),
        "fps": 100.0,
        "features": described,
    }
    (folder / "meta").mkdir()
    text = json.dumps({**contents, **(info or {})})
    (folder / "meta" / "info.json").write_text(text, encoding="utf-8")
    return folder


def episodes(count: int = 2, rows: int = 40) -> list[dict[str, np.ndarray]]:
    """Episodes whose numbers tell episode, row and component."""
    k = np.arange(rows)
    return [
        {
            "action": np.sin(0.1 * k + e),
            "observation.state": np.column_stack([0.01 * k + e, 3.0 + np.cos(0.1 * k)]),
        }
        for e in range(count)
    ]


def cart(**recording: Any) -> System:
    """The cart-pendulum with a table `[recording]`."""
    stated = cart_pendulum()
    return System.resolve(stated.replace(recording=recording))


@both
def test_each_episode_is_a_recording(version: str, tmp_path: Path) -> None:
    """Episodes of a folder, chosen ones, and one by its name; times have no rounding."""
    data = episodes(3)
    folder = write_dataset(tmp_path / "set", data, NAMES, version=version)
    names = [f"episode_{i:06d}" for i in range(3)]
    paths = recording_paths([folder, tmp_path / "other.csv"], cart().channels.spec)
    assert [path.name for path in paths] == [*names, "other.csv"]
    chosen = recording_paths([folder], cart(episodes=[2, 0]).channels.spec)
    assert [path.name for path in chosen] == [names[2], names[0]]

    for features, path in zip(data, paths[:3], strict=True):
        recording = read_recording(path, cart().channels)
        assert recording.outputs == ("qpos:slide", "qpos:hinge")
        assert_array_equal(recording.t, np.arange(40) / 100.0)
        action, state = (values.astype(np.float32) for values in features.values())
        assert_array_equal(recording.y, state)
        assert_array_equal(recording.ctrl[:, 0], action[:-1])
    table = read_columns(folder, RecordingSpec(episodes=(1,)))
    assert table.column("observation.state:slide.pos")[0] == 1.0

    with pytest.raises(RecordingError, match=r"set: has 3 episodes; name one, as in episode_0000"):
        read_columns(folder, ALL)
    with pytest.raises(RecordingError, match="no episode 3; the dataset has the episodes 0 to 2"):
        recording_paths([folder], cart(episodes=[3]).channels.spec)
    with pytest.raises(RecordingError, match="has no "):
        read_columns(folder / "episode_000009", ALL)


@pytest.mark.parametrize(
    ("stated", "columns"),
    [
        (["a", "b"], ["observation.state:a", "observation.state:b"]),
        ({"motors": ["a", "b"]}, ["observation.state:a", "observation.state:b"]),
        ({"b": 1, "a": 0}, ["observation.state:a", "observation.state:b"]),
        ([["a", "b"]], ["observation.state:a", "observation.state:b"]),
        (["a"], ["observation.state[0]", "observation.state[1]"]),
        (None, ["observation.state[0]", "observation.state[1]"]),
    ],
)
def test_names_have_many_forms(stated: Any, columns: list[str], tmp_path: Path) -> None:
    names = {"observation.state": stated}
    table = read_columns(write_dataset(tmp_path / "set", episodes(1), names), ALL)
    assert set(table.names) == {"t", "action", *columns}


def test_degrees_are_refused_with_the_way_to_state_units(tmp_path: Path) -> None:
    """A joint with a range whose positions are in degrees; then commands without a unit.

    The last joint rests, as its reference does.
    """
    stated = mjfim.Experiment.from_file(MODELS / "servo_arm.toml")
    model = System.resolve(stated).model
    joints = [model.joint(i).name for i in range(model.njnt)]
    waves = np.sin(0.05 * np.arange(100)[:, None] + np.arange(4)) * [0.3, 0.3, 0.3, 0.0]
    angles = np.rad2deg(0.8 + waves)
    features = {"action": angles, "observation.state": angles}
    names = [f"{joint}.pos" for joint in joints]
    folder = write_dataset(tmp_path / "set", [features], dict.fromkeys(features, names))

    def read(*stated_kinds: str) -> Recording:
        feature = {"qpos": "observation.state", "ctrl": "action"}
        columns = {
            f"{kind}:{joint}": {"column": f"{feature[kind]}:{joint}.pos", "unit": "deg"}
            for kind in stated_kinds
            for joint in joints
        }
        noise = {f"qpos:{joint}": 0.01 for joint in joints}
        arm = stated.replace(noise=noise, recording={"columns": columns})
        return read_recording(folder, System.resolve(arm).channels)

    with pytest.raises(RecordingError, match=r"probably in deg.*LeRobot robots store degrees.*sca"):
        read()
    with pytest.raises(RecordingError, match="the command 'ctrl:yaw' has none; state the same"):
        read("qpos")
    recording = read("qpos", "ctrl")
    assert_allclose(recording.y, np.deg2rad(angles), rtol=1e-5)
    assert_allclose(recording.ctrl, np.deg2rad(angles[:-1]), rtol=1e-5)


def test_stamps_of_a_clock_are_kept(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", episodes(1), NAMES, info={"fps": 90.0})
    assert_allclose(read_columns(folder, ALL).column("t"), np.arange(40) / 100, rtol=1e-6)


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"codebase_version": "v1.6"}, "LeRobot format 'v1.6'; the formats v2.0, v2.1 and v3.0"),
        ({"codebase_version": None}, "LeRobot format 'None'"),
        ({"total_episodes": "two"}, "total_episodes is 'two'; expected at least 1"),
        ({"fps": 0}, "fps is 0; expected a positive number"),
        ({"features": []}, "has no table of features"),
    ],
)
def test_wrong_descriptions(info: dict[str, Any], said: str, tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", episodes(1), NAMES, info=info)
    with pytest.raises(RecordingError, match=said):
        read_columns(folder, ALL)


def test_damage_is_one_sentence(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", episodes(1), NAMES)
    file = next(folder.rglob("*.parquet"))
    whole = file.read_bytes()
    for share in (0.0, 0.3, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(RecordingError, match="not a readable Parquet file"):
            read_columns(folder, ALL)
    file.unlink()
    with pytest.raises(RecordingError, match="has no data file of episode 0"):
        read_columns(folder, ALL)
    (folder / "meta" / "info.json").write_text("[]", encoding="utf-8")
    with pytest.raises(RecordingError, match="not a JSON object"):
        read_columns(folder, ALL)


def test_keys_that_do_not_fit(tmp_path: Path) -> None:
    folder = write_dataset(tmp_path / "set", episodes(1), NAMES)
    with pytest.raises(RecordingError, match=r"recording\.time_unit.*LeRobot dataset is in sec"):
        read_columns(folder, RecordingSpec(time_unit="ms"))
    with pytest.raises(ExperimentError, match=r"recording\.episodes"):
        cart(episodes=[-1])


def test_the_verbs_read_all_episodes(tmp_path: Path) -> None:
    """Each episode of a folder is a recording of the check."""
    stated = cart_pendulum()
    folder = write_dataset(tmp_path / "set", episodes(2), NAMES)
    done = run("check", stated.source, folder, "--json")
    assert done.exit_code in (0, 1), done.stderr
    assert "verdict" in done.stdout
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"without meta/info\.json is not a LeRobot dataset"):
        read_recording(tmp_path / "empty", cart().channels)
