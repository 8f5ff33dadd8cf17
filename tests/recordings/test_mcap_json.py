"""MCAP files with JSON messages, as Foxglove and bridges of ROS write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.errors import RecordingError
from mjfim.recordings.formats import read_columns
from mjfim.recordings.section import RecordingSpec

writer = pytest.importorskip("mcap.writer", reason="the extra `ros` is not installed")

PERIOD = 10_000_000  # [ns]


def write(path: Path, topics: dict[str, list[Any]], encoding: str = "json") -> Path:
    """Write messages, one of each topic at a time."""
    with path.open("wb") as file:
        log = writer.Writer(file)
        log.start()
        for topic, contents in topics.items():
            schema = log.register_schema(topic, "jsonschema", b"{}")
            channel = log.register_channel(topic, encoding, schema)
            for number, content in enumerate(contents):
                time = 1_800_000_000_000_000_000 + number * PERIOD
                log.add_message(channel, time, json.dumps(content).encode(), time)
        log.finish()
    return path


def test_lists_of_joints_become_columns_by_their_names(tmp_path: Path) -> None:
    """Names beside numbers, as in ROS; joints with their names, as in Foxglove; plain lists."""
    ros = [{"header": {"frame_id": "a"}, "name": ["a", "b"], "position": [i, -i]} for i in range(3)]
    foxglove = [{"joints": [{"name": "a", "velocity": 2 * i}]} for i in range(3)]
    plain = [{"data": [0.5, i], "on": True} for i in range(2)]
    table = read_columns(
        write(tmp_path / "x.mcap", {"/ros": ros, "/fox": foxglove, "/plain": plain}),
        RecordingSpec(),
    )
    for name, wanted in (
        ("/ros.position.b", [0, -1, -2]),
        ("/fox.joints.a.velocity", [0, 2, 4]),
        ("/plain.data.1", [0, 1]),
    ):
        column = table.column(name)
        assert column[np.isfinite(column)].tolist() == wanted
    assert np.unique(table.column("t")).tolist() == [0.0, 0.01, 0.02]
    assert not [name for name in table.names if "frame_id" in name or name.endswith(".on")]


def test_stamps_of_messages_have_no_other_unit(tmp_path: Path) -> None:
    path = write(tmp_path / "x.mcap", {"/state": [{"data": 1}]})
    with pytest.raises(RecordingError, match=r"recording\.time_unit"):
        read_columns(path, RecordingSpec(time_unit="ms"))


@pytest.mark.parametrize(
    ("topics", "said"), [(("/gone",), "found: /state"), ((), "not a readable MCAP file")]
)
def test_faults_are_named(topics: tuple[str, ...], said: str, tmp_path: Path) -> None:
    path = write(tmp_path / "x.mcap", {"/state": [{"data": 1}]})
    if not topics:
        path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(RecordingError, match=said):
        read_columns(path, RecordingSpec(topics=topics))
