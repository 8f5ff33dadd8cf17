"""Reader of the joint states in ROS 2 bags.

The library `rosbags` is imported only when a bag is read.

Messages are read with the definition that ROS publishes, not with the one inside the bag: the
library generates code from definitions, and a file of unknown origin must not control this code.
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
from mjfim.errors import RecordingError, listed, unknown
from mjfim.recordings.formats.table import Table, one_line
from mjfim.recordings.spec import RecordingSpec

# Type of the messages that are read; all other messages are ignored.
JOINT_STATE = "sensor_msgs/msg/JointState"

# Topic of the controls that were sent: joint states that have the names of the controls, and the
# controls as efforts. mjfim writes it, and a program that plays a design may publish it.
CONTROL_TOPIC = "/mjfim/control"

# Fields of a joint state that become columns.
QUANTITIES = ("position", "velocity", "effort")

# Nanoseconds per second.
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class _Layout:
    """Joints and quantities of a message; messages of one layout are collected in one block.

    Attributes:
        topic: Name of the topic.
        joints: Names of the joints, in the order of the messages.
        quantities: Fields of `QUANTITIES` that are not empty.
    """

    topic: str
    joints: tuple[str, ...]
    quantities: tuple[str, ...]

    def column_names(self, with_topic: bool) -> list[str]:
        """Names of the columns, in the order of a message's numbers."""
        is_control = self.topic == CONTROL_TOPIC
        prefix = f"{self.topic}:" if with_topic or is_control else ""
        labels = {quantity: f"{prefix}{quantity}" for quantity in QUANTITIES}
        if is_control:
            labels["effort"] = "ctrl"

        return [f"{labels[name]}:{joint}" for name in self.quantities for joint in self.joints]


@dataclass(kw_only=True)
class _Block:
    """Messages of one layout, which are appended while the bag is read.

    Attributes:
        stamps: M time stamps [ns].
        values: The numbers of all messages, message by message.
    """

    stamps: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))


