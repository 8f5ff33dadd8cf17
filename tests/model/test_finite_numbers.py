"""Numbers of a model that are not finite are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.errors import ModelError
from mjfim.model.loading import ModelSource

ARM = """<mujoco>
  <option timestep="{timestep}"/>
  <worldbody>
    <body name="arm" pos="{position}">
      <joint name="pin" axis="0 1 0" damping="{damping}" limited="true" range="{range}"/>
      <geom size="0.1" mass="{mass}"/>
    </body>
  </worldbody>
  <actuator><motor name="drive" joint="pin" gear="{gear}"/></actuator>
</mujoco>
"""
SOUND = {
    "timestep": "0.01",
    "position": "0 0 0",
    "damping": "0.1",
    "range": "-1 1",
    "mass": "1",
    "gear": "1",
}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("mass", "nan"),
        ("mass", "-NaN(0)"),
        ("damping", "nan"),
        ("position", "0 nan 0"),
        ("range", "nan 1"),
        ("timestep", "nan"),
    ],
)
def test_numbers_that_are_no_numbers(key: str, value: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM.format(**{**SOUND, key: value}), encoding="utf-8")
    with pytest.raises(ModelError, match=r"arm\.xml: the model contains NaN"):
        ModelSource(path)
