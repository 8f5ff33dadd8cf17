"""Logs that touch a joint stop: the fit finds the right side of the jump, and names the stop."""

from __future__ import annotations

from pathlib import Path

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
  <actuator><motor name="act1" joint="j1"/><motor name="act2" joint="j2"/></actuator>
</mujoco>
"""

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


def fitted(
    folder: Path,
    model: str,
    true: dict[str, float],
    control: np.ndarray,
    sigma: float,
    start: np.ndarray | None = None,
) -> str:
    """What a good fit to a log at 500 Hz says about stops and contacts."""
    (folder / "model.xml").write_text(model, encoding="utf-8")
    parameters = {
        path: {"target": path, "guess": 4.0 * value / 3.0, "true": value, "bounds": [0.0, 9.0]}
        for path, value in true.items()
    }
    experiment = mjfim.Experiment(
        model=str(folder / "model.xml"),
        rate=500.0,
        parameters=parameters,
        noise={"state": sigma},
        fit={"bootstrap": 0},
    )
    log = mjfim.simulate(experiment, control, 1)
    found = mjfim.identify(experiment, [log], start=start)
    assert found.converged and not found.misfit
    low, high = found.interval.T
    values = list(true.values())
    assert ((low < values) & (values < high)).all()
    (said,) = [each for each in found.warnings if "stops or contacts act" in each]
    return said


@pytest.mark.slow
@pytest.mark.parametrize("start", [None, np.array([0.808, 0.297, 0.101])])
def test_a_fit_is_not_trapped_where_a_touch_comes_or_goes(
    tmp_path: Path, start: np.ndarray | None
) -> None:
    """The log touches a stop in 49 of 2000 samples; the cost jumps at a quarter of a deviation."""
    t = 0.002 * np.arange(2000)[:, None]
    frequencies = np.array([0.94362499, 1.33507242])
    control = np.array([1.28530862, 0.6053238]) * np.sin(2.0 * np.pi * frequencies * t)
    true = {"body/lower:mass": 0.8, "joint/j1:damping": 0.3, "joint/j2:damping": 0.1}
    said = fitted(tmp_path, ARM, true, control, 0.05058609263786144, start)
    assert "stops or contacts act: limit of j2" in said


@pytest.mark.slow
def test_a_contact_without_any_stop_is_found_and_named(tmp_path: Path) -> None:
    """An arm strikes an anvil and comes back; no joint has a range."""
    control = 0.35 * np.sin(2.0 * np.pi * 0.6 * 0.002 * np.arange(1500))[:, None]
    true = {"body/arm:mass": 1.5, "joint/pivot:damping": 0.3}
    said = fitted(tmp_path, HAMMER, true, control, 0.02)
    assert "contact " in said and "limit of" not in said
