"""Servos: their kind, the joint that they command, and the units of their controls."""

from __future__ import annotations

import mujoco
import pytest

from mjfim.model.paths import unit_of
from mjfim.model.units import commanded_joint, control_unit, servo_kind

MODEL = """
<mujoco>
  <worldbody>
    <body><joint name="h" axis="0 1 0"/><geom size="0.1"/>
      <body pos="0 0 1"><joint name="b" type="ball"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="h" coef="1"/></fixed></tendon>
  <actuator>{}</actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("actuator", "kind", "commands", "unit"),
    [
        ('<position joint="h" kp="3"/>', "position", True, "rad"),
        ('<position joint="h" kp="3" gear="2"/>', "position", True, ""),
        ('<position tendon="t" kp="3"/>', "position", False, ""),
        ('<velocity joint="h" kv="3"/>', "velocity", False, "rad/s"),
        ('<intvelocity joint="h" kp="3" actrange="-1 1"/>', "position", False, "rad/s"),
        ('<motor joint="h"/>', None, False, "N m"),
        ('<orientation joint="b" kp="3"/>', "position", False, ""),
    ],
)
def test_the_kind_of_a_servo_follows_from_its_gains(
    actuator: str, kind: str | None, commands: bool, unit: str
) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(actuator))
    assert servo_kind(model, 0) == kind
    assert commanded_joint(model, 0) == (0 if commands else None)
    assert control_unit(model, 0) == unit


@pytest.mark.parametrize(
    ("actuator", "field", "unit"),
    [
        ('<position joint="h" kp="3"/>', "kp", "N m/rad"),
        ('<position joint="h" kp="3" kv="1"/>', "kv", "N m s/rad"),
        ('<position joint="s" kp="3"/>', "kp", "N/m"),
        ('<velocity joint="s" kv="3"/>', "kv", "N s/m"),
        ('<position joint="h" kp="3" gear="2"/>', "kp", ""),
        ('<position tendon="t" kp="3"/>', "kp", ""),
        ('<orientation joint="b" kp="3"/>', "kp", ""),
    ],
)
def test_the_gain_of_a_servo_has_a_unit(actuator: str, field: str, unit: str) -> None:
    """It is that of a stiffness or of a damping at the joint."""
    slide = '<body><joint name="s" type="slide"/><geom size="0.1"/></body></worldbody>'
    text = MODEL.replace("</worldbody>", slide).format(actuator.replace(" ", ' name="a" ', 1))
    model = mujoco.MjModel.from_xml_string(text)
    assert unit_of(model, f"actuator/a:{field}") == unit
