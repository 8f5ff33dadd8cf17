"""A small robot that its model describes completely is told no misfit and no missing term."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import mjfim
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from tests.support.cart_pendulum import logs_of
from tests.support.numerics import require_found

# A rotary pendulum for a table top: friction of 1e-3 N m, inertias of 1e-4 kg m².
FURUTA = """
<mujoco model="furuta">
  <option timestep="0.005" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm" pos="0 0 0.1">
      <inertial pos="0.04 0 0" mass="0.1" diaginertia="2e-5 1e-4 1e-4"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="2e-4" frictionloss="1e-3"/>
      <body name="pole" pos="0.085 0 0">
        <inertial pos="0 0 -0.065" mass="0.025" diaginertia="3.5e-5 3.5e-5 1e-6"/>
        <joint name="swing" type="hinge" axis="1 0 0" damping="1e-5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="yaw"/></actuator>
</mujoco>
"""

STATED: dict[str, Any] = {
    "model": "furuta.xml",
    "rate": 100.0,
    "horizon": 3.0,
    "initial": {
        "control": {"kind": "multisine", "amplitude": 0.02, "frequency": 0.7, "harmonics": 6}
    },
    "parameters": {
        "mass": {"target": "body/pole:mass", "guess": 0.03, "true": 0.025},
        "length": {"target": "body/pole:ipos[2]", "guess": -0.06, "true": -0.065},
        "damping": {"target": "joint/yaw:damping", "guess": 3e-4, "true": 2e-4},
        "friction": {"target": "joint/yaw:frictionloss", "guess": 8e-4, "true": 1e-3},
    },
    "noise": {"qpos:yaw": 2e-3, "qpos:swing": 2e-3, "qvel:yaw": 0.02, "qvel:swing": 0.02},
    "fit": {"bootstrap": 0},
}


@pytest.mark.slow
def test_a_table_top_furuta_has_no_misfit_with_any_seed(tmp_path: Path) -> None:
    (tmp_path / "furuta.xml").write_text(FURUTA, encoding="utf-8")
    furuta = Experiment(**STATED, directory=tmp_path, source="furuta")
    true = System.resolve(furuta).parameters.true
    for log in logs_of(furuta, 0, 1, 2):
        found = mjfim.identify(furuta, [log])
        assert found.missing_terms == ()
        assert 0.8 < found.chi2 / found.dof < 1.2
        require_found(found, true)
