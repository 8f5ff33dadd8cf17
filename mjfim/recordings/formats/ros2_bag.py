"""ROS 2 bags as columns: joint states by topic. The library `rosbags` is brought only where a bag is read.

Messages are read by the definition that ROS publishes, not by the one inside the bag: the library turns definitions into
code, and a file from elsewhere has no say in that.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, unknown
from mjfim.recordings.formats.table import Table, said
from mjfim.recordings.spec import RecordingSpec

JOINT_STATE = "sensor_msgs/msg/JointState"
KINDS = ("position", "velocity", "effort")
NANO = 1_000_000_000


@dataclass(frozen=True)
class Layout:
    """What messages of one shape hold. kinds: those that are not empty"""

    topic: str
    joints: tuple[str, ...]
    kinds: tuple[str, ...]

    def labels(self, several: bool) -> list[str]:
        """Names of the columns, with the topic where there are several."""
        prefix = f"{self.topic}:" if several else ""
        return [f"{prefix}{kind}:{joint}" for kind in self.kinds for joint in self.joints]


@dataclass
class Block:
    """Messages of one layout. stamps: [ns];  values: row by row"""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))


def read_bag(path: Path, spec: RecordingSpec) -> Table:
    """`t` [s] from the first stamp, `position:<joint>`, `velocity:<joint>`, `effort:<joint>` of a bag's joint states.

    With several topics in the recording, `<topic>:position:<joint>`, rows of all merged by time. Raises RecordingError.
    """
    if spec.time_unit != "s":
        raise RecordingError(
            f"{path}: recording.time_unit: the stamps of a bag are in seconds; leave it out"
        )
    rosbag2, typesys = _library(path, "rosbags.rosbag2"), _library(path, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    try:
        with rosbag2.Reader(path) as reader:
            connections = _connections(path, reader.connections, spec.topics)
            blocks = _blocks(path, reader, connections, store)
    except RecordingError:
        raise
    except Exception as error:  # what a damaged bag makes of a reader written for sound ones
        raise RecordingError(
            f"{path}: not a readable ROS 2 bag (damaged or truncated?): {said(error)}"
        ) from None
    if not blocks:
        raise RecordingError(
            f"{path}: topic {', '.join(c.topic for c in connections)} has no message"
        )
    return _merged(path, blocks, several=len(spec.topics) > 1)


def _library(path: Path, name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise RecordingError(
            f"{path}: bags are read through the library rosbags; pip install 'mjfim[ros]'"
        ) from None


def _connections(path: Path, connections: Iterable[Any], topics: tuple[str, ...]) -> list[Any]:
    """Of the wanted topics, or of the only one."""
    states = [c for c in connections if c.msgtype == JOINT_STATE]
    held = sorted({c.topic for c in states})
    if not held:
        others = ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in connections})) or "none"
        raise RecordingError(
            f"{path}: no topic of {JOINT_STATE}, the only messages that are read; found: {others}"
        )
    for topic in topics:
        if topic not in held:
            raise RecordingError(f"{path}: recording.topics: {unknown('topic', topic, held)}")
    if len(held) > 1 and not topics:
        raise RecordingError(
            f"{path}: several topics of joint states: {', '.join(held)}; say which by recording.topics"
        )
    return [c for c in states if c.topic in (topics or held)]


def _blocks(path: Path, reader: Any, connections: list[Any], store: Any) -> dict[Layout, Block]:
    """All messages by layout. Raises RecordingError where the stamps of like messages do not increase."""
    blocks: dict[Layout, Block] = {}
    last: dict[tuple[str, frozenset[str]], int] = {}
    for number, (connection, received, raw) in enumerate(reader.messages(connections=connections)):
        message = store.deserialize_cdr(raw, JOINT_STATE)
        where = f"{path}: topic {connection.topic!r}, message {number + 1}"
        joints = tuple(message.name)
        layout = Layout(
            connection.topic, joints, tuple(k for k in KINDS if len(getattr(message, k)))
        )
        if any(len(getattr(message, kind)) != len(joints) for kind in layout.kinds):
            raise RecordingError(
                f"{where}: as many names as numbers are wanted ({len(joints)} names)"
            )
        stamp = message.header.stamp.sec * NANO + message.header.stamp.nanosec or received
        before = last.get((connection.topic, frozenset(joints)))
        if before is not None and stamp <= before:
            said = (
                "has the stamp of the one before"
                if stamp == before
                else "has a stamp before the last one's"
            )
            raise RecordingError(
                f"{where}: {said} ({(stamp - before) / NANO:g} s); time must increase"
            )
        last[connection.topic, frozenset(joints)] = stamp
        block = blocks.get(layout)
        if block is None:
            if len(set(joints)) < len(joints):
                raise RecordingError(f"{where}: a joint is named twice: {', '.join(joints)}")
            block = blocks[layout] = Block()
        block.stamps.append(stamp)
        for kind in layout.kinds:
            block.values.frombytes(np.asarray(getattr(message, kind), dtype=np.float64).tobytes())
    return blocks


def _merged(path: Path, blocks: dict[Layout, Block], several: bool) -> Table:
    """One row per stamp."""
    stamps = np.unique(
        np.concatenate([np.frombuffer(b.stamps, dtype=np.int64) for b in blocks.values()])
    )
    # whole nanoseconds first: since 1970 they are too many for a float64
    columns: dict[str, Array] = {"t": (stamps - stamps[0]).astype(np.float64) / NANO}
    for layout, block in blocks.items():
        labels = layout.labels(several)
        rows = np.searchsorted(stamps, np.frombuffer(block.stamps, dtype=np.int64))
        values = np.frombuffer(block.values, dtype=np.float64).reshape(len(rows), len(labels))
        for label, column in zip(labels, values.T, strict=True):
            columns.setdefault(label, np.full(len(stamps), np.nan))[rows] = column
    return Table(path, columns)
