"""Folders and results of a short study that the tests of several verbs share.

Every process of the tests computes them once. Tests only read them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from typer.testing import Result

from mjfim.output import folders
from tests.support.cli import done, run, write_empty_figures, write_experiment


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the short study."""
    folder = tmp_path_factory.mktemp("cli")
    write_experiment(folder)
    return folder


@pytest.fixture(scope="session")
def study(home: Path) -> Path:
    """Experiment file of the short study."""
    return home / "study.toml"


@pytest.fixture(scope="session")
def designed(home: Path, study: Path) -> Result:
    """Result of `mjfim design --json` into home/out."""
    return run("design", study, "-o", home / "out", "--json")


@pytest.fixture(scope="session")
def archived(home: Path, designed: Result) -> Path:
    """The design.npz of the design."""
    assert designed.exit_code == 0
    return home / "out" / "design.npz"


@pytest.fixture(scope="session")
def recorded(home: Path, study: Path, archived: Path) -> Path:
    """Recording that `mjfim simulate` writes to home/run.csv."""
    done("simulate", study, archived, "-o", home / "run.csv", "--seed", 1)
    return home / "run.csv"


@pytest.fixture(scope="session")
def identified(home: Path, study: Path, recorded: Path) -> Result:
    """Result of `mjfim identify --json` into home/fit, with empty figures."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        write_empty_figures(monkeypatch)
        return run("identify", study, recorded, "-o", home / "fit", "--json")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, which is empty."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def folder(home: Path, recorded: Path, here: Path) -> Path:
    """The current folder: the short study, its design and recording, and files of the user."""
    for name in ("study.toml", "cart_pendulum.xml", "cart_pendulum.csv", "run.csv"):
        shutil.copy(home / name, here)
    (here / "out").mkdir()
    for name in ("design.npz", "design.json"):
        shutil.copy(home / "out" / name, here / "out")
    for name in ("notes.txt", "film.gif"):
        (here / name).write_text("mine", encoding="utf-8")
    (here / "empty").mkdir()
    return here


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no files, in tests that do not look at them: to draw figures takes seconds."""
    monkeypatch.setattr(folders, "write_result", lambda *_: ([], list))
