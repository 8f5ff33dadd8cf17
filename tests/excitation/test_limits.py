"""Limits from the MJCF and from the experiment file, and smallest margins of a trajectory."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.limits.constraint_kinds import ConstraintValues
from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.limits.limits import Limit, limits_of
from mjfim.experiment.system import labels_of_model
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import control_names
from mjfim.plant.active_constraints import saturated_actuators
from mjfim.records.trajectory import Trajectory
from tests.support.numerics import make_task

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


def limits(model: mujoco.MjModel, **tables: object) -> tuple[Limit, ...]:
    """Limits of the model and of tables of an experiment file."""
    return limits_of(model, control_names(model), Limits(**tables), 0.01)


def curve(model: mujoco.MjModel, **columns: tuple[int, list[float]]) -> Trajectory:
    """Trajectory of three samples at rest, except for the named columns."""
    arrays = {
        "qpos": np.zeros((3, model.nq)),
        "qvel": np.zeros((3, model.nv)),
        "ctrl": np.zeros((2, model.nu)),
    }
    for name, (index, values) in columns.items():
        arrays[name][:, index] = values
    return Trajectory(
        t=np.arange(3) * 0.1,
        qpos=arrays["qpos"],
        qvel=arrays["qvel"],
        act=np.zeros((3, 0)),
        ctrl=arrays["ctrl"],
    )


def test_model_ranges_are_the_default(model: mujoco.MjModel) -> None:
    """Elements without a range in the model are free. Columns skip the ball joint."""
    assert limits(model) == (
        Limit(kind="position", name="lift", index=4, lower=-0.5, upper=0.25),
        Limit(kind="control", name="push", index=0, lower=-2.0, upper=3.0),
    )


def test_the_file_narrows_ranges_and_adds_others(model: mujoco.MjModel) -> None:
    """One number is a symmetric range. The range of the MJCF holds as well."""
    found = limits(
        model,
        position={"lift": (-0.1, 0.1), "turn": (-1, 2)},
        velocity={"lift": 2.0, "turn": (-1.0, 4.0)},
        control={"twist": (-5, 5), "push": (-9, 1)},
    )
    assert set(found) == {
        Limit(kind="position", name="lift", index=4, lower=-0.1, upper=0.1),
        Limit(kind="position", name="turn", index=5, lower=-1.0, upper=2.0),
        Limit(kind="velocity", name="lift", index=3, lower=-2.0, upper=2.0),
        Limit(kind="velocity", name="turn", index=4, lower=-1.0, upper=4.0),
        Limit(kind="control", name="push", index=0, lower=-2.0, upper=1.0),
        Limit(kind="control", name="twist", index=1, lower=-5.0, upper=5.0),
    }


def test_one_number_stands_for_all_names(model: mujoco.MjModel) -> None:
    """It holds for all joints, controls and actuators."""
    found = limits(model, velocity=2.0, acceleration=9.0, control_rate=7.0, force=1.5)
    joints, places = (("lift", 3), ("turn", 4)), (("push", 0), ("twist", 1))
    assert set(found) - set(limits(model)) == {
        Limit(kind="velocity", name="ball", index=0, lower=0.0, upper=2.0, count=3),
        Limit(kind="acceleration", name="ball", index=0, lower=0.0, upper=9.0, count=3),
        *(
            Limit(kind=kind, name=name, index=v, lower=-b, upper=b)
            for kind, b in (("velocity", 2.0), ("acceleration", 9.0))
            for name, v in joints
        ),
        *(
            Limit(kind=kind, name=name, index=u, lower=-b, upper=b)
            for kind, b in (("control_rate", 7.0), ("force", 1.5))
            for name, u in places
        ),
    }
    assert limits(model, force={"push": (-1.0, 2.0)})[-1] == Limit(
        kind="force", name="push", index=0, lower=-1.0, upper=2.0
    )


def test_every_range_of_the_model_is_a_limit() -> None:
    """Positions, controls, actuator forces and actuator forces on joints have their addresses."""
    text = XML.replace(
        'name="turn" type="hinge"', 'name="turn" type="hinge" actuatorfrcrange="-6 7"'
    )
    text = text.replace('joint="turn"/>', 'joint="turn" forcerange="-1 8"/>')
    found = limits(mujoco.MjModel.from_xml_string(text), force=5.0)
    assert {x for x in found if "force" in x.kind} == {
        Limit(kind="force", name="push", index=0, lower=-5.0, upper=5.0),
        Limit(kind="force", name="twist", index=1, lower=-1.0, upper=5.0),
        Limit(kind="joint_force", name="turn", index=4, lower=-6.0, upper=7.0),
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


def margins(text: str, folder: Path, trajectory: Trajectory, **tables: object) -> dict[str, float]:
    """Smallest margins of a trajectory with one engine step per sample, for an experiment on a
    model.
    """
    task = make_task(
        text,
        folder,
        parameters={"damping": {"target": "joint/turn:damping", "scale": 1.0}},
        noise={"qpos:turn": 0.01},
        control={"kind": "constant", "amplitude": 0.0},
        limits=tables,
    )
    constraints = constraint_set_of(task)
    assert not len(constraints.observations.actuator_forces)
    shown = constraints.observations.values(
        trajectory.qpos[1:], trajectory.qvel[1:], trajectory.qvel[:-1], dict[str, np.ndarray]().get
    )
    return constraints.margins(ConstraintValues(trajectory=trajectory, observed=shown[:, None]))


def test_without_limits_there_are_no_margins(model: mujoco.MjModel, tmp_path: Path) -> None:
    """No limit is stated."""
    free = XML.replace('range="-0.5 0.25"', "").replace('ctrlrange="-2 3"', "")
    assert margins(free, tmp_path, curve(model)) == {}


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({}, {"position": 0.25, "control": 2.0}),
        ({"qpos": (4, [0.0, 0.2, 0.1])}, {"position": 0.05, "control": 2.0}),
        ({"qpos": (4, [0.0, 0.3, 0.0])}, {"position": -0.05, "control": 2.0}),
        ({"qpos": (4, [0.0, 0.0, -0.75])}, {"position": -0.25, "control": 2.0}),
        ({"qpos": (5, [9.0, 9.0, 9.0])}, {"position": 0.25, "control": 2.0}),
        ({"ctrl": (0, [-2.0, 2.5])}, {"position": 0.25, "control": 0.0}),
        ({"ctrl": (0, [0.0, 3.5])}, {"position": 0.25, "control": -0.5}),
    ],
)
def test_margins(
    model: mujoco.MjModel,
    columns: dict[str, tuple[int, list[float]]],
    expected: dict[str, float],
    tmp_path: Path,
) -> None:
    """Smallest margin over samples and both bounds, negative outside; zero on the bound."""
    assert margins(XML, tmp_path, curve(model, **columns)) == pytest.approx(expected)


def test_the_margin_of_a_kind_is_the_smallest_of_its_joints(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    """The tighter of two joints counts, in any order."""
    for tight, loose in (("lift", "turn"), ("turn", "lift")):
        moving = curve(model, qvel=({"lift": 3, "turn": 4}[tight], [0.0, 1.5, 0.0]))
        found = margins(XML, tmp_path, moving, velocity={tight: 1.0, loose: 10.0})
        assert found["velocity"] == pytest.approx(-0.5)


def test_accelerations_and_rates_of_the_control_are_changes_over_their_time(
    model: mujoco.MjModel, tmp_path
) -> None:
    """Velocities change over an engine step of 2 ms, controls over a sample of 10 ms."""
    moving = curve(model, qvel=(4, [0.0, 0.01, -0.02]), ctrl=(1, [0.5, 0.2]))
    found = margins(
        XML,
        tmp_path,
        moving,
        acceleration={"turn": 10.0},
        control_rate={"twist": 40.0, "push": 1.0},
    )
    assert found["acceleration"] == pytest.approx(10.0 - 0.03 / 0.002)
    assert found["control_rate"] == pytest.approx(1.0)  # the other one stands still
    quick = margins(XML, tmp_path, moving, control_rate={"twist": 20.0})
    assert quick["control_rate"] == pytest.approx(20.0 - 30.0)


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
    found = limits(model)
    labels = (*(f"aim[{i}] (control)" for i in range(3)), "actuator1 [N m]")
    assert labels_of_model(model).controls == labels
    aims = [
        Limit(kind="control", name=f"aim[{i}]", index=i, lower=-1.0, upper=1.0) for i in range(3)
    ]
    assert found == (
        *aims,
        Limit(kind="control", name="actuator1", index=3, lower=-5.0, upper=5.0),
        Limit(kind="force", name="aim", index=0, lower=0.0, upper=2.0, count=3),
        Limit(kind="force", name="actuator1", index=3, lower=-3.0, upper=4.0),
    )


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
