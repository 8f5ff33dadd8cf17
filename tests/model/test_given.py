"""Models as Python gives them: each kind is the model of the file, and nothing of it changes."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import ExperimentError, ModelError
from mjfim.model.given import differences, packed, same_dynamics
from mjfim.model.loading import packed_model
from tests.support.mesh_model import MESH, write_mesh_model
from tests.support.paths import ROOT

ARM = ROOT / "models" / "two_joint_arm.xml"

# A model whose numbers have more digits than MuJoCo writes by default.
TEXT = """
<mujoco model="odd numbers">
  <option timestep="0.0012345678901"/>
  <worldbody>
    <body name="arm" euler="10 20 30">
      <joint name="turn" damping="0.123456789012345"/>
      <geom size="0.1" mass="1.00000000012"/>
    </body>
  </worldbody>
</mujoco>
"""

# Two models whose meshes have the same name in folders of the same name.
PART = """
<mujoco model="{name}">
  <compiler meshdir="shapes"/>
  <asset><mesh name="part" file="part.obj" scale="{scale} 1 1"/></asset>
  <worldbody>
    <body name="{name}">
      <joint name="{name}"/>
      <geom type="mesh" mesh="part"/>
      <frame name="end" pos="1 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""


def model_of(given: Any, folder: Path = Path()) -> Any:
    """The compiled model of what is given, from the files that hold it."""
    name, files = packed(given, folder)
    return packed_model(files, folder / name).model


def test_all_kinds_give_the_model_of_the_file() -> None:
    wanted = mujoco.MjModel.from_xml_path(str(ARM))
    spec = mujoco.MjSpec.from_file(str(ARM))
    assert packed(str(ARM), Path()) == packed(ARM, Path()) == (str(ARM), None)

    for given in (spec, ARM.read_text(), mujoco.MjModel.from_xml_path(str(ARM))):
        assert same_dynamics(model_of(given), wanted)


def test_no_digit_of_a_number_is_lost() -> None:
    spec = mujoco.MjSpec.from_string(TEXT)
    found, wanted = model_of(spec), spec.compile()

    assert found.opt.timestep == 0.0012345678901
    assert found.dof_damping[0] == 0.123456789012345
    assert_allclose(found.body_quat, wanted.body_quat, rtol=0.0, atol=1e-15)
    # Other programs print as before.
    assert 'damping="0.123457"' in spec.to_xml()


def test_a_compiled_model_gives_back_what_was_changed_in_it() -> None:
    model = mujoco.MjModel.from_xml_string(TEXT)
    model.dof_damping[0] = 0.7

    assert model_of(model).dof_damping[0] == 0.7


def test_a_compiled_model_whose_spec_is_gone_is_refused() -> None:
    model = mujoco.MjModel.from_xml_string(TEXT)
    other = mujoco.MjModel.from_xml_string(TEXT.replace('"turn"', '"other"'))

    for gone in (model, mujoco.MjSpec.from_string(TEXT).compile()):
        assert gone.njnt == other.njnt
        with pytest.raises(ModelError, match="give the MjSpec, or the path of the file"):
            packed(gone, Path())


def test_files_of_a_spec_are_found_and_the_spec_stays(tmp_path: Path) -> None:
    """Meshes, a height field and an attached model in another folder."""
    path = write_mesh_model(tmp_path)
    spec = mujoco.MjSpec.from_file(str(path))
    wanted = spec.copy().compile()
    before = spec.copy().to_xml()

    found = model_of(spec, tmp_path / "elsewhere")

    assert spec.to_xml() == before
    assert found.nhfielddata == wanted.nhfielddata
    assert differences(found, wanted, 1e-5) == []


def test_bytes_of_meshes_in_python_are_taken() -> None:
    text = PART.format(name="arm", scale=1)
    spec = mujoco.MjSpec.from_string(text, assets={"part.obj": MESH.encode()})

    assert same_dynamics(model_of(spec), spec.copy().compile())


def test_a_mesh_is_not_taken_for_another_one_of_its_name(tmp_path: Path) -> None:
    """An attached spec does not know its folder any more, but its compiled mesh is there."""
    for i, name in enumerate(("arm", "hand")):
        file = tmp_path / name / "shapes" / "part.obj"
        file.parent.mkdir(parents=True)
        file.write_text(MESH.replace("0.5", f"0.{5 + 2 * i}"))
        (tmp_path / name / "robot.xml").write_text(PART.format(name=name, scale=1 + i))
    spec = mujoco.MjSpec.from_file(str(tmp_path / "arm" / "robot.xml"))
    hand = mujoco.MjSpec.from_file(str(tmp_path / "hand" / "robot.xml"))
    spec.attach(hand, prefix="hand_", frame=spec.frame("end"))

    found, wanted = model_of(spec), spec.copy().compile()

    assert wanted.body_mass[2] > 2.0 * wanted.body_mass[1]
    assert_allclose(found.body_mass, wanted.body_mass, rtol=1e-5)


def test_a_name_of_robot_descriptions_is_its_model_file(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ModelError, match=r"pip install 'mjfim\[robots\]'"):
        packed("so_arm100_mj_description", Path())

    module = ModuleType("robot_descriptions.so_arm100_mj_description")
    module.MJCF_PATH = str(ARM)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "robot_descriptions", ModuleType("robot_descriptions"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    assert packed("so_arm100_mj_description", Path()) == (str(ARM), None)

    for name in ("so_arm_description", f"{'a' * 300}_description"):
        with pytest.raises(ModelError, match=f"'{name}' is neither a file nor a name"):
            packed(name, Path())


@pytest.mark.parametrize("given", [3, None, b"<mujoco/>", mujoco.MjData, ["arm.xml"]])
def test_another_kind_is_refused(given: Any) -> None:
    with pytest.raises(ExperimentError, match=r"needs the path of an MJCF .*, a mujoco\.MjSpec"):
        packed(given, Path())


@pytest.mark.parametrize("text", ["<mujoco", "<mujoco><bodies/></mujoco>"])
def test_a_text_that_is_no_model_is_refused(text: str) -> None:
    with pytest.raises(ModelError, match="MuJoCo cannot read the text"):
        packed(text, Path())


def test_an_absent_texture_is_named(tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_string(TEXT)
    spec.modelfiledir = str(tmp_path)
    spec.add_hfield(name="ground", file="ground.png", size=[1, 1, 0.1, 0.1])

    with pytest.raises(ModelError, match=r"ground\.png"):
        packed(spec, Path())
