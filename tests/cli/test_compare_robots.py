"""`mjfim compare-robots`: its files, exit codes and sentences on what differs otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjfim.output.manifest import MANIFEST
from tests.support import results
from tests.support.cli import done, misused, names, read, run

FILES = {
    "robots.json",
    "robots.npz",
    "robots.png",
    "report.html",
    MANIFEST,
}


def saved(folder: Path, shift: float, **changes: object) -> Path:
    """Save an estimate with another damping, from a recording of its own."""
    made = results.estimate(**changes)
    (recording,) = made.recordings
    moved = replace(recording, y=recording.y + shift, name=f"{folder}.csv")
    theta = made.theta + np.array([0.0, 0.0, shift])
    interval = np.column_stack([theta - 2.0 * made.std, theta + 2.0 * made.std])
    sizes = np.abs(theta)
    replace(made, recordings=(moved,), theta=theta, sizes=sizes, interval=interval).save(folder)
    return folder


@pytest.mark.slow
def test_a_difference_is_said_and_written(tmp_path: Path) -> None:
    monday, friday = saved(tmp_path / "monday", 0.0), saved(tmp_path / "friday", 0.2)
    out = tmp_path / "out"
    result = done("compare-robots", monday, friday, "-o", out, code=1)
    assert names(out) == FILES
    said = " ".join(result.stdout.split())
    assert "There is a difference between monday and friday in damping." in said
    assert "damping of friday is 40 % above that of monday" in said
    data = read(out / "robots.json")
    assert (data["first"], data["second"]) == ("../monday", "../friday")
    assert data["differs"] is True
    assert "friday and monday" not in (out / "report.html").read_text(encoding="utf-8")

    # The report is made again from the files alone.
    before = (out / "report.html").read_bytes()
    done("report", out)
    assert (out / "report.html").read_bytes() == before


@pytest.mark.usefixtures("empty_figures")
def test_equal_robots(tmp_path: Path) -> None:
    """The exit code is 0, and what would have been found is said; the folders have one name."""
    first, second = saved(tmp_path / "old" / "fit", 0.0), saved(tmp_path / "new" / "fit", 1e-4)
    result = done("compare-robots", first, second / "estimate.npz", "-o", tmp_path / "out")
    said = " ".join(result.stdout.split())
    assert "The data show no difference between old/fit and new/fit. A change of" in said
    assert "the experiment files of the estimates are not where they were" in said


@pytest.mark.usefixtures("empty_figures")
def test_models_that_differ_are_named(tmp_path: Path) -> None:
    folders = [saved(tmp_path / name, shift) for name, shift in (("a", 0.0), ("b", 1e-4))]
    for folder, mass in zip(folders, ("1", "2"), strict=True):
        (folder / "robot.xml").write_text(mass, encoding="utf-8")
        (folder / "robot.toml").write_text("", encoding="utf-8")
        path = folder / "estimate.json"
        text = path.read_text(encoding="utf-8")
        origin = '{"experiment": "robot.toml", "model": "robot.xml", '
        path.write_text(origin + text[1:], encoding="utf-8")
    result = done("compare-robots", *folders, "-o", tmp_path / "out", "-v")
    said = " ".join(result.stdout.split())
    assert "the models of the estimates differ" in said
    assert "experiment files" not in said


def test_misuse(tmp_path: Path) -> None:
    first = saved(tmp_path / "a", 0.0)
    missing = run("compare-robots", first, tmp_path / "b", "-o", tmp_path / "out")
    misused(missing, "b: no such file or folder")
    done("compare-robots", first, saved(tmp_path / "d", 0.1), "-o", first, code=1)
    assert {"estimate.npz", "robots.npz"} <= names(first)
