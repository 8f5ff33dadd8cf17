"""What MuJoCo warns of when it reads a model is told once, as a sentence, if it means anything."""

from __future__ import annotations

import multiprocessing
import warnings
from pathlib import Path
from typing import Any

import pytest

from mjfim.errors import ModelWarning
from mjfim.model.loading import ModelSource

# MuJoCo says of both attributes that a later version will not have them.
DEPRECATED = """
<mujoco model="old">
  <compiler settotalmass="2"/>
  <statistic meaninertia="1"/>
  <worldbody>
    <body name="arm"><joint name="hinge"/><geom size="0.1" mass="1" pos="0.1 0 0"/></body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LINK = '<link name="{}"><inertial><mass value="1"/>' + INERTIA + "</inertial></link>"

# MuJoCo ignores the limits of this joint.
EQUAL_LIMITS = (
    '<robot name="odd">'
    + "".join(LINK.format(name) for name in ("base", "arm"))
    + '<joint name="hinge" type="revolute"><parent link="base"/><child link="arm"/>'
    + '<axis xyz="0 1 0"/><limit lower="0" upper="0" effort="1" velocity="1"/></joint></robot>'
)

SENTENCE = "joint 'hinge' has equal lower and upper limits, limit ignored"


def file(folder: Path, name: str, text: str) -> Path:
    """A model file."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def told(path: Path) -> list[Any]:
    """Warnings of loading a model."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        ModelSource(path)
    return found


def test_what_is_deprecated_but_holds_is_not_told(tmp_path: Path, capfd: Any) -> None:
    path = file(tmp_path, "old.xml", DEPRECATED)
    assert told(path) == []
    assert ModelSource(path).model.body_mass[1] == pytest.approx(2.0)
    assert capfd.readouterr() == ("", "")


def test_what_mujoco_ignores_is_told_once_for_each_file(tmp_path: Path, capfd: Any) -> None:
    for name in ("one.urdf", "two.urdf"):
        path = file(tmp_path, name, EQUAL_LIMITS)
        (warning,) = told(path)
        assert warning.category is ModelWarning
        assert str(warning.message) == f"{path}: MuJoCo warns: {SENTENCE}"
        assert told(path) == []
    assert capfd.readouterr() == ("", "")


def test_worker_processes_do_not_repeat_warnings(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: "the process that warned")
    assert told(file(tmp_path, "robot.urdf", EQUAL_LIMITS)) == []
