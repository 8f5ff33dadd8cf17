"""`mjfim report`: the report of a folder, made again from its files."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.output.plots.pictures import picture_names
from mjfim.output.report import REPORT
from tests.support import results
from tests.support.cli import misused, run


def test_report_writes_the_report_of_a_folder(tmp_path: Path) -> None:
    """A report of the user is replaced with --force only."""
    results.design().save(tmp_path)
    assert run("report", tmp_path).exit_code == 0
    first = (tmp_path / REPORT).read_bytes()

    (tmp_path / REPORT).write_text("mine", encoding="utf-8")
    misused(run("report", tmp_path), f"{REPORT}: changed after mjfim wrote it", "--force")
    assert run("report", tmp_path, "--force").exit_code == 0
    assert (tmp_path / REPORT).read_bytes() == first


@pytest.mark.usefixtures("empty_figures")
def test_report_draws_pictures_that_are_missing(tmp_path: Path) -> None:
    """Only on request, and only those of which there is no file in any format."""
    results.design().save(tmp_path)
    (tmp_path / "convergence.svg").write_text("<svg/>", encoding="utf-8")
    assert run("report", tmp_path).exit_code == 0
    assert not list(tmp_path.glob("*.png"))

    result = run("report", tmp_path, "--pictures")
    assert result.exit_code == 0
    drawn = {path.stem for path in tmp_path.glob("*.png")}
    assert drawn == set(picture_names(results.design())) - {"convergence"}
    assert all(f"wrote {tmp_path / name}.png" in result.stderr for name in drawn)


def test_report_of_a_folder_without_results(tmp_path: Path) -> None:
    misused(run("report", tmp_path), f"{tmp_path}: holds no result")
    misused(run("report", tmp_path / "nowhere"), "no such folder")
