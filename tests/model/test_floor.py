"""The floor under a robot: that of the model, or the one that it most likely has."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from mjfim.model.floor import find_floor

PLANE = '<geom type="plane" size="1 1 1" pos="0 0 {}"/>'
LINK = """
<body name="link" pos="0 0 {}"><joint axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 {} 0 {}" size="0.01"/>
</body>
"""
# A link that points up, one that hangs down, and one that hangs sideways.
UP, DOWN, SIDEWAYS = (LINK.format("{}", *each) for each in ((0.1, 0.3), (0, -0.3), (0.3, 0)))
BASE = '<body name="base" pos="0 0 {}"><geom type="box" size="0.1 0.1 0.05"/>{}</body>'
FRAME = '<body name="base" pos="0 0 {}">{}</body>'
FREE = '<body name="drone" pos="0 0 {}"><freejoint/><geom type="sphere" size="0.1"/></body>'
WEIGHTLESS = '<option gravity="0 0 0"/>'


@pytest.mark.parametrize(
    ("option", "bodies", "height", "is_stated"),
    [
        pytest.param("", PLANE.format(-0.2) + UP.format(0.1), -0.2, True, id="plane"),
        pytest.param("", BASE.format(0.7, UP.format(0.05)), 0.65, False, id="arm on a base"),
        pytest.param("", FRAME.format(0.7, UP.format(0.05)), 0.7, False, id="base without geoms"),
        pytest.param("", BASE.format(0.7, DOWN.format(0.0)), 0.0, False, id="hanging"),
        pytest.param("", BASE.format(0.2, DOWN.format(0.0)), -np.inf, False, id="hanging below 0"),
        pytest.param("", SIDEWAYS.format(0.5), 0.0, False, id="no base, above 0"),
        pytest.param("", SIDEWAYS.format(0.0), -np.inf, False, id="no base, at 0"),
        pytest.param("", FREE.format(1.0), 0.0, False, id="flying"),
        pytest.param("", FREE.format(-1.0), -1.1, False, id="flying below 0"),
        pytest.param(WEIGHTLESS, FREE.format(1.0), -np.inf, False, id="weightless"),
    ],
)
def test_the_floor_under_a_robot(option: str, bodies: str, height: float, is_stated: bool) -> None:
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{option}<worldbody>{bodies}</worldbody></mujoco>"
    )
    found, stated, _ = find_floor(model, model.qpos0)
    assert found == pytest.approx(height, abs=1e-12)
    assert stated is is_stated
    # A height that is known holds.
    assert find_floor(model, model.qpos0, 0.3)[0] == 0.3
