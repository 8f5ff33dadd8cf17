"""The list of the files of a model: everything that MuJoCo reads, wherever it looks for it."""

from __future__ import annotations

from pathlib import Path

from mjfim.model.model_files import files_of_model
from tests.support.mesh_model import FILES, write_mesh_model


def test_includes_meshes_images_and_attached_models_are_listed(tmp_path: Path) -> None:
    model = write_mesh_model(tmp_path)

    found = {file.relative_to(tmp_path).as_posix() for file in files_of_model(model)}

    assert found == set(FILES)


def test_the_model_itself_is_the_first_file(tmp_path: Path) -> None:
    model = write_mesh_model(tmp_path)

    assert files_of_model(model)[0] == model


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
