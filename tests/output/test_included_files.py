"""Identified models of several files: included files are copied where a number in them changes."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.errors import ModelError
from mjfim.output.export.mjcf import identified_files, write_identified
from mjfim.output.folders import sample_files
from tests.output.test_mjcf import assert_is_identified_model, changes, compiled, system_of
from tests.support.contents import contents

# A robot of five files: settings with defaults, an arm in the tree, and inside it a hand, all in
# folders of their own. The mesh of the arm lies in the folder of the compiler, that of the hand in
# the folder of the file that names it.
MAIN = """<mujoco model="robot">
  <!-- settings of the laboratory -->
  <include file="settings/common.xml"/>
  <option integrator='implicitfast'   gravity="0 0 -9.8"/>
  <worldbody>
    <body name="base">
      <joint name="base" axis="0 0 1" damping="0.5"/>
      <geom name="base" type="sphere" size="0.1"/>
      <include file="parts/arm.xml"/>
    </body>
  </worldbody>
  <include file="parts/motors.xml"/>
</mujoco>
"""
COMMON = """<mujocoinclude>
  <compiler meshdir="meshes" autolimits="true"/>
  <default>
    <default class="light"> <!-- of the arm --> <joint damping="0.1"/> </default>
  </default>
  <asset><mesh name="block" file="block.obj"/></asset>
</mujocoinclude>
"""
ARM = """<?xml version="1.0"?>
<mujocoinclude>
  <body name="arm" pos="0.2 0 0" childclass="light">
    <joint   name="elbow" axis="0 1 0" armature='0.01'/> <!-- measured in May -->
    <geom name="block" type="mesh" mesh="block"/>
    <frame name="wrist" pos="0.1 0 0">
      <include file="hand/hand.xml"/>
    </frame>
  </body>
</mujocoinclude>
"""
HAND = """<mujocoinclude>
  <body name="hand" pos="0.1 0 0">
    <joint name="finger" axis="1 0 0" damping="0.02" range="-90 90"/>
    <inertial pos="0 0 0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>
    <geom name="nail" type="mesh" mesh="nail" mass="0"/>
  </body>
</mujocoinclude>
"""
MOTORS = """<mujocoinclude>
  <asset><mesh name="nail" file="nail.obj"/></asset>
  <actuator>
    <motor name="base" joint="base"/>
    <position name="elbow" joint="elbow" kp="5"/>
  </actuator>
</mujocoinclude>
"""


def tetrahedron(size: float) -> str:
    """A mesh."""
    corners = f"v 0 0 0\nv {size} 0 0\nv 0 {size} 0\nv 0 0 {size}\n"
    return corners + "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """The main file of the robot in a folder of its own."""
    files = {
        "robot.xml": MAIN,
        "settings/common.xml": COMMON,
        "parts/arm.xml": ARM,
        "parts/hand/hand.xml": HAND,
        "parts/motors.xml": MOTORS,
        "meshes/block.obj": tetrahedron(0.1),
        "parts/nail.obj": tetrahedron(0.01),
    }
    home = tmp_path / "home"
    for name, text in files.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(text, encoding="utf-8")
    return home / "robot.xml"


# Changed numbers by parameter path, and the copies that a change needs.
CHANGES: dict[str, tuple[float, set[str]]] = {
    "joint/base:damping": (0.7, set()),
    "joint/elbow:armature": (0.02, {"identified_arm.xml"}),
    "joint/elbow:damping": (0.3, {"identified_arm.xml"}),
    "joint/finger:damping": (0.05, {"identified_arm.xml", "identified_hand.xml"}),
    "body/hand:mass": (0.4, {"identified_arm.xml", "identified_hand.xml"}),
    "actuator/elbow:gainprm": (6.0, {"identified_motors.xml"}),
    "option:gravity[2]": (-9.81, set()),
}


@pytest.mark.parametrize("place", ["home", "home/parts", "out", "out/deep/folder"])
@pytest.mark.parametrize("path", CHANGES)
def test_the_file_that_holds_the_number_is_copied(
    path: str, place: str, robot: Path, tmp_path: Path
) -> None:
    before = contents(robot.parent)
    value, copies = CHANGES[path]
    targets: list[Any] = [path]
    if path.startswith("actuator"):
        both = [{"path": path}, {"path": "actuator/elbow:biasprm[1]", "scale": -1.0}]
        targets = [{"targets": both, "scale": 1.0}]

    system = system_of(robot, tmp_path, *targets)
    new = tmp_path / place / "identified.xml"
    assert write_identified(new, system, np.array([value])) == []
    assert_is_identified_model(new, system, [value])

    # In another folder, every file that names others relative to the main file is copied, too.
    written = {file.name for file in new.parent.glob("identified*")}
    assert written >= {"identified.xml", *copies}
    assert written <= {"identified.xml", *identified_files(new, robot)}
    if place == "home":
        assert written == {"identified.xml", *copies}
    assert before.items() <= contents(robot.parent).items()


def test_the_text_stays_as_it_is_and_a_copy_can_be_identified_again(
    robot: Path, tmp_path: Path
) -> None:
    system = system_of(robot, tmp_path, "joint/elbow:armature", "joint/finger:damping")
    first = tmp_path / "first" / "identified.xml"
    assert write_identified(first, system, np.array([0.02, 0.05])) == []

    parts, copy = robot.parent / "parts", first.with_name("identified_arm.xml")
    assert changes(parts / "arm.xml", copy)[1] == [
        '<joint name="elbow" axis="0 1 0" armature="0.02"/>',
        '<include file="identified_hand.xml"/>',
    ]
    assert "<!-- measured in May -->" in copy.read_text("utf-8")
    _, gained = changes(parts / "hand" / "hand.xml", first.with_name("identified_hand.xml"))
    assert gained == ['<joint name="finger" axis="1 0 0" damping="0.05" range="-90 90"/>']

    # Each drawn robot has copies of its own.
    (tmp_path / "samples").mkdir()
    (tmp_path / "samples" / "robot_0002_hand.xml").touch()
    assert "samples/robot_0002_hand.xml" in sample_files(tmp_path)

    # In the folder of its own model, the copy takes another name.
    again = system_of(first, tmp_path, "joint/finger:damping")
    for second, name in (
        (tmp_path / "second" / "identified.xml", "identified_hand.xml"),
        (first.with_name("other.xml"), "other_identified_hand.xml"),
    ):
        assert write_identified(second, again, np.array([0.06])) == []
        assert_is_identified_model(second, again, [0.06])
        assert second.with_name(name).is_file()
    assert compiled(first).joint("finger").damping[0] == 0.05


PART = """<mujocoinclude>
  <body name="b#"><joint name="j#" damping="1"/><geom size="0.1"/></body>
