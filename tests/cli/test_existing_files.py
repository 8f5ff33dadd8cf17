"""Existing files: a verb replaces its own earlier results, and never files of the user."""

from __future__ import annotations

import os
import runpy
from pathlib import Path

import pytest

import mjfim
from mjfim.errors import OutputError
from mjfim.output import folders
from mjfim.output.manifest import FOLDER_LOCK, MANIFEST, OutputGuard, locked
from mjfim.output.page import PictureFormat
from tests.support.cli import misused, names, run, write_experiment
from tests.support.contents import contents
from tests.support.paths import SCRIPTS


def test_identify_does_not_replace_the_model_of_the_experiment(folder: Path) -> None:
    """An experiment that goes on from an identified model, into the folder of this model."""
    write_experiment(folder, model='"fit/identified.xml"')
    (folder / "fit").mkdir()
    (folder / "cart_pendulum.xml").rename(folder / "fit" / "identified.xml")
    before = contents(folder / "fit")
    result = run("identify study.toml run.csv -o fit --force")
    misused(result, "fit/identified.xml: this result would replace", "an input")
    assert contents(folder / "fit") == before


def test_a_second_run_does_not_enter_the_folder_of_the_first(folder: Path) -> None:
    """Exit code 2; the message names the folder and the process."""
    with locked(folder / "empty" / FOLDER_LOCK):
        result = run("design study.toml -o empty")
    misused(result, "empty: another run of mjfim writes", f"process {os.getpid()}, since")
    assert names(folder / "empty") == set()


def test_every_file_of_a_verb_is_checked_before_the_work(home: Path, identified: object) -> None:
    """The patterns with which verbs check hold all names that they write."""
    for place, kind in (("out", mjfim.Design), ("fit", mjfim.Estimate)):
        known = folders.matching(home / place, folders.names_of(kind, PictureFormat.PNG))
        written = names(home / place) - {MANIFEST, folders.IDENTIFIED}
        assert {file.name for file in known} == written


@pytest.mark.slow
def test_the_script_for_logs_does_not_replace_a_model_of_the_user(folder: Path) -> None:
    """Its own earlier result is replaced; the user's with --force, which the message names."""
    identify = runpy.run_path(str(SCRIPTS / "identify_offline.py"))["identify"]
    study, log, mine = (folder / name for name in ("study.toml", "run.csv", "identified.xml"))
    mine.write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match=r"identified\.xml: not listed.*--force"):
        identify(study, [log], force=False)
    assert mine.read_text(encoding="utf-8") == "mine"

    assert identify(study, [log], force=True) == 0
    OutputGuard([], force=False).check([mine])
    assert mine.read_text(encoding="utf-8").startswith("<mujoco")
