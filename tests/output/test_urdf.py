"""The user's URDF with identified values: its text is kept, and MuJoCo reads the robot from it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.experiment.system import System
from mjfim.model.given import same_dynamics
from mjfim.model.model_files import urdf_sources
from mjfim.output.export.mjcf import identified_files, write_identified
from mjfim.output.manifest import MANIFEST
from tests.output.test_mjcf import changes, compiled
from tests.support.cli import done, misused, names, run
from tests.support.numerics import Array

# Two links with inertial frames that are turned, and a tool that is fixed to the second one.
URDF = """<?xml version="1.0"?>
<!-- größer als ASCII; <mass value="9"/> stays a comment -->
<robot name='two'>
  <link name="base"/>
  <link name="upper">
    <inertial>
      <!-- from CAD -->
      <origin xyz="0.10 0.02 -0.150" rpy="0.3 -0.2 0.5"/>
      <mass   value="1.50"/>
      <inertia ixx="0.020" ixy="0.001" ixz="0" iyy="0.030"
               iyz="-0.0020" izz="0.0150"/>
    </inertial>
    <visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>
  </link>
  <link name='lower'>
    <inertial>
      <mass value="0.7"/>
      <origin xyz='0 0 -0.1' rpy='0 0.7 0'/>
      <inertia ixx="0.004" ixy="0" ixz="0" iyy="0.005" iyz="0" izz="0.0020"/>
    </inertial>
  </link>
  <link name="tool">
    <inertial>
      <origin xyz="0 0.01 0.03" rpy="1.0 0 0"/>
      <mass value="0.2"/>
      <inertia ixx="0.0004" ixy="0" ixz="0" iyy="0.0005" iyz="0" izz="0.00020"/>
    </inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/> <child link="upper"/>
    <origin xyz="0 0 1.0" rpy="0.1 0.2 0"/>
    <axis xyz="0 1 0"/>
    <dynamics damping="0.10" friction="0.050"/>
    <limit lower="-3" upper="3" effort="20" velocity="5"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/> <child link="lower"/>
    <origin xyz="0 0 -0.3"/>
    <axis xyz="1 0 0"/>
  </joint>
  <joint name="flange" type="fixed">
    <parent link="lower"/> <child link="tool"/>
    <origin xyz="0 0 -0.2" rpy="0 0 0.4"/>
  </joint>
</robot>
"""

# An MJCF that attaches the URDF, as `mjfim init` writes it.
MOTORS = """<mujoco model="driven">
  <!-- motors for the URDF -->
  <asset><model name="robot" file="two.urdf"/></asset>
  <worldbody><attach model="robot" prefix="{prefix}"/></worldbody>
  <actuator>
    <motor name="m" joint="{prefix}shoulder" gear="2.0"/>
    <motor name="n" joint="{prefix}elbow"/>
  </actuator>
</mujoco>
"""


def parameters(prefix: str = "") -> dict[str, dict[str, Any]]:
    """Parameters of the robot, whose names have a prefix."""
    return {
        "lower": {"inertial": f"{prefix}lower"},
        "upper_mass": {"target": f"body/{prefix}upper:mass"},
        "upper_com": {"target": f"body/{prefix}upper:ipos[1]"},
        "upper_Iyy": {"target": f"body/{prefix}upper:fullinertia[1]"},
        "shoulder_damping": {"target": f"joint/{prefix}shoulder:damping"},
        "elbow_damping": {"target": f"joint/{prefix}elbow:damping", "scale": 0.1},
        "elbow_friction": {"target": f"joint/{prefix}elbow:frictionloss", "scale": 0.1},
    }


def system_of(
    folder: Path, model: str = "two.urdf", prefix: str = "", **further: dict[str, Any]
) -> System:
    (folder / "two.urdf").write_text(URDF, encoding="utf-8")
    (folder / "driven.xml").write_text(MOTORS.format(prefix=prefix), encoding="utf-8")
    return resolved(folder, model, {**parameters(prefix), **further})


def resolved(folder: Path, model: str, parameters: dict[str, dict[str, Any]]) -> System:
    tables: dict[str, Any] = {"rate": 100.0, "noise": {"state": 0.01}, "parameters": parameters}
    return System.resolve(mjfim.Experiment(model=model, directory=folder, **tables))


def other_values(system: System) -> Array:
    """Values beside the guess."""
    theta = np.array(system.parameters.guess)
    rng = np.random.default_rng(0)
    theta += 0.1 * rng.uniform(-1.0, 1.0, len(theta)) * system.parameters.magnitude
    return np.maximum(theta, system.parameters.lower)


def motion(model: Any) -> Array:
    """(n, 2 nv) motion of a model from rest, with its friction, and mass matrix and bias forces."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.3
    found = []
    for _ in range(200):
        mujoco.mj_step(model, data)
        found.append(np.concatenate([data.qpos, data.qvel, data.qfrc_bias]))
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    return np.concatenate([np.array(found).ravel(), matrix.ravel()])


