"""ROS 2 bags that the library wrote: both storages, joints in any order, topics merged by time."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import RecordingError
from mjfim.recordings.formats import read_columns
from mjfim.recordings.section import RecordingSpec

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")

from rosbags.rosbag2 import StoragePlugin

from tests.support.ros2_bag import EPOCH, State, write

PERIOD = 2_000_000  # [ns]
ALL = RecordingSpec()
both = pytest.mark.parametrize("storage", [StoragePlugin.SQLITE3, StoragePlugin.MCAP])


def swing(count: int = 20) -> list[State]:
    """Messages of two joints whose order changes from message to message."""
    both = [(["a", "b"], 1.0), (["b", "a"], -1.0)]
    return [
        State(EPOCH + i * PERIOD, names, [sign * i, -sign * i], [sign * 0.5, -sign * 0.5])
        for i, (names, sign) in enumerate(both * (count // 2))
    ]


@both
def test_joints_are_found_by_name(storage: Any, tmp_path: Path) -> None:
    """The folder of a bag and the file in it are read, times to the nanosecond; effort may be
    empty.
    """
    path = write(tmp_path / "bag", storage, {"/joint_states": swing()}, text=True)
    file = next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    for place in (path, file):
        table = read_columns(place, ALL)
        assert set(table.names) == {"t", "position:a", "position:b", "velocity:a", "velocity:b"}
        rows = np.arange(20)
        assert_array_equal(table.column("position:a"), rows)
        assert_array_equal(table.column("position:b"), -rows)
        assert_array_equal(table.column("velocity:a"), 0.5)
        assert_array_equal(table.column("t"), rows * PERIOD / 1e9)


@both
def test_topics_are_merged_by_time(storage: Any, tmp_path: Path) -> None:
    """There is one row per stamp, empty where a topic has no message."""
    arm = [State(EPOCH + i * PERIOD, ["a"], [float(i)]) for i in range(4)]
    hand = [
        State(EPOCH + i * PERIOD + (PERIOD // 2 if i else 0), ["a"], (), (), [10.0 * i])
        for i in range(3)
    ]
    path = write(tmp_path / "bag", storage, {"/arm": arm, "/hand": hand})
    with pytest.raises(
        RecordingError, match=r"several topics of joint states: /arm, /hand; .*recording\.topics"
    ):
        read_columns(path, ALL)
    assert read_columns(path, RecordingSpec(topics=("/hand",))).names == ("t", "effort:a")
    table = read_columns(path, RecordingSpec(topics=("/arm", "/hand")))
    nan = np.nan
    assert_allclose(table.column("t"), np.array([0, 2, 3, 4, 5, 6]) * 1e-3, rtol=0, atol=1e-15)
    assert_array_equal(table.column("/arm:position:a"), [0, 1, nan, 2, nan, 3])
    assert_array_equal(table.column("/hand:effort:a"), [0, nan, 10, nan, 20, nan])
    with pytest.raises(
        RecordingError, match=r"recording\.topics: unknown topic '/amr' \(did you mean '/arm'\?\)"
    ):
        read_columns(path, RecordingSpec(topics=("/amr",)))


def test_two_publishers_of_one_topic(tmp_path: Path) -> None:
    stamps = [EPOCH, EPOCH, EPOCH + PERIOD - 1000, EPOCH + PERIOD, EPOCH + 2 * PERIOD]
    joints = [("a", 0.0), ("b", 5.0), ("b", 5.0), ("a", 1.0), ("a", 2.0)]
    states = [
        State(stamp, [joint], [position], received=EPOCH + i)
        for i, (stamp, (joint, position)) in enumerate(zip(stamps, joints, strict=True))
    ]
    table = read_columns(write(tmp_path / "bag", StoragePlugin.MCAP, {"/j": states}), ALL)
    nan = np.nan
    assert_array_equal(table.column("position:a"), [0, nan, 1, 2])
    assert_array_equal(table.column("position:b"), [5, 5, nan, nan])


def test_messages_without_a_stamp_have_the_time_of_reception(tmp_path: Path) -> None:
    states = [State(0, ["a"], [float(i)], received=EPOCH + i * PERIOD) for i in range(3)]
    table = read_columns(write(tmp_path / "bag", StoragePlugin.MCAP, {"/j": states}), ALL)
    assert table.column("t").tolist() == [0.0, 0.002, 0.004]


@pytest.mark.parametrize(
    ("states", "said"),
    [
        (
            [State(EPOCH, ["a"], [0.0]), State(EPOCH, ["a"], [1.0], received=EPOCH + 10**6)],
            "position of 'a', message 2 is 0 s after the previous one",
        ),
        (
            [
                State(EPOCH, ["a"], [0.0], received=EPOCH),
                State(EPOCH - 10**9, ["a"], [1.0], received=EPOCH + 1),
            ],
            "message 2 is -1 s after the previous one; time must increase",
        ),
        (
            [State(EPOCH, ["a", "b"], [0.0])],
            r"message 1: a field does not have one value for each of the 2 joints",
        ),
        ([], "topic /j has no message"),
    ],
)
def test_messages_that_do_not_fit(states: list[State], said: str, tmp_path: Path) -> None:
    path = write(tmp_path / "bag", StoragePlugin.MCAP, {"/j": states}, text=True)
    with pytest.raises(RecordingError, match=said):
        read_columns(path, ALL)


def test_no_joint_states(tmp_path: Path) -> None:
    path = write(tmp_path / "bag", StoragePlugin.MCAP, {}, text=True)
    with pytest.raises(
        RecordingError,
        match=r"no topic of sensor_msgs/msg/JointState.*found: /log \(std_msgs/msg/String\)",
    ):
        read_columns(path, ALL)


@both
def test_truncated_bags(storage: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "bag", storage, {"/j": swing(400)})
    file = next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))
    whole = file.read_bytes()
    for share in (0.001, 0.1, 0.5, 0.9):
        file.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(
            RecordingError, match=r"not a readable (ROS 2 bag|MCAP file)|the file is empty"
        ):
            read_columns(file, ALL)
    file.unlink()
    with pytest.raises(RecordingError, match=r"bag: not a readable ROS 2 bag .*missing"):
        read_columns(path, ALL)


def test_without_the_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "bag", StoragePlugin.MCAP, {"/j": swing()})

    # None in place of a module makes its import fail, as if it were not installed.
    for name in [n for n in sys.modules if n.split(".")[0] == "rosbags"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rosbags", None)

    with pytest.raises(RecordingError, match=r"pip install 'mjfim\[ros\]'"):
        read_columns(path, ALL)
