"""Models that would fill the memory are refused before MuJoCo compiles them."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.errors import ModelError
from mjfim.model.expanded_size import check_expanded_size
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
