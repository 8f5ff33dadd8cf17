"""Reader of the joint states in ROS 2 bags.

The library rosbags is an optional extra (`pip install 'mjfim[ros]'`); no ROS installation is
needed. Messages of several topics or publishers are merged by their time stamps.
"""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Iterable
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

# Time stamps [ns] and numbers of every column, by topic, quantity and joint.
Samples = dict[tuple[str, str, str], "tuple[array[int], array[float]]"]


def read_bag(path: Path, spec: RecordingSpec) -> Table:
    """Read the joint states of a ROS 2 bag.

    Args:
        path: Folder of the bag, or the file in it.
        spec: Table `[recording]`, which may choose topics.

    Returns:
        The time `t` since the first message [s], and `<quantity>:<joint>` for every quantity in
        `QUANTITIES`; with several topics `<topic>:<quantity>:<joint>`. Controls are `ctrl:<name>`.

    Raises:
        RecordingError: The bag is damaged, has no joint states, or has several topics of them and
            none is chosen.
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
            samples = _samples(path, reader, connections, store)
    except RecordingError:
        raise
    except Exception as error:
        # The reader assumes an intact bag; a damaged one can cause any exception inside it.
        raise RecordingError(
            f"{path}: not a readable ROS 2 bag (damaged or truncated?): {one_line(error)}"
        ) from None

    if not samples:
        topics = listed([connection.topic for connection in connections])
        raise RecordingError(f"{path}: topic {topics} has no message")
    measured = {topic for topic in spec.topics if topic != CONTROL_TOPIC}
    return _merged(path, samples, with_topic=len(measured) > 1)


def rosbags_module(path: Path, name: str) -> Any:
    """Import a module of the optional library.

    Args:
        path: The bag, for the message.
        name: Name of the module.

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


def _samples(path: Path, reader: Any, connections: list[Any], store: Any) -> Samples:
    """Read all messages, and collect their numbers by column."""
    samples: Samples = defaultdict(lambda: (array("q"), array("d")))
    for number, (connection, received, raw) in enumerate(reader.messages(connections=connections)):
        message = store.deserialize_cdr(raw, JOINT_STATE)
        # A message without a stamp has the time at which it was received.
        stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec or received
        for quantity in QUANTITIES:
            values = getattr(message, quantity).tolist()
            if values and len(values) != len(message.name):
                raise RecordingError(
                    f"{path}: topic {connection.topic!r}, message {number + 1}: a field does not "
                    f"have one value for each of the {len(message.name)} joints"
                )
            for joint, value in zip(message.name, values, strict=False):
                stamps, numbers = samples[connection.topic, quantity, joint]
                stamps.append(stamp)
                numbers.append(value)
    return samples


def _merged(path: Path, samples: Samples, with_topic: bool) -> Table:
    """Merge all columns into one table with one row per stamp."""
    all_stamps = [np.frombuffer(stamps, dtype=np.int64) for stamps, _ in samples.values()]
    stamps = np.unique(np.concatenate(all_stamps))
    # Subtract integers first: a float64 cannot hold nanoseconds since 1970 exactly.
    columns = {"t": (stamps - stamps[0]).astype(np.float64) / NANOSECONDS}
    for ((topic, quantity, joint), (_, numbers)), own in zip(
        samples.items(), all_stamps, strict=True
    ):
        steps = np.diff(own)
        if np.any(steps <= 0):
            row = int(np.argmax(steps <= 0))
            raise RecordingError(
                f"{path}: topic {topic!r}: {quantity} of {joint!r}, message {row + 2} is "
                f"{steps[row] / NANOSECONDS:g} s after the previous one; time must increase"
            )
        is_control = topic == CONTROL_TOPIC
        prefix = f"{topic}:" if with_topic or is_control else ""
        label = "ctrl" if is_control and quantity == "effort" else f"{prefix}{quantity}"
        column: Array = np.full(len(stamps), np.nan)
        column[np.searchsorted(stamps, own)] = np.frombuffer(numbers, dtype=np.float64)
        columns[f"{label}:{joint}"] = column
    return Table.of(path, columns, RecordingSpec(time="t"))
