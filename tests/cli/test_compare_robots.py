"""`mjfim compare-robots`: its files, exit codes and sentences on what differs otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mjfim.output.manifest import MANIFEST
from tests.support import results
from tests.support.cli import done, names, read

FILES = {
    "robots.json",
    "robots.npz",
    "robots.png",
    "report.html",
    MANIFEST,
}


def saved(name: str, shift: float) -> Path:
    """Save an estimate with another damping, from a recording of its own."""
    made, folder = results.estimate(), Path(name)
    (recording,) = made.recordings
    moved = replace(recording, y=recording.y + shift, name=f"{name}.csv")
    theta = made.theta + np.array([0.0, 0.0, shift])
    interval = np.column_stack([theta - 2.0 * made.std, theta + 2.0 * made.std])
    sizes = np.abs(theta)
    replace(made, recordings=(moved,), theta=theta, sizes=sizes, interval=interval).save(folder)
    return folder


@pytest.mark.slow
def test_a_difference_is_said_and_written(here: Path) -> None:
    saved("monday", 0.0)
    saved("friday", 0.2)
    said = " ".join(done("compare-robots monday friday -o out", code=1).stdout.split())
    assert names(here / "out") == FILES
    assert "There is a difference between monday and friday in damping." in said
    assert "damping of friday is 40 % above that of monday" in said
    data = read(here / "out" / "robots.json")
    assert (data["first"], data["second"]) == ("../monday", "../friday")
    assert data["differs"] is True
    report = here / "out" / "report.html"
    assert "friday and monday" not in report.read_text(encoding="utf-8")

    # The report is made again from the files alone.
    before = report.read_bytes()
    done("report out")
    assert report.read_bytes() == before


@pytest.mark.usefixtures("empty_figures", "here")
def test_equal_robots() -> None:
    """The exit code is 0, and what would have been found is said; the folders have one name."""
    saved("old/fit", 0.0)
    saved("new/fit", 1e-4)
    said = " ".join(done("compare-robots old/fit new/fit/estimate.npz -o out").stdout.split())
    assert "The data show no difference between old/fit and new/fit. A change of" in said
    assert "the experiment files of the estimates are not where they were" in said


@pytest.mark.usefixtures("empty_figures", "here")
def test_models_that_differ_are_named() -> None:
    for name, shift in (("a", 0.0), ("b", 1e-4)):
        folder = saved(name, shift)
        (folder / "robot.xml").write_text(name, encoding="utf-8")
        (folder / "robot.toml").touch()
        path = folder / "estimate.json"
        origin = '{"experiment": "robot.toml", "model": "robot.xml", '
        path.write_text(origin + path.read_text(encoding="utf-8")[1:], encoding="utf-8")
    said = " ".join(done("compare-robots a b -o out -v").stdout.split())
    assert "the models of the estimates differ" in said
    assert "experiment files" not in said


def test_the_result_may_stand_beside_an_estimate(here: Path) -> None:
    saved("a", 0.0)
    saved("d", 0.1)
    done("compare-robots a d -o a", code=1)
    assert {"estimate.npz", "robots.npz"} <= names(here / "a")
