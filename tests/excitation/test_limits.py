"""Limits from the MJCF and from the experiment file, and smallest margins of a trajectory."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.limits.limits import limits_of
from mjfim.experiment.system import labels_of_model
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import control_names
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.trajectory import Trajectory

# A ball joint first, so that addresses of positions, velocities and joints all differ.
XML = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body><joint name="ball" type="ball"/><geom size=".1"/>
      <body pos="0 0 1"><joint name="lift" type="slide" range="-0.5 0.25"/><geom size=".1"/>
        <body pos="0 0 1"><joint name="turn" type="hinge"/><geom size=".1"/></body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="push" joint="lift" ctrlrange="-2 3"/>
    <motor name="twist" joint="turn"/>
  </actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """Model with a ball joint, a slide joint with a range, a hinge joint and two actuators."""
    return mujoco.MjModel.from_xml_string(XML)


def limits(model: mujoco.MjModel, **tables: object) -> set[tuple[object, ...]]:
    """Kind, name, index, range and number of components of all limits."""
    found = limits_of(model, control_names(model), Limits(**tables), 0.01)
    return {(x.kind, x.name, x.index, x.lower, x.upper, x.count) for x in found}


# Elements without a range in the model are free. Columns skip the ball joint.
LIFT = ("position", "lift", 4, -0.5, 0.25, 1)
PUSH = ("control", "push", 0, -2.0, 3.0, 1)


@pytest.mark.parametrize(
    ("tables", "expected"),
    [
        ({}, {LIFT, PUSH}),
        (
            {
                "position": {"lift": (-0.1, 0.1), "turn": (-1, 2)},
                "velocity": {"lift": 2.0, "turn": (-1.0, 4.0)},
                "control": {"twist": (-5, 5), "push": (-9, 1)},
            },
            {
                ("position", "lift", 4, -0.1, 0.1, 1),
                ("position", "turn", 5, -1.0, 2.0, 1),
                ("velocity", "lift", 3, -2.0, 2.0, 1),
                ("velocity", "turn", 4, -1.0, 4.0, 1),
                ("control", "push", 0, -2.0, 1.0, 1),
                ("control", "twist", 1, -5.0, 5.0, 1),
            },
        ),
        (
            {"acceleration": 9.0, "control_rate": 7.0, "force": {"push": (-1.0, 2.0)}},
            {
                LIFT,
                PUSH,
                ("acceleration", "ball", 0, 0.0, 9.0, 3),
                ("acceleration", "lift", 3, -9.0, 9.0, 1),
                ("acceleration", "turn", 4, -9.0, 9.0, 1),
                ("control_rate", "push", 0, -7.0, 7.0, 1),
                ("control_rate", "twist", 1, -7.0, 7.0, 1),
                ("force", "push", 0, -1.0, 2.0, 1),
            },
        ),
    ],
    ids=["those of the model", "the file narrows and adds", "one number stands for all names"],
)
def test_ranges_of_the_model_and_of_the_file_hold(
    model: mujoco.MjModel, tables: dict[str, object], expected: set[tuple[object, ...]]
) -> None:
    assert limits(model, **tables) == expected


def test_ranges_of_forces_in_the_model_are_limits() -> None:
    text = XML.replace('type="hinge"', 'type="hinge" actuatorfrcrange="-6 7"')
    text = text.replace('joint="turn"/>', 'joint="turn" forcerange="-1 8"/>')
    assert limits(mujoco.MjModel.from_xml_string(text), force=5.0) == {
        LIFT,
        PUSH,
        ("force", "push", 0, -5.0, 5.0, 1),
        ("force", "twist", 1, -1.0, 5.0, 1),
        ("joint_force", "turn", 4, -6.0, 7.0, 1),
    }


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        (
            {"position": {"ball": (-1, 1)}},
            r"limits\.position\.ball: \[-1, 1\] should be one number.* a magnitude",
        ),
        (
            {"acceleration": {"turm": 1.0}},
            r"limits\.acceleration: unknown joint 'turm' \(did you mean 'turn'\?\)",
        ),
        (
            {"control": {"lift": (-1, 1)}},
            r"limits\.control: unknown actuator 'lift'; valid: push, twist",
        ),
        (
            {"position": {"lift": (1, -1)}},
            r"limits\.position\.lift: \[1, -1\] is inverted; needs lower < upper",
        ),
        ({"velocity": {"turn": (1.0, 1.0)}}, r"limits\.velocity\.turn: \[1, 1\]"),
        ({"control": {"push": (0.0, float("nan"))}}, r"limits\.control\.push: \[0, nan\]"),
        (
            {"position": {"lift": (0.3, 1.0)}},
            r"limits\.position\.lift: \[0\.3, 1\] and the MJCF's range \[-0\.5, 0\.25\] excl",
        ),
        (
            {"joint_force": {"ball": 1.0}},
            r"limits\.joint_force: 'ball' is a ball joint.*; valid: lift, turn",
        ),
        (
            {"control_rate": {"lift": 1.0}},
            r"limits\.control_rate: unknown actuator 'lift'; valid: push, twist",
        ),
        ({"force": {"turn": 1.0}}, r"limits\.force: unknown actuator 'turn'.*; valid: push, twist"),
    ],
)
def test_wrong_limits_are_refused(
    model: mujoco.MjModel, tables: dict[str, object], message: str
) -> None:
    """The message names the key, the fault and the valid alternatives."""
    with pytest.raises(ExperimentError, match=message):
        limits(model, **tables)


# An actuator with three controls and three forces before one with one of each.
SERVOED = """
<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body><joint name="ball" type="ball"/><geom size=".1"/>
      <body pos="0 0 1"><joint name="turn" type="hinge"/><geom size=".1"/></body>
    </body>
  </worldbody>
  <actuator>
    <orientation name="aim" joint="ball" kp="10" ctrlrange="-1 1" forcerange="0 2"/>
    <motor joint="turn" ctrlrange="-5 5" forcerange="-3 4"/>
  </actuator>
