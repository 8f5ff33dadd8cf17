"""Models that would fill the memory are refused before MuJoCo compiles them."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.errors import ModelError
from mjfim.model.expanded_size import ModelSize, check_expanded_size
from mjfim.model.loading import load_spec
from tests.support.paths import MODELS

REPLICATE = '<replicate count="1000000"><replicate count="1000000"><body/></replicate></replicate>'

BOMBS = {
    "replicate": (f"<worldbody>{REPLICATE}</worldbody>", r"2e\+12 elements.*at most 2e\+05"),
    "composite": (
        '<worldbody><body><composite type="grid" count="1000 1000 1"/></body></worldbody>',
        r"1e\+06 elements",
    ),
    "flexcomp": (
        '<worldbody><flexcomp name="f" type="grid" count="999 999 999"/></worldbody>',
        "elements",
    ),
    "height field": (
        '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/></asset>',
        r"1e\+10 values of height fields",
    ),
    "texture": (
        '<asset><texture name="t" builtin="flat" width="90000" height="90000"/></asset>',
        "values of height fields and textures",
    ),
    "arena": ('<size memory="900T"/>', "bytes of arena"),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_are_refused(name: str, tmp_path: Path) -> None:
    """The message names the file, the size and the bound."""
    text, message = BOMBS[name]
    path = tmp_path / "bomb.xml"
    path.write_text(f"<mujoco>{text}</mujoco>", encoding="utf-8")
    with pytest.raises(ModelError, match=rf"bomb\.xml: the model expands to .*{message}"):
        load_spec(path)


def test_replicated_includes_are_multiplied(tmp_path: Path) -> None:
    """A file that is included inside a replication counts as often as it is replicated."""
    geoms = '<geom size="1"/>' * 300
    part = f"<mujocoinclude>{geoms}</mujocoinclude>"
    (tmp_path / "part.xml").write_text(part, encoding="utf-8")
    body = '<replicate count="1000"><include file="part.xml"/></replicate>'
    path = tmp_path / "main.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>", encoding="utf-8")
    with pytest.raises(ModelError, match=r"main\.xml: the model expands to 3.*e\+05 elements"):
        check_expanded_size(path)


def test_files_that_are_not_xml_are_left_to_mujoco(tmp_path: Path) -> None:
    """The message is MuJoCo's."""
    path = tmp_path / "text.xml"
    path.write_text("no model", encoding="utf-8")
    check_expanded_size(path)
    with pytest.raises(ModelError, match="MuJoCo cannot read"):
        load_spec(path)


@pytest.mark.parametrize("path", sorted(MODELS.glob("*.xml")), ids=lambda path: path.stem)
def test_models_of_the_repository_are_small(path: Path) -> None:
    """No model of the repository comes close to a bound."""
    check_expanded_size(path)


def _write_model(folder: Path, name: str, asset: str, body: str) -> Path:
    """Write a model with some assets and one body."""
    path = folder / f"{name}.xml"
    path.write_text(
        f'<mujoco model="{name}"><asset>{asset}</asset>'
        f'<worldbody><body name="b"><geom size="1"/>{body}</body></worldbody></mujoco>',
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize("named", [True, False])
def test_attached_models_are_multiplied(named: bool, tmp_path: Path) -> None:
    """Six models, each of which attaches the previous one ten times, make a million bodies."""
    path = _write_model(tmp_path, "m0", "", "")
    for i in range(6):
        name = f'name="m{i}"' if named else ""
        asset = f'<model {name} file="m{i}.xml"/>'
        attach = "".join(f'<attach model="m{i}" body="b" prefix="{k}"/>' for k in range(10))
        path = _write_model(tmp_path, f"m{i + 1}", asset, attach)
    with pytest.raises(ModelError, match=r"m6\.xml: the model expands to .*e\+06 elements"):
        load_spec(path)


def test_a_model_that_attaches_itself_is_refused(tmp_path: Path) -> None:
    """MuJoCo would read it for ever, which ends the process."""
    path = _write_model(tmp_path, "self", '<model name="s" file="self.xml"/>', "")
    with pytest.raises(ModelError, match=r"self\.xml: the model .*self\.xml names itself"):
        load_spec(path)


@pytest.mark.parametrize(
    "element", ['texture name="t" type="2d"', 'hfield name="h" size="1 1 1 1"']
)
def test_packed_images_are_refused_by_their_pixels(element: str, tmp_path: Path) -> None:
    """The first bytes of a PNG file state how large it is unpacked."""
    folder = tmp_path / "assets"
    folder.mkdir()
    header = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + (100_000).to_bytes(4, "big") * 2
    (folder / "bomb.png").write_bytes(header)
    path = _write_model(tmp_path, "image", f'<{element} file="bomb.png"/>', "")
    text = path.read_text(encoding="utf-8")
    compiler = '</asset><compiler assetdir="assets"/>'
    path.write_text(text.replace("</asset>", compiler), encoding="utf-8")
    with pytest.raises(ModelError, match=r"1e\+10 pixels of images.*at most 2\.5e\+08"):
        load_spec(path)


def test_mesh_files_are_refused_by_their_size(tmp_path: Path) -> None:
    """The message states the size and the bound."""
    (tmp_path / "big.obj").write_bytes(b"v 0 0 0\n" * 1000)
    path = _write_model(tmp_path, "mesh", '<mesh name="m" file="big.obj"/>', "")
    check_expanded_size(path)
    with pytest.raises(ModelError, match=r"8e\+03 bytes of mesh files.*at most 5e\+03"):
        check_expanded_size(path, ModelSize(elements=9, mesh_bytes=5e3))