def written(folder: Path, system: System, theta: Array) -> list[str]:
    """Write the identified model and return the remarks without that about the printed MJCF."""
    remarks = write_identified(folder / "identified.xml", system, theta)
    return [remark for remark in remarks if "printed by MuJoCo" not in remark]


def test_mujoco_reads_the_identified_robot(tmp_path: Path) -> None:
    system = system_of(tmp_path)
    theta = other_values(system)
    assert written(tmp_path / "out", system, theta) == []
    wanted = system.model_at(theta)
    for name in ("identified.urdf", "identified.xml"):
        found = compiled(tmp_path / "out" / name)
        assert_allclose(motion(found), motion(wanted), rtol=1e-5, atol=1e-5)
    found = compiled(tmp_path / "out" / "identified.urdf")
    assert same_dynamics(found, wanted)
    assert_allclose(motion(found), motion(wanted), rtol=1e-9, atol=1e-11)

    # The test can fail: the stated robot moves otherwise.
    assert np.abs(motion(system.model) - motion(wanted)).max() > 1e-3


def test_only_the_numbers_change(tmp_path: Path) -> None:
    """One number changes, then those of a link with which another one is merged."""
    system = system_of(tmp_path)
    theta = np.array(system.parameters.guess)
    names = list(system.parameters.names)
    theta[names.index("upper_mass")] = 1.75
    theta[names.index("upper_com")] = 0.03
    theta[names.index("elbow_friction")] = 0.04
    written(tmp_path / "out", system, theta)
    new = tmp_path / "out" / "identified.urdf"
    lost, gained = changes(tmp_path / "two.urdf", new)
    assert gained == [
        '<origin xyz="0.10 0.03 -0.150" rpy="0.3 -0.2 0.5"/>',
        '<mass value="1.75"/>',
        '<dynamics friction="0.04"/>',
    ]
    assert len(lost) == 2
    assert '<!-- größer als ASCII; <mass value="9"/> stays a comment -->' in new.read_text("utf-8")

    # The tool keeps its inertia; the link takes the whole change.
    theta[names.index("lower.alpha")] += 0.1
    written(tmp_path / "out", system, theta)
    masses = [float(mass) for mass in re.findall(r'<mass value="([^"]*)"', new.read_text("utf-8"))]
    total = system.model_at(theta).body("lower").mass[0]
    assert masses[2:] == [pytest.approx(total - 0.2, rel=1e-12), 0.2]


@pytest.mark.parametrize("prefix", ["", "left_"])
def test_an_mjcf_attaches_the_identified_urdf(tmp_path: Path, prefix: str) -> None:
    """In the MJCF, the gain of a motor changes; the links are not merged there."""
    further = {
        "tool": {"target": f"body/{prefix}tool:mass"},
        "gear": {"target": "actuator/m:gear[0]"},
    }
    system = system_of(tmp_path, "driven.xml", prefix, **further)
    theta = other_values(system)
    out = tmp_path / "out"
    assert write_identified(out / "identified.xml", system, theta) == [
        "identified.urdf: a URDF cannot hold gear; identified.xml has all values",
    ]
    text = (out / "identified.xml").read_text(encoding="utf-8")
    assert '<model name="robot" file="identified.urdf"/>' in text
    assert "<!-- motors for the URDF -->" in text
    assert f'gear="{float(theta[-1])!r}"' in text

    wanted = system.model_at(theta)
    assert same_dynamics(compiled(out / "identified.xml"), wanted)

    # The URDF alone moves as the robot with its motors at rest.
    alone = compiled(out / "identified.urdf")
    assert_allclose(motion(alone), motion(wanted), rtol=1e-8, atol=1e-10)


def test_a_urdf_that_is_attached_twice_is_not_written(tmp_path: Path) -> None:
    """The MJCF, which MuJoCo prints, holds the values of the first one."""
    system_of(tmp_path)
    twice = MOTORS.format(prefix="a_").replace(
        '<attach model="robot" prefix="a_"/>',
        '<attach model="robot" prefix="a_"/><body name="b" pos="1 0 0">'
        '<attach model="robot" prefix="b_"/></body>',
    )
    (tmp_path / "driven.xml").write_text(twice, encoding="utf-8")
    both = resolved(tmp_path, "driven.xml", {"m": {"target": "body/a_upper:mass"}})
    assert list(urdf_sources(both.model_path).values()) == [("a_", "b_")]
    (remark,) = written(tmp_path / "out", both, np.array([1.6]))
    assert "is attached 2 times, and one URDF has one set of values" in remark
    assert names(tmp_path / "out") == {"identified.xml"}
    found = compiled(tmp_path / "out" / "identified.xml")
    assert [found.body(f"{side}_upper").mass[0] for side in "ab"] == [1.6, 1.5]


