"""`mjfim.propose`: the choices of `mjfim init` for a model that Python gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from tests.support.cli import MODELS, run

URDF = """
<robot name="one">
  <link name="base"/>
  <link name="arm">
    <inertial>
      <origin xyz="0 0 -0.2"/><mass value="1.2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="20" velocity="3"/>
    <dynamics damping="0.1" friction="0"/>
  </joint>
</robot>
"""


@pytest.mark.slow
def test_python_and_the_command_line_propose_the_same(tmp_path: Path) -> None:
    """A spec, a path and `mjfim init` give equal experiments, which run as they are."""
    file = tmp_path / "cart.toml"
    assert run("init", MODELS / "cart_pendulum.xml", "-o", file).exit_code == 0
    stated = mjfim.Experiment.from_file(file).model_dump(exclude_unset=True)

    spec = mujoco.MjSpec.from_file(str(MODELS / "cart_pendulum.xml"))
    for model in (spec, str(MODELS / "cart_pendulum.xml")):
        found = mjfim.propose(model)
        assert found.model_dump(exclude_unset=True) == {**stated, "model": found.model}
        assert mjfim.check(found.replace(rehearsal={"robots": 4}), progress=False).verdict.ok


@pytest.mark.parametrize(
    ("unknown", "names"),
    [
        (
            ["joint/*:damping", "body/bob:mass"],
            ["joint/slide:damping", "joint/hinge:damping", "body/bob:mass"],
        ),
        ({"c": "joint/hinge:damping"}, ["c"]),
    ],
)
def test_stated_unknowns_are_all_proposed(unknown: Any, names: list[str]) -> None:
    """Also a damping that is zero in the model, which has a natural size and bounds."""
    experiment = mjfim.propose(MODELS / "cart_pendulum.xml", unknown, horizon=2.0)

    assert list(experiment.parameters) == names
    assert experiment.horizon == 2.0
    assert all(spec.bounds is not None for spec in experiment.parameters.values())
    assert np.isfinite(mjfim.evaluate(experiment).std).all()


@pytest.mark.slow
def test_a_payload_is_proposed_beside_stated_unknowns() -> None:
    experiment = mjfim.propose(
        MODELS / "two_joint_arm.xml", ["joint/elbow:damping"], payload="fore", horizon=2.0
    )

    moments = [f"payload_moment_{axis}" for axis in "xyz"]
    assert [*experiment.parameters] == ["payload", *moments, "joint/elbow:damping"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"unknown": ["joint/*:dampng"]}, "unknown parameter path 'joint/*:dampng'"),
        ({"unknown": ["joint/x:damping"]}, "unknown joint 'x'"),
        ({"unknown": []}, "parameters"),
        ({"payload": "hand"}, "payload: unknown body 'hand'"),
        ({"horizon": 0.0}, "horizon: 0.0 s; it must be positive and finite"),
        ({"model": "nothing.xml"}, "nothing.xml: no such model file"),
    ],
)
def test_a_wrong_wish_is_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(MjfimError) as caught:
        mjfim.propose(**{"model": MODELS / "cart_pendulum.xml", **arguments})

    assert message in str(caught.value)


def test_a_urdf_gets_its_motors_in_memory(tmp_path: Path) -> None:
    path = tmp_path / "one.urdf"
    path.write_text(URDF)

    experiment = mjfim.propose(path, ["joint/shoulder:damping"], horizon=1.0)

    assert System.resolve(experiment).controls == ("shoulder",)
    assert [file.name for file in tmp_path.iterdir()] == ["one.urdf"]
    assert np.isfinite(mjfim.evaluate(experiment).std).all()
