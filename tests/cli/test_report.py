"""`mjfim report`: the report of a folder, made again from its files."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from mjfim.output.page import REPORT
from mjfim.output.plots import draw
from mjfim.output.plots.pictures import picture_names
from mjfim.parallel.budget import NOTHING_SENTENCE
from tests.support import results
from tests.support.cli import done, misused, run


@pytest.fixture
def saved(here: Path) -> Path:
    """The current folder, with a design."""
    results.design().save(here)
    return here


def test_report_writes_the_report_of_a_folder(saved: Path) -> None:
    """A report of the user is replaced with --force only."""
    done("report .")
    first = (saved / REPORT).read_bytes()

    (saved / REPORT).write_text("mine", encoding="utf-8")
    misused(run("report ."), f"{REPORT}: changed after mjfim wrote it", "--force")
    done("report . --force")
    assert (saved / REPORT).read_bytes() == first


@pytest.mark.usefixtures("empty_figures")
def test_report_draws_pictures_that_are_missing_or_older_than_their_result(saved: Path) -> None:
    """Only on request, and only those of which there is no file in any format.

    Ctrl-C during a second run leaves the pictures of the first one, in whatever format.
    """
    done("report .")
    assert not [*saved.glob("*.png"), *saved.glob("*.svg")]
    (saved / "convergence.svg").write_text("<svg/>", encoding="utf-8")
    said = done("report . --pictures --format svg").stderr
    drawn = sorted(saved.glob("*.svg"))
    assert {path.stem for path in drawn} == set(picture_names(results.design()))
    others = [path.stem for path in drawn if path.stem != "convergence"]
    assert [name for name in others if f"wrote {name}.svg" not in said] == []
    assert "convergence" not in said

    written = (saved / "design.npz").stat().st_mtime_ns
    os.utime(drawn[0], ns=(0, written - 1))
    os.utime(drawn[1], ns=(0, written))
    done("report . --pictures")
    assert [path.stem for path in saved.glob("*.png")] == [drawn[0].stem]
    assert sorted(saved.glob("*.svg")) == drawn[1:]


@pytest.mark.parametrize("presses", [1, 2])
@pytest.mark.usefixtures("empty_figures")
def test_a_press_while_pictures_are_drawn_keeps_those_that_are_written(
    presses: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the first press, the others are drawn; after the second one, they are left out."""
    folder = tmp_path / "a design"
    results.design().save(folder)
    write = draw.save
    written: list[Path] = []

    def press(figure: Figure, path: Path) -> None:
        written.append(write(figure, path))
        for _ in range(presses if len(written) == 1 else 0):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(draw, "save", press)
    said = done("report", folder, "--pictures", code=1).stderr
    assert NOTHING_SENTENCE not in said
    count = len(picture_names(results.design())) if presses == 1 else 1
    assert len(list(folder.glob("*.png"))) == len(written) == count

    advice = f"`mjfim report '{folder}' --pictures` draws the pictures that are missing"
    assert (advice in said) == (presses == 2)
