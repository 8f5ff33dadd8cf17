"""What an experiment file can name in a model."""

from __future__ import annotations

import cProfile
import pstats
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.records.inventory import KINDS
from mjfim.studies.inventory import list_model
from tests.support.cli import MODELS

# A model with what the examples lack: elements without a name, and a range that no design keeps.
ODD = """
<mujoco>
  <worldbody>
    <body name="link">
      <joint name="ball" type="ball" range="0 1" limited="true"/>
      <geom size="0.1" mass="1"/>
    </body>
    <body><joint type="slide"/><geom size="0.1" mass="1"/></body>
  </worldbody>
  <actuator>
    <general name="muscle" joint="ball" gear="0 0 1" dyntype="filter" dynprm="0.1"
             actlimited="true" actrange="0 1"/>
  </actuator>
</mujoco>
"""


def test_every_listed_path_can_be_a_target_and_has_the_value_of_the_model() -> None:
    inventory = list_model(MODELS / "servo_arm.xml")
    values = {path: (value, unit) for path, value, unit in inventory.parameters}
    assert values["joint/yaw:damping"][1] == "N m s/rad"
    model = mujoco.MjModel.from_xml_path(str(MODELS / "servo_arm.xml"))
    assert values["actuator/shoulder:kp"][0] == model.actuator("shoulder").gainprm[0]
    assert not any(path.startswith("body/world") for path in values)

    # A sample of all paths, because each experiment takes a moment.
    for path, value, unit in inventory.parameters[::40]:
        spec = {"target": path, "guess": value if value is not None else 1.0}
        experiment = Experiment(
            model="servo_arm.xml",
            rate=100.0,
            parameters={"p": {**spec, "scale": 1.0}},
            noise={"state": 0.1},
            directory=MODELS,
        )
        parameter = System.resolve(experiment).parameters.parameters[0]
        assert parameter.unit == unit


def test_outputs_actuators_keyframes_and_limits_are_listed() -> None:
    inventory = list_model(MODELS / "quadrotor.xml")
    assert {name for name, _, _ in inventory.actuators} == {"fl", "fr", "rl", "rr"}
    assert [each.name for each in inventory.keyframes] == ["hover"]
    assert {(each.kind, each.lower, each.upper) for each in inventory.limits} == {
        ("control", 0.0, 1.0)
    }
    gyro = next(each for each in inventory.outputs if each.name == "imu_gyro[0]")
    assert (gyro.source, gyro.unit) == ("gyro", "rad/s")


def test_elements_without_a_name_and_ranges_that_are_not_kept_are_said(tmp_path: Path) -> None:
    path = tmp_path / "odd.xml"
    path.write_text(ODD, encoding="utf-8")
    inventory = list_model(path)
    remarks = " ".join(inventory.remarks)
    for words in ("1 of kind body have no name", "1 of kind joint", "the activation of muscle"):
        assert words in remarks

    # The range of a ball joint is its largest angle.
    turned = next(limit for limit in inventory.limits if limit.name == "ball")
    assert (turned.kind, turned.lower, turned.unit) == ("position", 0.0, "rad")
    assert turned.upper == pytest.approx(np.deg2rad(1.0))


def test_selections_keep_what_is_wanted() -> None:
    inventory = list_model(MODELS / "cart_pendulum.xml")
    selected = inventory.selected(lambda name: "damping" in name)
    paths = [path for path, _, _ in selected.parameters]
    assert sorted(paths) == ["joint/hinge:damping", "joint/slide:damping"]
    assert selected.count == 2
    for kind in KINDS:
        only = inventory.only(kind)
        assert only.count == len(getattr(inventory, kind))


def test_the_work_of_a_list_is_proportional_to_the_tendons(tmp_path: Path) -> None:
    """A model of 5000 tendons with motors took 120 s."""
    calls = []
    for count in (100, 200):
        tendon, motor = (
            '<fixed name="t{0}"><joint joint="arm" coef="1"/></fixed>',
            '<motor tendon="t{0}"/>',
        )
        tendons, motors = ("".join(map(text.format, range(count))) for text in (tendon, motor))
        path = tmp_path / f"{count}.xml"
        path.write_text(
            '<mujoco><worldbody><body><joint name="arm"/><geom size="0.1"/></body></worldbody>'
            f"<tendon>{tendons}</tendon><actuator>{motors}</actuator></mujoco>"
        )
        profile = cProfile.Profile()
        listed = profile.runcall(list_model, path)
        assert len(listed.actuators) == count
        calls.append(pstats.Stats(profile).total_calls)
    assert calls[1] < 2.2 * calls[0]