def test_fixed_links_that_are_heavier_than_the_whole(tmp_path: Path) -> None:
    """The identified mass of lower and tool is less than that of the tool alone."""
    system = system_of(tmp_path)
    theta = np.array(system.parameters.guess)
    theta[0] = 0.5 * np.log(0.1)
    (remark,) = written(tmp_path / "out", system, theta)
    assert remark.startswith(
        "identified.urdf: not written: the links that are fixed to link 'lower'"
    )
    assert not list((tmp_path / "out").glob("*.urdf"))


def test_links_whose_inertia_comes_from_their_geometry(tmp_path: Path) -> None:
    """The link gets an inertial, and a missing origin is added."""
    visual = '<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual>'
    begin, end = URDF.index("<inertial>"), URDF.index("</inertial>") + len("</inertial>")
    text = URDF[:begin] + URDF[end:].replace(visual, visual.replace("visual>", "collision>"))
    text = text.replace("<origin xyz='0 0 -0.1' rpy='0 0.7 0'/>", "")
    (tmp_path / "two.urdf").write_text(text, encoding="utf-8")
    lower = {"target": "body/lower:ipos[2]", "scale": 0.1}
    system = resolved(
        tmp_path, "two.urdf", {"upper": {"target": "body/upper:mass"}, "lower": lower}
    )
    theta = np.array([5.0, -0.05])
    assert written(tmp_path / "out", system, theta) == []
    file = tmp_path / "out" / "identified.urdf"
    assert same_dynamics(compiled(file), system.model_at(theta))
    changed = file.read_text(encoding="utf-8")
    assert '<origin xyz="0 0 -0.0' in changed
    assert '<mass value="5"/>' in changed


@pytest.mark.parametrize(
    ("extension", "name", "said"),
    [
        ("", "arm.obj", '<mesh filename="../../arm.obj"/>'),
        ('<mujoco><compiler meshdir="."/></mujoco>', "arm.obj", '<compiler meshdir="../.."/>'),
        (
            '<mujoco><compiler strippath="true"/></mujoco>',
            "package://some/arm.obj",
            '<compiler strippath="true" assetdir="../.."/>',
        ),
    ],
)
def test_meshes_are_found_from_another_folder(
    tmp_path: Path, extension: str, name: str, said: str
) -> None:
    tetrahedron = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "arm.obj").write_text(tetrahedron, encoding="utf-8")
    mesh = f'<collision><geometry><mesh filename="{name}"/></geometry></collision>\n  </link>\n'
    text = URDF.replace("</visual>\n  </link>\n", f"</visual>\n    {mesh}")
    text = text.replace("<robot name='two'>", f"<robot name='two'>\n  {extension}")
    (tmp_path / "two.urdf").write_text(text, encoding="utf-8")
    system = resolved(tmp_path, "two.urdf", {"mass": {"target": "body/upper:mass"}})
    out = tmp_path / "far" / "away"
    assert written(out, system, np.array([2.0])) == []
    assert said in (out / "identified.urdf").read_text(encoding="utf-8")
    assert compiled(out / "identified.urdf").nmesh == 1


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ("", ("identified.urdf",)),
        ('<attach model="other" prefix="b_"/>', ("identified_two.urdf", "identified_other.urdf")),
    ],
)
def test_names_of_files(others: str, expected: tuple[str, ...], tmp_path: Path) -> None:
    system_of(tmp_path, "driven.xml")
    (tmp_path / "other.urdf").write_text(URDF, encoding="utf-8")
    text = MOTORS.format(prefix="a_").replace("</worldbody>", f"{others}</worldbody>")
    text = text.replace("</asset>", '<model name="other" file="other.urdf"/></asset>')
    (tmp_path / "driven.xml").write_text(text, encoding="utf-8")
    assert identified_files(tmp_path / "identified.xml", tmp_path / "driven.xml") == expected


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_identify_writes_both(tmp_path: Path) -> None:
    """The command line claims and writes the URDF, and removes it where it is not made again."""
    system_of(tmp_path, "driven.xml")
    experiment = """
model = "driven.xml"
rate = 100.0
horizon = 1.0
noise = { state = 0.01 }
initial = { control = { kind = "sine", amplitude = 1.0, frequency = 0.7 } }
[parameters.mass]
target = "body/upper:mass"
guess = 1.4
true = 1.6
"""
    (tmp_path / "two.toml").write_text(experiment, encoding="utf-8")
    out = tmp_path / "fit"
    done("simulate", tmp_path / "two.toml", "-o", tmp_path / "log.csv")
    words = ("identify", tmp_path / "two.toml", tmp_path / "log.csv", "-o", out)
    result = done(*words)
    assert {"identified.xml", "identified.urdf", MANIFEST} <= names(out)
    assert "printed by MuJoCo" not in result.stderr
    estimate = mjfim.Estimate.load(out)
    model = compiled(out / "identified.xml")
    assert model.body("upper").mass[0] == estimate.theta[0]

    (out / "identified.urdf").write_text("edited", encoding="utf-8")
    misused(run(*words), "identified.urdf: changed after mjfim wrote it")
