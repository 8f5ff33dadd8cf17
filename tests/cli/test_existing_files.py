"""Existing files: a verb replaces its own earlier results, and never files of the user."""

from __future__ import annotations

import os
import runpy
import shutil
from pathlib import Path

import pytest

import mjfim
from mjfim.errors import OutputError
from mjfim.output import folders
from mjfim.output.manifest import FOLDER_LOCK, MANIFEST, OutputGuard, claimed, locked
from mjfim.output.page import PictureFormat
from tests.support.cli import misused, names, run, write_experiment
from tests.support.contents import contents
from tests.support.paths import SCRIPTS


@pytest.mark.parametrize(
    "name", ["study.toml", "design.npz", "cart_pendulum.xml", "cart_pendulum.csv"]
)
def test_simulate_does_not_replace_what_it_reads(name: str, archived: Path, tmp_path: Path) -> None:
    """Not even with --force; the message names both files."""
    study = write_experiment(tmp_path)
    shutil.copy(archived, tmp_path / "design.npz")
    before = contents(tmp_path)
    words = ("simulate", study, tmp_path / "design.npz", "-o", tmp_path / name)
    for force in ((), ("--force",)):
        misused(run(*words, *force), f"{tmp_path / name}: this result would replace", "an input")
    assert contents(tmp_path) == before


def test_identify_does_not_replace_the_model_of_the_experiment(
    recorded: Path, tmp_path: Path
) -> None:
    """An experiment that goes on from an identified model, into the folder of this model."""
    study = write_experiment(tmp_path, model='"fit/identified.xml"')
    (tmp_path / "fit").mkdir()
    (tmp_path / "cart_pendulum.xml").rename(tmp_path / "fit" / "identified.xml")
    before = contents(tmp_path / "fit")
    result = run("identify", study, recorded, "-o", tmp_path / "fit", "--force")
    misused(result, "fit/identified.xml: this result would replace", "an input")
    assert contents(tmp_path / "fit") == before


def test_compare_keeps_an_earlier_result_that_it_reads(study: Path, tmp_path: Path) -> None:
    """A control of an earlier comparison is the initial control now."""
    write_experiment(tmp_path, start='"control_chirp.csv"')
    guard = OutputGuard([], force=False)
    with claimed(tmp_path, guard, exclusive=True):
        folders.archive.write_table(tmp_path / "control_chirp.csv", {"t": [0.0]})
    shutil.copy(study.parent / "cart_pendulum.csv", tmp_path / "control_chirp.csv")
    words = ("compare", tmp_path / "study.toml", "-o", tmp_path, "--methods", "chirp", "--force")
    misused(run(*words), "control_chirp.csv: this result would replace", "an input")


def test_a_second_run_does_not_enter_the_folder_of_the_first(study: Path, tmp_path: Path) -> None:
    """Exit code 2; the message names the folder and the process."""
    with locked(tmp_path / FOLDER_LOCK):
        result = run("design", study, "-o", tmp_path)
    misused(result, f"{tmp_path}: another run of mjfim writes", f"process {os.getpid()}, since")
    assert names(tmp_path) == set()


def test_every_file_of_a_verb_is_checked_before_the_work(
    home: Path, identified: object, recorded: Path
) -> None:
    """The patterns with which verbs check hold all names that they write."""
    for place, kind in (("out", mjfim.Design), ("fit", mjfim.Estimate)):
        known = folders.matching(home / place, folders.names_of(kind, PictureFormat.PNG))
        written = names(home / place) - {MANIFEST, folders.IDENTIFIED}
        assert {file.name for file in known} == written


@pytest.mark.slow
def test_the_script_for_logs_does_not_replace_a_model_of_the_user(
    study: Path, recorded: Path, tmp_path: Path
) -> None:
    """Its own earlier result is replaced; the user's with --force, which the message names."""
    identify = runpy.run_path(str(SCRIPTS / "identify_offline.py"))["identify"]
    log = tmp_path / "log.csv"
    shutil.copy(recorded, log)
    mine = tmp_path / "identified.xml"
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match=r"identified\.xml: not listed.*--force"):
        identify(study, [log], force=False)
    assert mine.read_text(encoding="utf-8") == "mine"

    assert identify(study, [log], force=True) == 0
    OutputGuard([], force=False).check([mine])
    assert mine.read_text(encoding="utf-8").startswith("<mujoco")