def read_bag(path: Path, spec: RecordingSpec) -> Table:
    """Read the joint states of a ROS 2 bag.

    The columns are `t` [s after the first stamp] and `position:<joint>`, `velocity:<joint>`,
    `effort:<joint>`. If several topics are read, their names begin with the topic, as in
    `<topic>:position:<joint>`, and the rows of all topics are merged by time. The efforts of the
    topic `CONTROL_TOPIC`, which is always read beside the only other one, are `ctrl:<name>`.

    Args:
        path: The folder of the bag, or its file.
        spec: The `[recording]` table; `topics` selects topics.

    Returns:
        All columns; NaN if a topic has no message at a time.

    Raises:
        RecordingError: The bag is damaged, has no joint states, it is not clear which topic to
            read, or the library is not installed.
    """
    if spec.time_unit != "s":
        raise RecordingError(
            f"{path}: recording.time_unit: the time of a bag is in seconds; leave this key out"
        )

    rosbag2 = rosbags_module(path, "rosbags.rosbag2")
    typesys = rosbags_module(path, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    try:
        with rosbag2.Reader(path) as reader:
            connections = _connections(path, reader.connections, spec.topics)
            blocks = _blocks(path, reader, connections, store)
    except RecordingError:
        raise
    except Exception as error:
        # The reader assumes an intact bag; a damaged one can cause any exception inside it.
        raise RecordingError(
            f"{path}: not a readable ROS 2 bag (damaged or truncated?): {one_line(error)}"
        ) from None

    if not blocks:
        topics = listed([connection.topic for connection in connections])
        raise RecordingError(f"{path}: topic {topics} has no message")
    measured = {topic for topic in spec.topics if topic != CONTROL_TOPIC}
    return _merged(path, blocks, with_topic=len(measured) > 1)


def rosbags_module(path: Path, name: str) -> Any:
    """Import a module of the optional library.

    Args:
        path: The bag, for the message.
        name: The module.

    Raises:
        RecordingError: The library is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise RecordingError(
            f"{path}: ROS 2 bags need the library rosbags; pip install 'mjfim[ros]'"
        ) from None


def _connections(path: Path, connections: Iterable[Any], topics: tuple[str, ...]) -> list[Any]:
    """Connections of the stated topics, or of the only topic with joint states."""
    connections = list(connections)
    states = [c for c in connections if c.msgtype == JOINT_STATE]
    available = sorted({c.topic for c in states})

    if not available:
        others = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
        raise RecordingError(
            f"{path}: no topic of {JOINT_STATE}, the only type of message that is read; "
            f"found: {listed(others)}"
        )
    for topic in topics:
        if topic not in available:
            raise RecordingError(f"{path}: recording.topics: {unknown('topic', topic, available)}")
    measured = [topic for topic in available if topic != CONTROL_TOPIC]
    if len(measured) > 1 and not topics:
        raise RecordingError(
            f"{path}: several topics of joint states: {listed(measured)}; select one by "
            "recording.topics"
        )

    return [c for c in states if c.topic in (topics or available)]


def _blocks(path: Path, reader: Any, connections: list[Any], store: Any) -> dict[_Layout, _Block]:
    """Read all messages and collect them by layout."""
    blocks: dict[_Layout, _Block] = {}

    # Messages of several publishers of one topic may interleave, so the stamps must increase only
    # among messages with equal joints.
    last: dict[tuple[str, frozenset[str]], int] = {}

    for number, (connection, received, raw) in enumerate(reader.messages(connections=connections)):
        message = store.deserialize_cdr(raw, JOINT_STATE)
        where = f"{path}: topic {connection.topic!r}, message {number + 1}"
        layout = _layout(where, connection.topic, message)

        # A message without a stamp has the time at which it was received.
        stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec or received
        publisher = (connection.topic, frozenset(layout.joints))
        _check_order(where, stamp, last.get(publisher))
        last[publisher] = stamp

        block = blocks.get(layout)
        if block is None:
            if len(set(layout.joints)) < len(layout.joints):
                joints = listed(layout.joints)
                raise RecordingError(f"{where}: a joint is listed twice: {joints}")
            block = blocks[layout] = _Block()

        block.stamps.append(stamp)
        for quantity in layout.quantities:
            numbers = np.asarray(getattr(message, quantity), dtype=np.float64)
            block.values.frombytes(numbers.tobytes())

    return blocks


def _layout(where: str, topic: str, message: Any) -> _Layout:
    """Layout of a message; a field that is not empty must have one number per joint."""
    joints = tuple(message.name)
    quantities = tuple(name for name in QUANTITIES if len(getattr(message, name)))

    if any(len(getattr(message, name)) != len(joints) for name in quantities):
        raise RecordingError(
            f"{where}: a field does not have one value for each of the {len(joints)} joints"
        )
    return _Layout(topic=topic, joints=joints, quantities=quantities)


def _check_order(where: str, stamp: int, last: int | None) -> None:
    """Refuse a stamp [ns] that is not later than the last one."""
    if last is None or stamp > last:
        return

    fault = (
        "has the stamp of the previous message"
        if stamp == last
        else "has an earlier stamp than the previous message"
    )
    raise RecordingError(
        f"{where}: {fault} ({(stamp - last) / NANOSECONDS:g} s); time must increase"
    )


def _merged(path: Path, blocks: dict[_Layout, _Block], with_topic: bool) -> Table:
    """Merge all messages into one table with one row per stamp."""
    all_stamps = [np.frombuffer(block.stamps, dtype=np.int64) for block in blocks.values()]
    stamps = np.unique(np.concatenate(all_stamps))

    # Subtract integers first: a float64 cannot hold nanoseconds since 1970 exactly.
    t = (stamps - stamps[0]).astype(np.float64) / NANOSECONDS
    columns: dict[str, Array] = {"t": t}

    for (layout, block), block_stamps in zip(blocks.items(), all_stamps, strict=True):
        names = layout.column_names(with_topic)
        rows = np.searchsorted(stamps, block_stamps)
        values = np.frombuffer(block.values, dtype=np.float64).reshape(len(rows), len(names))

        for name, column in zip(names, values.T, strict=True):
            columns.setdefault(name, np.full(len(stamps), np.nan))[rows] = column

    return Table(source=path, columns=columns)
