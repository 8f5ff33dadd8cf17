"""The control that holds a state."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjfim.excitation.limits.verification import require_feasible_start
from mjfim.experiment.controls import holding_control, least_drift_control
from tests.support.numerics import make_task
from tests.support.stiff_servos import START, stiff_arm_task

# A servo that holds the arm is this far from the angle, because the arm is heavy [rad].
LARGEST_SAG = 1.5e-3


@pytest.mark.parametrize("rate", [10.0, 50.0, 250.0])
def test_a_stiff_servo_is_found_that_holds_a_state_far_from_the_guess(
    rate: float, tmp_path: Path
) -> None:
    """The force of the servos is clamped at the guess, where it does not depend on the control."""
    task = stiff_arm_task(tmp_path, rate=rate, boundary={"start": "rest"})
    start = task.plant.initial_state(task.theta)
    hold = least_drift_control(task.system, start, np.zeros(2))
    assert np.abs(hold - START).max() < LARGEST_SAG
    assert np.array_equal(task.initial_hold, hold)

    # The arm does not move under it, on the model with its clamps.
    played = task.plant.simulate(task.theta, np.tile(hold, (task.samples, 1)))
    assert np.abs(played.qpos - START).max() < 1e-6

    found = holding_control(
        task.system, start, np.array([3.0, 3.0]), key="boundary.start", place="the start"
    )
    assert np.allclose(found, hold, atol=1e-9)


BOX = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 1" solref="0.005 1"/>
    <body name="box" pos="0 0 0.1">
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <geom type="box" size="0.1 0.1 0.1" mass="10" solref="0.005 1" friction="0.01"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" ctrlrange="-5 5"/></actuator>
</mujoco>
"""


def test_a_contact_that_a_longer_timestep_softens_holds_the_start_all_the_same(
    tmp_path: Path,
) -> None:
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 2000)
    task = make_task(
        BOX,
        tmp_path,
        rate=50.0,
        horizon=1.0,
        initial={"qpos": data.qpos.tolist(), "control": {"kind": "constant", "amplitude": 1.0}},
        parameters={"mass": "body/box:mass"},
        noise={"state": 0.01},
        boundary={"start": "rest", "velocity": 1e-3},
    )
    assert task.initial_hold == pytest.approx([0.0], abs=1e-6)
    assert task.stretched(10).initial_hold == pytest.approx([0.0], abs=1e-6)


def test_a_hold_at_the_end_of_a_range_is_inside_it_up_to_rounding(tmp_path: Path) -> None:
    """Springs hold two equal arms, so that their controls are zero up to rounding."""
    arm = (
        '<body name="{0}" pos="0 {1} 0"><joint name="{0}" axis="0 1 0" stiffness="3" '
        'springref="{2}" damping="0.1"/><geom size="0.1" mass="1" pos="0 0 -0.3"/></body>'
    )
    angle = 0.7
    spring = np.rad2deg(angle + 9.81 * 0.3 * np.sin(angle) / 3.0)
    xml = (
        f"<mujoco><worldbody>{arm.format('a', 0, spring)}{arm.format('b', 1, spring)}</worldbody>"
        '<actuator><motor name="a" joint="a" ctrlrange="0 5"/>'
        '<motor name="b" joint="b" ctrlrange="-5 0"/></actuator></mujoco>'
    )
    task = make_task(
        xml,
        tmp_path,
        rate=50.0,
        horizon=1.0,
        initial={"qpos": [angle, angle], "control": {"kind": "constant", "amplitude": 0.0}},
        parameters={"mass": "body/a:mass"},
        noise={"state": 0.01},
        boundary={"start": "rest"},
    )
    assert np.abs(task.initial_hold).max() < 1e-6
    assert task.initial_hold[0] < 0.0 or task.initial_hold[1] > 0.0
    require_feasible_start(task)
