"""ROS 2 bags of joint states, written by the library's own writer; needs the extra `ros`."""

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
    """The state as a `sensor_msgs/msg/JointState`."""
    types = STORE.types
    stamp = types["builtin_interfaces/msg/Time"](
        sec=state.stamp // 10**9, nanosec=state.stamp % 10**9
    )
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    arrays = (np.array(v, dtype=np.float64) for v in (state.position, state.velocity, state.effort))
    return types["sensor_msgs/msg/JointState"](header, list(state.names), *arrays)


def write(path: Path, storage: Any, topics: dict[str, list[State]], text: bool = False) -> Path:
    """Write a bag with these topics and return its folder; text adds a topic of strings."""
    with Writer(path, version=9, storage_plugin=storage) as writer:
        if text:
            other = writer.add_connection("/log", "std_msgs/msg/String", typestore=STORE)
            raw = STORE.serialize_cdr(
                STORE.types["std_msgs/msg/String"](data="hello"), "std_msgs/msg/String"
            )
            writer.write(other, EPOCH, raw)
        for topic, states in topics.items():
            kind = "sensor_msgs/msg/JointState"
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for state in states:
                received = state.stamp + 500_000 if state.received is None else state.received
                writer.write(connection, received, STORE.serialize_cdr(message(state), kind))
    return path
