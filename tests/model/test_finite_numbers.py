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


def load(folder: Path, text: str = ARM, **changed: str) -> ModelSource:
    """Load the arm with some changed numbers."""
    path = folder / "arm.xml"
    path.write_text(text.format(**{**SOUND, **changed}), encoding="utf-8")
    return ModelSource(path)


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
    with pytest.raises(ModelError, match=r"arm\.xml: the model contains NaN"):
        load(tmp_path, **{key: value})


def test_included_files_are_searched(tmp_path: Path) -> None:
    part = '<mujoco><default><geom mass="nan"/></default></mujoco>'
    (tmp_path / "part.xml").write_text(part, encoding="utf-8")
    text = ARM.replace("<worldbody>", '<include file="part.xml"/>\n  <worldbody>')
    with pytest.raises(ModelError, match=r"arm\.xml: the model contains NaN"):
        load(tmp_path, text)


def test_names_and_infinite_ranges_are_no_faults(tmp_path: Path) -> None:
    """An element may be called "nan", a comment may say it, and a range may have no end."""
    text = ARM.replace('"pin"', '"nan"').replace("<worldbody>", "<worldbody> <!-- nan -->")
    assert load(tmp_path, text, range="-1 inf").model.njnt == 1


def test_unreadable_files_are_left_to_mujoco(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="MuJoCo cannot read the model"):
        load(tmp_path, '<mujoco><geom mass="nan"')
