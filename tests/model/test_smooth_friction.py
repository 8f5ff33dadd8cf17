"""Softened dry friction against its law, on single joints and tendons, and its derivative by the
frictionloss.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.model.variants import smooth_dry_friction, smoothing_speeds_of

SLIDER = """
<mujoco>
  <option timestep="0.001" gravity="0 0 0"/>
  <worldbody>
    <body name="a"><joint name="a" type="slide" axis="1 0 0" frictionloss="{loss}"/>
      <geom type="sphere" size="0.05" mass="0.4" contype="0" conaffinity="0"/></body>
    <body name="b" pos="0 1 0"><joint name="b" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.05" mass="2" contype="0" conaffinity="0"/></body>
  </worldbody>
  <tendon><fixed name="rope" frictionloss="{rope}"><joint joint="b" coef="1"/></fixed></tendon>
</mujoco>
"""


def model_of(loss: float, rope: float = 0.0) -> Any:
    return mujoco.MjModel.from_xml_string(SLIDER.format(loss=loss, rope=rope))


def friction(model: Any, speed: float, push: float = 0.0) -> list[float]:
    """Forces of friction on both sliders at a speed."""
    data = mujoco.MjData(model)
    data.qvel[:], data.qfrc_applied[:] = speed, push
    mujoco.mj_forward(model, data)
    return [float(f) for f in data.qfrc_constraint]


@pytest.mark.parametrize("push", [0.0, 3.0])
def test_smoothed_friction_is_viscous_up_to_its_speed_and_constant_beyond(push: float) -> None:
    model = model_of(0.5, 0.8)
    smooth_dry_friction(model, (0.05, 0.0, 0.1))
    for speed in (-1.0, -0.2, -0.05, -0.03, 0.0, 0.01, 0.049, 0.07, 3.0):
        found = friction(model, speed, push)
        wanted = [-0.5 * np.clip(speed / 0.05, -1.0, 1.0), -0.8 * np.clip(speed / 0.1, -1.0, 1.0)]
        assert_allclose(found, wanted, atol=0.02 if push else 0.002)


def test_joints_without_friction_or_speed_are_not_changed() -> None:
    model, plain = model_of(0.5), model_of(0.5)
    smooth_dry_friction(model, (0.0, 0.05, 0.05))
    assert_array_equal(model.dof_solref, plain.dof_solref)
    assert_array_equal(model.tendon_solref_fri, plain.tendon_solref_fri)
    assert friction(model, 0.3) == friction(plain, 0.3)


def test_smoothing_speeds_are_a_fraction_of_the_fastest_and_above_sticking() -> None:
    model = model_of(0.5, 0.8)
    speeds = smoothing_speeds_of(model, np.array([10.0, 0.0]))
    assert speeds[0] == pytest.approx(0.2)
    assert speeds[1] == 0.0
    slow = smoothing_speeds_of(model, np.zeros(2))
    damping = 2.0 / (0.95 * 0.02)  # of the default solref and solimp
    assert slow[0] == pytest.approx(0.5 / 0.4 / damping, rel=1e-3)
    assert slow[2] == pytest.approx(0.8 / 2.0 / damping, rel=1e-3)
    model.dof_solref[0] = [-100.0, -50.0]  # given as stiffness and damping
    assert smoothing_speeds_of(model, np.zeros(2))[0] == pytest.approx(
        0.5 / 0.4 / (50.0 / 0.95), rel=1e-3
    )
