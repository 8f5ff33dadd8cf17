"""Logs that touch a joint stop: the fit finds the right side of the jump, and names the stop."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim

ARM = """
<mujoco model="stop_arm">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0.15 0 0" mass="1.5" diaginertia="0.001 0.015 0.015"/>
      <joint name="j1" type="hinge" axis="0 0 1" range="-1.6 1.6" damping="0.3"/>
      <body name="lower" pos="0.3 0 0">
        <inertial pos="0.12 0 0" mass="0.8" diaginertia="0.0005 0.006 0.006"/>
        <joint name="j2" type="hinge" axis="0 0 1" range="-1.2 1.2" damping="0.1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="act1" joint="j1"/>
    <motor name="act2" joint="j2"/>
  </actuator>
</mujoco>
"""

EXPERIMENT = """
model = "arm.xml"
rate = 500.0

[parameters.payload]
target = "body/lower:mass"
guess = 1.1
true = 0.8
bounds = [0.1, 5.0]

[parameters.d1]
target = "joint/j1:damping"
guess = 0.45
true = 0.3
bounds = [0.0, 5.0]

[parameters.d2]
target = "joint/j2:damping"
guess = 0.15
true = 0.1
bounds = [0.0, 5.0]

[noise]
state = 0.05058609263786144
"""
TRUE = np.array([0.8, 0.3, 0.1])


@pytest.mark.slow
@pytest.mark.parametrize("start", [None, TRUE * [1.01, 0.99, 1.01]])
def test_a_fit_is_not_trapped_where_a_touch_comes_or_goes(
    tmp_path: Path, start: np.ndarray | None
) -> None:
    """The log touches a stop in 49 of 2000 samples; the cost jumps at a quarter of a deviation."""
    (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
    (tmp_path / "arm.toml").write_text(EXPERIMENT, encoding="utf-8")
    experiment = mjfim.Experiment.from_file(tmp_path / "arm.toml")
    t = 0.002 * np.arange(2000)[:, None]
    frequencies = np.array([0.94362499, 1.33507242])
    control = np.array([1.28530862, 0.6053238]) * np.sin(2.0 * np.pi * frequencies * t)
    log = mjfim.simulate(experiment, control, 1)
    found = mjfim.identify(experiment, [log], start=start, progress=False)
    assert found.converged and not found.misfit
    assert ((found.interval[:, 0] < TRUE) & (found.interval[:, 1] > TRUE)).all()
    assert any("stops or contacts act: limit of j2" in each for each in found.warnings)


HAMMER = """
<mujoco model="hammer">
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <geom name="anvil" type="box" pos="0.3 0.2 0" size="0.1 0.05 0.1"/>
    <body name="arm">
      <inertial pos="0.15 0 0" mass="1.5" diaginertia="0.001 0.015 0.015"/>
      <joint name="pivot" type="hinge" axis="0 0 1" damping="0.3"/>
      <geom name="head" type="sphere" pos="0.3 0 0" size="0.03" mass="0.001"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="pivot"/></actuator>
</mujoco>
"""


@pytest.mark.slow
def test_a_contact_without_any_stop_is_found_and_named(tmp_path: Path) -> None:
    """An arm strikes an anvil and comes back; no joint has a range."""
    (tmp_path / "hammer.xml").write_text(HAMMER, encoding="utf-8")
    parameters = {
        "mass": {"target": "body/arm:mass", "guess": 2.0, "true": 1.5, "bounds": [0.1, 9.0]},
        "damping": {
            "target": "joint/pivot:damping",
            "guess": 0.4,
            "true": 0.3,
            "bounds": [0.0, 5.0],
        },
    }
    experiment = mjfim.Experiment(
        model="hammer.xml",
        directory=tmp_path,
        rate=500.0,
        parameters=parameters,
        noise={"state": 0.02},
        fit={"bootstrap": 0},
    )
    t = 0.002 * np.arange(1500)[:, None]
    control = 0.35 * np.sin(2.0 * np.pi * 0.6 * t)
    log = mjfim.simulate(experiment, control, 1)

    # Plain MuJoCo says in how many samples the head touches the anvil.
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hammer.xml"))
    data, touched = mujoco.MjData(model), 0
    for u in control:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        touched += bool(data.ncon)
    assert 0 < touched < 300

    found = mjfim.identify(experiment, [log], progress=False)
    assert found.converged and not found.misfit
    true = np.array([1.5, 0.3])
    assert ((found.interval[:, 0] < true) & (found.interval[:, 1] > true)).all()
    (said,) = [each for each in found.warnings if "stops or contacts act" in each]
    assert "contact " in said and "limit of" not in said
