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


def test_report_writes_the_report_of_a_folder(tmp_path: Path) -> None:
    """A report of the user is replaced with --force only."""
    results.design().save(tmp_path)
    done("report", tmp_path)
    first = (tmp_path / REPORT).read_bytes()

    (tmp_path / REPORT).write_text("mine", encoding="utf-8")
    misused(run("report", tmp_path), f"{REPORT}: changed after mjfim wrote it", "--force")
    done("report", tmp_path, "--force")
    assert (tmp_path / REPORT).read_bytes() == first


@pytest.mark.usefixtures("empty_figures")
def test_report_draws_pictures_that_are_missing(tmp_path: Path) -> None:
    """Only on request, and only those of which there is no file in any format."""
    results.design().save(tmp_path)
    (tmp_path / "convergence.svg").write_text("<svg/>", encoding="utf-8")
    done("report", tmp_path)
    assert not list(tmp_path.glob("*.png"))

    result = done("report", tmp_path, "--pictures")
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == set(picture_names(results.design())) - {"convergence"}
    assert all(f"wrote {tmp_path / name}.png" in result.stderr for name in drawn)


@pytest.mark.usefixtures("empty_figures")
def test_report_draws_pictures_again_that_are_older_than_their_result(tmp_path: Path) -> None:
    """Ctrl-C during a second run leaves the pictures of the first one, in whatever format."""
    results.design().save(tmp_path)
    done("report", tmp_path, "--pictures", "--format", "svg")
    drawn = sorted(tmp_path.glob("*.svg"))
    written = (tmp_path / "design.npz").stat().st_mtime_ns
    os.utime(drawn[0], ns=(0, written - 1))
    os.utime(drawn[1], ns=(0, written))

    done("report", tmp_path, "--pictures")
    assert [path.stem for path in tmp_path.glob("*.png")] == [drawn[0].stem]
    assert sorted(tmp_path.glob("*.svg")) == drawn[1:]


@pytest.mark.parametrize("presses", [1, 2])
@pytest.mark.usefixtures("empty_figures")
def test_a_press_while_pictures_are_drawn_keeps_those_that_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """After the first press, the others are drawn; after the second one, they are left out."""
    folder = tmp_path / "a design"
    results.design().save(folder)
    write = draw.save
    written: list[Path] = []

    def press(figure: Figure, path: Path) -> None:
        write(figure, path)
        written.append(path)
        for _ in range(presses if len(written) == 1 else 0):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(draw, "save", press)
    result = done("report", folder, "--pictures", code=1)
    assert NOTHING_SENTENCE not in result.stderr
    names = picture_names(results.design())
    assert len(list(folder.glob("*.png"))) == len(written) == (len(names) if presses == 1 else 1)

    advice = f"`mjfim report '{folder}' --pictures` draws the pictures that are missing"
    assert (advice in result.stderr) == (presses == 2)


def test_report_of_a_folder_without_results(tmp_path: Path) -> None:
    misused(run("report", tmp_path), f"{tmp_path}: holds no result; ", "design.npz")
    misused(run("report", tmp_path / "nowhere"), "no such folder")
    assert list(tmp_path.iterdir()) == []
