"""ROS 2 bags of joint states, written by the library rosbags of the extra `ros`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

# Definitions of the ROS 2 message types.
STORE = get_typestore(Stores.ROS2_HUMBLE)

# Time stamp of the first message [ns].
EPOCH = 1_700_000_000_123_456_789


@dataclass(frozen=True)
class State:
    """A joint state message; `stamp` and `received` are times in ns."""

    stamp: int
    names: Sequence[str]
    position: Sequence[float] = ()
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()
    received: int | None = None


def message(state: State) -> Any:
    """Return the state as a `sensor_msgs/msg/JointState`."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](
        sec=state.stamp // 10**9, nanosec=state.stamp % 10**9
    )
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    values = (state.position, state.velocity, state.effort)
    arrays = [np.array(v, dtype=np.float64) for v in values]
    return types["sensor_msgs/msg/JointState"](header, list(state.names), *arrays)


def write(path: Path, storage: Any, topics: dict[str, list[State]], text: bool = False) -> Path:
    """Write a bag and return its folder.

    Args:
        path: Folder of the bag.
        storage: Storage plugin of rosbags.
        topics: States of every topic.
        text: Whether a topic of strings is added.
    """
    with Writer(path, version=9, storage_plugin=storage) as writer:
        if text:
            other = writer.add_connection("/log", "std_msgs/msg/String", typestore=STORE)
            hello = STORE.types["std_msgs/msg/String"](data="hello")
            writer.write(other, EPOCH, STORE.serialize_cdr(hello, "std_msgs/msg/String"))

        for topic, states in topics.items():
            kind = "sensor_msgs/msg/JointState"
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for state in states:
                received = state.stamp + 500_000 if state.received is None else state.received
                writer.write(connection, received, STORE.serialize_cdr(message(state), kind))

    return path
