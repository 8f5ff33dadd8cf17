"""The list of the files of a model: everything that MuJoCo reads, wherever it looks for it."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest

from mjfim.errors import ModelError, ModelWarning
from mjfim.model.loading import load_spec, packed_model
from mjfim.model.model_files import PackedFiles, files_of_model
from tests.support.mesh_model import FILES, write_mesh_model


def test_includes_meshes_images_and_attached_models_are_listed(tmp_path: Path) -> None:
    model = write_mesh_model(tmp_path)

    files = files_of_model(model)

    assert files[0] == model
    assert {file.relative_to(tmp_path).as_posix() for file in files} == set(FILES)


def test_a_mesh_of_a_urdf_is_found_without_its_package(tmp_path: Path) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(
        '<robot name="arm"><link name="base"><visual><geometry>'
        '<mesh filename="package://arm/meshes/link.stl"/></geometry></visual></link></robot>'
    )
    mesh = tmp_path / "link.stl"
    mesh.write_bytes(b"mesh")

    assert files_of_model(urdf) == (urdf, mesh)


def test_what_is_no_xml_is_left_to_mujoco(tmp_path: Path) -> None:
    model = tmp_path / "broken.xml"
    model.write_text("<mujoco><include")

    assert files_of_model(model) == (model,)


TREES = {
    "model.xml": "",
    "inner.xml": '<include file="inner.xml"/>',
    "deep/part.xml": '<include file="deep/between.xml"/>',
    "arm.stl": '<asset><mesh name="m" file="arm.stl"/></asset>',
    "meshes/arm.stl": '<compiler meshdir="meshes"/><asset><mesh name="m" file="arm.stl"/></asset>',
    "sky.png": '<asset><texture name="m" type="2d" file="sky.png"/></asset>',
    "other.xml": '<asset><model name="m" file="other.xml"/></asset>',
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
@pytest.mark.parametrize("place", TREES)
def test_a_pipe_in_the_tree_of_a_model_is_refused(place: str, tmp_path: Path) -> None:
    """MuJoCo would wait for its end; what is wrong is said before."""
    for folder in ("deep", "meshes"):
        (tmp_path / folder).mkdir()
    (tmp_path / "deep/between.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    (tmp_path / "model.xml").write_text(f"<mujoco>{TREES[place]}</mujoco>", encoding="utf-8")
    (tmp_path / place).unlink(missing_ok=True)
    os.mkfifo(tmp_path / place)
    with pytest.raises(ModelError, match=rf"{re.escape(place)}: a pipe or a device"):
        load_spec(tmp_path / "model.xml")


@pytest.mark.parametrize("other", ["model.xml", "other.xml"])
def test_a_model_that_attaches_itself_is_refused(other: str, tmp_path: Path) -> None:
    """MuJoCo would follow the circle until its stack overflows."""
    text = '<mujoco><asset><model name="m" file="{}"/></asset></mujoco>'
    (tmp_path / "other.xml").write_text(text.format("model.xml"), encoding="utf-8")
    (tmp_path / "model.xml").write_text(text.format(other), encoding="utf-8")
    with pytest.raises(ModelError, match=r"model.xml: a model attaches itself \("):
        load_spec(tmp_path / "model.xml")


# A link whose mesh is a file of a ROS package.
PACKAGED = """
<robot name="one">
  <link name="base"/>
  <link name="arm">
    <inertial><origin xyz="0 0 -0.2"/><mass value="1.2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://robot/meshes/arm.obj"/></geometry></collision>
  </link>
  <joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="9" velocity="3"/></joint>
</robot>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("place", ["above", "environment", "stated", "packed", "absent"])
def test_meshes_of_ros_packages_are_found_or_left_out(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / ("robot" if place in ("above", "packed") else "elsewhere/robot")
    (package / "meshes").mkdir(parents=True)
    (package / "meshes" / "arm.obj").write_text(TETRAHEDRON, encoding="utf-8")
    path = tmp_path / "robot" / "urdf" / "arm.urdf"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(PACKAGED, encoding="utf-8")

    if place == "environment":
        monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path / "elsewhere"))
    if place == "packed":
        files = PackedFiles.read(files_of_model(path), PackedFiles.of({}))
        shutil.rmtree(package)
        assert packed_model(files, path).model.ngeom == 1
    elif place == "absent":
        with pytest.warns(ModelWarning, match="meshes of the package 'robot' are not found"):
            assert load_spec(path).compile().ngeom == 0
    else:
        packages = {"robot": str(package)} if place == "stated" else {}
        assert load_spec(path, packages=packages).compile().ngeom == 1
