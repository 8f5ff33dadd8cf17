"""A model is compiled once more only where a parameter needs another compiled model."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjfim.model.loading import ModelSource

# A free box is "simple" for MuJoCo; the arm beside it is not.
BOX_AND_ARM = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 1">
      <freejoint/>
      <geom type="box" size="0.1 0.1 0.1" mass="1"/>
    </body>
    <body name="arm">
      <joint name="hinge" axis="0 1 0"/>
      <geom type="box" size="0.1 0.1 0.3" pos="0.1 0 0.3" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""


def model_bytes(model: mujoco.MjModel) -> bytes:
    """The whole model as MuJoCo saves it."""
    found = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, found)
    return found.tobytes()


@pytest.fixture
def source(tmp_path: Path) -> ModelSource:
    path = tmp_path / "model.xml"
    path.write_text(BOX_AND_ARM)
    return ModelSource(path)


@pytest.mark.parametrize("moved", [frozenset[str](), frozenset({"arm"})])
def test_the_users_model_serves_where_no_moved_body_is_simple(
    source: ModelSource, moved: frozenset[str]
) -> None:
    assert source.compiled(moved) is source.model

    # Another compile gives the same model.
    again = source.edited(moved, b"", lambda spec: None)
    assert model_bytes(again) == model_bytes(source.model)


@pytest.mark.parametrize("moved", [frozenset({"box"}), frozenset({"box", "arm"}), None])
def test_a_simple_body_that_moves_needs_another_model(
    source: ModelSource, moved: frozenset[str] | None
) -> None:
    found = source.compiled(moved)
    assert source.model.body("box").simple[0] != 0
    assert found.body("box").simple[0] == 0
    assert source.compiled(moved) is found