</mujocoinclude>"""
ROBOT_OF_PARTS = """<mujoco>
  <worldbody><include file="%s"/><include file="%s"/><include file="%s"/></worldbody>
  <actuator><motor joint="j0"/></actuator>
</mujoco>"""


def test_names_do_not_collide(tmp_path: Path) -> None:
    """Two included files have one name, and a third has the name of a copy."""
    names = ("a/part.xml", "b/part.xml", "identified_part_2.xml")
    for i, name in enumerate(names):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        text = PART.replace("#", str(i))
        (tmp_path / name).write_text(text, encoding="utf-8")
    xml = ROBOT_OF_PARTS % names
    (tmp_path / "model.xml").write_text(xml, encoding="utf-8")
    paths = (f"joint/j{i}:damping" for i in range(3))
    system = system_of(tmp_path / "model.xml", tmp_path, *paths)

    before, new = contents(tmp_path), tmp_path / "identified.xml"
    assert write_identified(new, system, np.array([2.0, 3.0, 4.0])) == []
    assert_is_identified_model(new, system, [2.0, 3.0, 4.0])
    after = contents(tmp_path)
    assert before.items() <= after.items()
    copies = after.keys() - before.keys() - {"identified.xml"}
    assert len(copies) == 3 and set(identified_files(new, tmp_path / "model.xml")) == copies


def test_nothing_is_left_where_the_text_cannot_express_the_value(
    robot: Path, tmp_path: Path
) -> None:
    """MuJoCo prints the pose of a body in a turned frame; no copy stays."""
    arm = robot.parent / "parts" / "arm.xml"
    arm.write_text(ARM.replace('pos="0.1 0 0">', 'euler="0 0 9">'), encoding="utf-8")
    system = system_of(robot, tmp_path, "body/hand:pos[0]", "joint/elbow:armature")
    new = tmp_path / "out" / "identified.xml"
    (said,) = write_identified(new, system, np.array([0.25, 0.02]))
    assert "printed by MuJoCo" in said
    assert os.listdir(new.parent) == ["identified.xml"]
    assert compiled(new).body("hand").pos[0] == 0.25


def test_a_mesh_that_is_edited_meanwhile_is_told(robot: Path, tmp_path: Path) -> None:
    """The written model reads it again; until then, the loaded one counts."""
    system = system_of(robot, tmp_path, "joint/elbow:armature")
    path, theta = tmp_path / "identified.xml", np.array([0.02])
    loaded = system.source.edited(None, b"before", lambda spec: None)

    # This edit changes no number.
    mesh = robot.parent / "meshes" / "block.obj"
    mesh.write_text(f"# edited\n{mesh.read_text()}")
    (remark,) = write_identified(path, system, theta)
    assert "block.obj changed while this ran" in remark

    path.unlink()
    mesh.write_text(tetrahedron(0.3))
    compiled = system.source.edited(None, b"after", lambda spec: None)
    assert compiled.body_mass.tolist() == loaded.body_mass.tolist()
    with pytest.raises(ModelError, match=r"block\.obj changed while this ran"):
        write_identified(path, system, theta)
    assert not path.exists()


@pytest.mark.parametrize("edited", ["robot.xml", "parts/arm.xml"])
def test_a_model_that_is_edited_meanwhile_is_written_as_it_was_loaded(
    edited: str, robot: Path, tmp_path: Path
) -> None:
    """Its parameters belong to the text that was loaded, also where it is resolved again."""
    system = system_of(robot, tmp_path, "joint/elbow:armature")
    whole, new = tmp_path / "whole" / "identified.xml", tmp_path / "out" / "identified.xml"
    assert write_identified(whole, system, np.array([0.02])) == []
    with (robot.parent / edited).open("a", encoding="utf-8") as file:
        file.write("<!-- edited -->")
    assert write_identified(new, system, np.array([0.02])) == []
    assert contents(new.parent) == contents(whole.parent)
