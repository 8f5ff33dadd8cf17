"""The page of the gallery: text of one width, no absolute paths, pictures with their texts."""

from __future__ import annotations

import json
import re
from pathlib import Path

import tomlkit
from PIL import Image

from scripts.gallery import (
    COLUMNS,
    PAGE_WIDTH,
    SHOWN_HEIGHT,
    Robot,
    Shown,
    keep_calls,
    kept_calls,
    simulated_robot,
    write_page,
)
from tests.support.markdown import code_blocks


def made_calls(folder: Path) -> list[Shown]:
    """Make the calls of a robot, with pictures of several sizes."""
    pictures = {}
    for name, size in (
        ("check", (1100, 100)),
        ("histogram_a", (60, 40)),
        ("histogram_b", (60, 40)),
        ("report-desktop-light", (320, 1500)),
        ("report-desktop-dark", (320, 200)),
    ):
        pictures[name] = folder / "check" / f"{name}.png"
        pictures[name].parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, "white").save(pictures[name])
    long_words = " ".join(f"arm/log_{i}.csv" for i in range(12))
    return [
        Shown(
            command=f"mjfim check arm.toml {long_words} -o arm/check",
            code=1,
            seconds=1.0,
            terminal=f"{'word ' * 40}\n  • {'point ' * 30}\n\nlast",
            pictures=pictures,
        )
    ]


def test_the_page_has_short_lines_links_and_small_pictures(tmp_path: Path) -> None:
    robot = Robot(name="arm", title="Some arm", text="An arm.", steps=())
    calls = made_calls(tmp_path / "arm")
    keep_calls(calls, tmp_path / "arm")
    assert kept_calls(tmp_path / "arm") == calls

    page = tmp_path / "docs" / "gallery.md"
    page.parent.mkdir()
    write_page(page, [(robot, calls)])
    text = page.read_text(encoding="utf-8")
    blocks = [block for block in code_blocks(page) if block.language == "text"]
    assert len(blocks) == 1
    assert max(map(len, blocks[0].text.splitlines())) <= COLUMNS
    assert str(tmp_path) not in text
    assert "(#some-arm-check)" in text
    assert "Exit code 1" in text

    # Pictures of a kind are shown once; screenshots in other colours are for looking at.
    found = re.findall(r"!\[(.+)\]\((.+)\)\{ width=\"(\d+)\"", text)
    names = [Path(target).name for _, target, _ in found]
    assert names == [
        "arm-check-check.png",
        "arm-check-histogram_a.png",
        "arm-check-report-desktop-light.png",
    ]
    for _, target, width in found:
        with Image.open(page.parent / target) as picture:
            assert picture.width == int(width) <= PAGE_WIDTH
            assert picture.height <= SHOWN_HEIGHT * picture.width + 1


def test_the_simulated_robot_differs_where_nothing_is_known(tmp_path: Path) -> None:
    experiment = tmp_path / "models" / "arm.toml"
    experiment.parent.mkdir()
    experiment.write_text(
        'model = "arm.xml"\n[parameters]\na = { target = "x" }\nb = { target = "y" }\n'
        'c = { target = "z", prior = 0.1 }\n[parameters.d]\ntarget = "w"\ntrue = 3.0\n',
        encoding="utf-8",
    )
    folder = tmp_path / "out" / "arm"
    (folder / "check").mkdir(parents=True)
    rows = [{"name": name, "value": -1.0, "size": 2.0} for name in "abcd"]
    (folder / "check" / "check.json").write_text(json.dumps({"parameters": rows}))

    robot = tomlkit.parse(simulated_robot(experiment, folder).read_text("utf-8")).unwrap()
    values = {name: table.get("true") for name, table in robot["parameters"].items()}
    assert values == {"a": -0.8, "b": -1.2, "c": None, "d": 3.0}
    assert (folder / robot["model"]).resolve() == experiment.parent.resolve() / "arm.xml"
