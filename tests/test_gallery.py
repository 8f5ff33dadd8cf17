"""The page of the gallery: text of one width, no absolute paths, and numbers of this version."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from scripts import gallery
from scripts.gallery import COLUMNS, PAGE_WIDTH, Robot, Shown, differences, write_page
from tests.support.cli import called_here
from tests.support.markdown import code_blocks


def made_call(folder: Path) -> Shown:
    """A call with pictures of several sizes."""
    pictures = {}
    for name, size in (
        ("histogram_a", (60, 40)),
        ("histogram_b", (60, 40)),
        ("fit_1", (60, 40)),
        ("fit_2", (60, 40)),
        ("check", (1100, 100)),
    ):
        pictures[name] = folder / f"{name}.png"
        Image.new("RGB", size, "white").save(pictures[name])
    long_words = " ".join(f"arm/log_{i}.csv" for i in range(12))
    return Shown(
        command=f"mjfim check arm.toml {long_words} -o arm/check",
        code=1,
        terminal=f"{'word ' * 40}\n  • {'point ' * 30}\n\nσ = 2.4×10⁻³ kg, 5.0 %, 1e-07, 95",
        pictures=pictures,
    )


def test_the_page_has_short_lines_and_small_pictures(tmp_path: Path) -> None:
    robot = Robot(title="Some arm", text="An arm.", source="arm.toml", steps=())
    page = tmp_path / "docs" / "gallery.md"
    page.parent.mkdir()
    write_page(page, [(robot, [made_call(tmp_path)])])
    text = page.read_text(encoding="utf-8")
    (block,) = [block for block in code_blocks(page) if block.language == "text"]
    assert max(map(len, block.text.splitlines())) <= COLUMNS
    assert str(tmp_path) not in text
    assert "### Some arm: check\n" in text
    assert "Exit code 1" in text

    # Pictures of a kind are shown once.
    found = re.findall(r"!\[(.+)\]\((.+)\)\{ width=\"(\d+)\"", text)
    kinds = [Path(target).stem.removeprefix("some-arm-check-") for _, target, _ in found]
    assert kinds == ["check", "fit", "histogram"]
    for _, target, width in found:
        with Image.open(page.parent / target) as picture:
            assert picture.width == int(width) <= PAGE_WIDTH


def test_numbers_that_differ_from_those_of_the_page_are_named(tmp_path: Path) -> None:
    """One percent or one unit of the last digit may come from another kernel."""
    robot, call = Robot(title="Arm", text="", source="", steps=()), made_call(tmp_path)
    page = tmp_path / "gallery.md"
    write_page(page, [(robot, [call])])
    text = page.read_text(encoding="utf-8")
    for old, new, is_stale in (
        ("5.0 %", "5.1 %", False),
        ("5.0 %", "5.2 %", True),
        ("1e-07", "2e-07", False),
        ("1e-07", "3e-07", True),
        ("2.4×10⁻³", "2.4×10⁻⁴", True),
        (", 95", ", 96", False),
        (", 95", "", True),
    ):
        now = replace(call, terminal=call.terminal.replace(old, new))
        assert bool(differences(text, now)) == is_stale, (old, new)
    assert differences("", call) == [f"{call.command}: is not on the page"]


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_the_numbers_of_the_page_are_those_of_this_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only what the verbs print is compared, so that no picture is drawn."""
    monkeypatch.setattr(gallery, "call_verb", called_here)
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setattr("sys.argv", ["gallery", "--check"])
    assert gallery.main() == 0, capsys.readouterr().err
