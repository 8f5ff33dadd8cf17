"""A design as a ROS 2 bag: the joint trajectory, the planned joint states and the controls.

`ros2 bag play` of the bag publishes the trajectory on the topic of a trajectory controller. The
planned states and controls are on topics of mjfim, which no robot listens to; `identify` reads them
as a recording without noise.

The library `rosbags` writes the bag; it is imported only when a bag is written.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mjfim.arrays import Array
from mjfim.files import remove_earlier_result, replacing
from mjfim.output.robot.joint_trajectory import (
    NANOSECONDS,
    TRAJECTORY_TOPIC,
    TRAJECTORY_TYPE,
    JointTrajectory,
)
from mjfim.output.robot.plan import RobotPlan
from mjfim.recordings.formats.ros2_bag import CONTROL_TOPIC, JOINT_STATE, rosbags_module

# Formats of the file inside a bag.
Storage = Literal["mcap", "sqlite3"]

# Ending of the file inside a bag, by its format.
ENDINGS: Mapping[Storage, str] = {"mcap": ".mcap", "sqlite3": ".db3"}

# Topic of the planned joint states; that of a robot is not used, because `ros2 bag play` publishes.
PLANNED_TOPIC = "/mjfim/planned_joint_states"

# Version of the format of bags that all supported versions of ROS 2 read.
BAG_VERSION = 9

# Time stamp of the start of the design [ns]. A stamp of 0 means that there is no stamp.
START = NANOSECONDS


def bag_files(folder: Path) -> tuple[str, ...]:
    """List the files that a bag may have.

    Args:
        folder: Folder of the bag, whose name is also that of the file in it.
    """
    name = folder.absolute().name
    return ("metadata.yaml", *(f"{name}{ending}" for ending in ENDINGS.values()))


def write_bag(
    folder: Path, plan: RobotPlan, trajectory: JointTrajectory, storage: Storage = "mcap"
) -> None:
    """Write a design as a ROS 2 bag.

    Args:
        folder: Folder of the bag.
        plan: The design.
        trajectory: Its joint trajectory.
        storage: Format of the file in the bag.

    Raises:
        RecordingError: The library rosbags is not installed.
    """
    rosbag2 = rosbags_module(folder, "rosbags.rosbag2")
    typesys = rosbags_module(folder, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    messages = _Messages(store)
    name = folder.absolute().name

    # The library writes a folder that does not exist yet; its files are then put in their places.
    with tempfile.TemporaryDirectory() as scratch:
        plugin = getattr(rosbag2.StoragePlugin, storage.upper())
        with rosbag2.Writer(
            Path(scratch) / name, version=BAG_VERSION, storage_plugin=plugin
        ) as bag:
            _write_trajectory(bag, messages, trajectory)
            _write_states(bag, messages, plan)
        _place(Path(scratch) / name, folder, name, ENDINGS[storage])


def _place(written: Path, folder: Path, name: str, ending: str) -> None:
    """Replace the files of a bag, the data first; remove those of another format."""
    for file in (f"{name}{ending}", "metadata.yaml"):
        with replacing(folder / file) as temporary:
            shutil.copyfile(written / file, temporary)

    for other in ENDINGS.values():
        stale = folder / f"{name}{other}"
        if other != ending and stale.is_file():
            remove_earlier_result(stale)


def _write_trajectory(bag: Any, messages: _Messages, trajectory: JointTrajectory) -> None:
    """Write the joint trajectory as one message at the start."""
    connection = bag.add_connection(TRAJECTORY_TOPIC, TRAJECTORY_TYPE, typestore=messages.store)
    message = messages.trajectory(trajectory)
    bag.write(connection, START, messages.store.serialize_cdr(message, TRAJECTORY_TYPE))


def _write_states(bag: Any, messages: _Messages, plan: RobotPlan) -> None:
    """Write the planned joint states and the controls, one message of each for each row."""
    joints = [joint.name for joint in plan.system.coordinates]
    planned = [_side_by_side(plan, field, joints) for field in ("qpos", "qvel", "force")]
    controls = [drive.name for drive in plan.drives]
    ctrl = plan.held_control
    nothing = np.zeros(0)

    state_topic, control_topic = (
        bag.add_connection(topic, JOINT_STATE, typestore=messages.store)
        for topic in (PLANNED_TOPIC, CONTROL_TOPIC)
    )
    for k, t in enumerate(plan.playback.t.tolist()):
        stamp = START + round(t * NANOSECONDS)
        state = messages.joint_state(stamp, joints, [values[k] for values in planned])
        bag.write(state_topic, stamp, messages.store.serialize_cdr(state, JOINT_STATE))
        control = messages.joint_state(stamp, controls, [nothing, nothing, ctrl[k]])
        bag.write(control_topic, stamp, messages.store.serialize_cdr(control, JOINT_STATE))


def _side_by_side(plan: RobotPlan, field: str, joints: Sequence[str]) -> Array:
    """(M+1, n) columns of one field of reference.csv; no columns if there are no joints."""
    columns = [plan.column(f"{field}:{joint}") for joint in joints]
    return np.column_stack(columns) if columns else np.zeros((len(plan.playback.t), 0))


class _Messages:
    """Messages of ROS 2, made from the definitions of a typestore.

    Attributes:
        store: The typestore.
    """

    def __init__(self, store: Any) -> None:
        """Remember the definitions.

        Args:
            store: The typestore.
        """
        self.store = store

    def trajectory(self, trajectory: JointTrajectory) -> Any:
        """The joint trajectory as a message; a stamp of 0 lets it begin at once."""
        types = self.store.types
        fields = trajectory.fields()
        nothing = np.zeros(0)
        points = []
        for k, nanoseconds in enumerate(trajectory.nanoseconds):
            sec, nanosec = divmod(nanoseconds, NANOSECONDS)
            rows = {name: values[k] for name, values in fields.items()}
            points.append(
                types["trajectory_msgs/msg/JointTrajectoryPoint"](
                    positions=rows["positions"],
                    velocities=rows.get("velocities", nothing),
                    accelerations=rows.get("accelerations", nothing),
                    effort=rows.get("effort", nothing),
                    time_from_start=types["builtin_interfaces/msg/Duration"](
                        sec=sec, nanosec=nanosec
                    ),
                )
            )
        return types[TRAJECTORY_TYPE](self._header(0), list(trajectory.joints), points)

    def joint_state(self, stamp: int, names: Sequence[str], values: Sequence[Array]) -> Any:
        """A joint state; values: position, velocity and effort, each empty or one per name."""
        return self.store.types[JOINT_STATE](self._header(stamp), list(names), *values)

    def _header(self, stamp: int) -> Any:
        """A header with a time stamp [ns]."""
        types = self.store.types
        sec, nanosec = divmod(stamp, NANOSECONDS)
        time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return types["std_msgs/msg/Header"](stamp=time, frame_id="")
