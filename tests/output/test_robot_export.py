"""Designs for ROS 2: trajectories in YAML and in bags, which other libraries read."""

from __future__ import annotations

import re
import runpy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import ExperimentError
from mjfim.experiment import System
from mjfim.output import archive
from mjfim.output.export.design import write_player
from mjfim.output.export.trajectories import (
    JointTrajectory,
    RobotPlan,
    write_trajectory_yaml,
)
from mjfim.recordings import read_recording
from mjfim.recordings.formats import read_table
from tests.output.conftest import Designed, designed
from tests.support.cli import done, names
from tests.support.paths import MODELS

pytest.importorskip("rosbags", reason="the extra `ros` is not installed")

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(cart: Designed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("design")
    archive.write_data(place, cart[1], System.resolve(cart[0]))
    return place


def load(text: str) -> Any:
    """What a reader of YAML makes of a text."""
    return YAML(typ="safe", pure=True).load(text)


def stack(points: list[dict[str, Any]], field: str) -> np.ndarray:
    return np.array([point[field] for point in points])


def test_a_trajectory_holds_the_rows_of_the_reference(
    cart: Designed, folder: Path, tmp_path: Path
) -> None:
    """The joint with the motor, with the force of the control, at the times of the rows."""
    remarks = mjfim.export_design(*cart, tmp_path / "trajectory.yaml", to="ros2")
    text = (tmp_path / "trajectory.yaml").read_text(encoding="utf-8")
    found, rows = load(text), read_table(folder / "reference.csv")

    assert found["joint_names"] == ["slide"]
    assert found["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    points = found["points"]
    columns = {"positions": "qpos", "velocities": "qvel", "accelerations": "qacc"}
    for field, column in {**columns, "effort": "force"}.items():
        assert_allclose(stack(points, field)[:, 0], rows[f"{column}:slide"], rtol=1e-11)
    assert_allclose(stack(points, "effort")[:-1], cart[1].trajectory.ctrl, rtol=1e-11)

    times = np.array([[*point["time_from_start"].values()] for point in points])
    assert_allclose(times @ [1.0, 1e-9], rows["t"], atol=1e-12)
    assert times.dtype == int and times[:, 1].min() >= 0 and times[:, 1].max() < 10**9
    assert any("does not end at rest" in sentence for sentence in remarks)

    # In YAML 1.1 a float needs a decimal point, and its exponent a sign.
    numbers = re.findall(r"(?<=[\[ ])-?[0-9][^,\]\s]*e[^,\]\s]*", text)
    assert all(re.fullmatch(r"-?[0-9]+\.[0-9]*e[-+][0-9]+", number) for number in numbers)

    # The shell puts the file into a goal of an action.
    assert load(f"{{trajectory: {text.rstrip()}}}") == {"trajectory": found}


RARE = "\u2028\u0085\U0001f600\\u00e9\"'#\t\r\x7f:{é"


def test_rare_characters_in_names_come_back(cart: Designed, tmp_path: Path) -> None:
    """In the YAML and in the player, whose readers end lines at other characters than Python."""
    plan = replace(RobotPlan.of(cart[1], System.resolve(cart[0])), name=RARE)
    trajectory = JointTrajectory(joints=[RARE, "b"], nanoseconds=[0], fields={}, content="motion")
    write_trajectory_yaml(tmp_path / "trajectory.yaml", trajectory, RARE)
    text = (tmp_path / "trajectory.yaml").read_text(encoding="utf-8")
    assert load(text)["joint_names"] == [RARE, "b"]

    write_player(tmp_path / "play.py", plan)
    assert runpy.run_path(str(tmp_path / "play.py"))["DESIGN"]["name"] == RARE


def test_servos_get_their_commands(arm: Designed, tmp_path: Path) -> None:
    """Positions are the controls of the design; the planned motion is there on request."""
    remarks = mjfim.export_design(*arm, tmp_path / "command.yaml", to="ros2")
    found = load((tmp_path / "command.yaml").read_text(encoding="utf-8"))
    ctrl = arm[1].trajectory.ctrl
    held = np.concatenate([ctrl, ctrl[-1:]])
    assert found["joint_names"] == ["yaw", "shoulder", "elbow", "wrist"]
    assert_allclose(stack(found["points"], "positions"), held, rtol=1e-11, atol=1e-15)
    assert {key for point in found["points"] for key in point} == {"positions", "time_from_start"}
    assert any("--positions motion" in sentence for sentence in remarks)

    remarks = mjfim.export_design(*arm, tmp_path / "motion.yaml", to="ros2", positions="motion")
    points = load((tmp_path / "motion.yaml").read_text(encoding="utf-8"))["points"]
    assert_allclose(stack(points, "positions"), arm[1].trajectory.qpos, rtol=1e-11, atol=1e-15)
    assert "effort" not in points[0] and any("effort is left out" in s for s in remarks)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_is_read_by_rosbags_and_as_a_recording(
    storage: str, cart: Designed, tmp_path: Path
) -> None:
    """The message is the trajectory; joint states and controls are a recording of the design."""
    experiment, design = cart
    bag = tmp_path / "bag"
    mjfim.export_design(*cart, bag, to="ros2-bag", storage=storage)
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [c for c in reader.connections if c.topic.endswith("/joint_trajectory")]
        ((connection, _, raw),) = reader.messages(connections=wanted)
        message: Any = reader.deserialize(raw, connection.msgtype)
    assert connection.msgtype == "trajectory_msgs/msg/JointTrajectory"
    assert message.joint_names == ["slide"] and len(message.points) == 401
    positions = np.array([point.positions for point in message.points])
    assert_allclose(positions[:, 0], design.trajectory.qpos[:, 0], atol=1e-12)
    assert message.points[-1].time_from_start.sec == 4

    recording = read_recording(bag, System.resolve(experiment).channels)
    assert_array_equal(recording.ctrl, design.trajectory.ctrl)
    columns = [recording.outputs.index(name) for name in ("qpos:slide", "qpos:hinge")]
    assert_array_equal(recording.y[:, columns], design.trajectory.qpos)


def test_a_bag_replaces_one_of_the_other_format(folder: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    experiment = MODELS / "cart_pendulum.toml"
    words = ("export", folder, "--experiment", experiment, "-o")
    for storage, ending in (("sqlite3", "db3"), ("mcap", "mcap")):
        done(*words, bag, "--to", "ros2-bag", "--storage", storage)
        assert names(bag) == {".mjfim.json", "metadata.yaml", f"bag.{ending}"}


def test_a_robot_without_driven_joints_has_no_joint_trajectory(tmp_path: Path) -> None:
    quadrotor = designed("quadrotor", horizon=0.3)
    with pytest.raises(ExperimentError, match="slides and hinges on which actuators act"):
        mjfim.export_design(*quadrotor, tmp_path / "out.yaml", to="ros2")