</mujoco>
"""


def test_every_control_of_an_actuator_has_its_range_and_label() -> None:
    """MuJoCo has one range per control; the range of several forces is that of their norm."""
    model = mujoco.MjModel.from_xml_string(SERVOED)
    labels = (*(f"aim[{i}] (control)" for i in range(3)), "actuator1 [N m]")
    assert labels_of_model(model).controls == labels
    assert limits(model) == {
        *(("control", f"aim[{i}]", i, -1.0, 1.0, 1) for i in range(3)),
        ("control", "actuator1", 3, -5.0, 5.0, 1),
        ("force", "aim", 0, 0.0, 2.0, 3),
        ("force", "actuator1", 3, -3.0, 4.0, 1),
    }


@pytest.mark.parametrize(
    ("ctrl", "names"),
    [
        ([0.1, 0.1, 0.1, 2.0], ()),
        (
            [0.15, 0.15, 0.0, -2.0],
            ("aim",),
        ),  # the norm of three forces is clamped, none of them alone is that large
        ([0.1, 0.1, 0.1, -3.5], ("actuator1",)),
        ([-0.5, 0.0, 0.0, 4.5], ("aim", "actuator1")),
    ],
)
def test_clamped_forces_are_found_beside_actuators_with_several(
    ctrl: list[float], names: tuple[str, ...]
) -> None:
    model = mujoco.MjModel.from_xml_string(SERVOED)
    still = Trajectory(
        t=np.arange(3) * 0.1,
        qpos=np.tile(model.qpos0, (3, 1)),
        qvel=np.zeros((3, 4)),
        act=np.zeros((3, 0)),
        ctrl=np.array([ctrl] * 2),
    )
    assert saturated_actuators(model, still) == names
