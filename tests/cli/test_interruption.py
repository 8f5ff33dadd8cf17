"""Ctrl-C: exit code 1, one message, and the best result so far on disk."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mjfim
from mjfim.cli.progress import ProgressDisplay
from mjfim.experiment.system import System
from mjfim.identification.assessment import parameter_draws
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots import draw
from mjfim.parallel.budget import NOTHING_SENTENCE
from mjfim.studies import check as study_check
from tests.support.cli import (
    ESTIMATE_DATA,
    done,
    names,
    read,
    run,
)
from tests.support.paths import MODELS, ROOT


def interrupt(*_: object, **__: object) -> None:
    """Send SIGINT to this process, as Ctrl-C does."""
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):  # the handler runs between two instructions
        pass


@pytest.mark.parametrize(
    "words", ["design study.toml", "identify study.toml run.csv", "montecarlo study.toml out"]
)
def test_interrupted_before_a_result(
    words: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 1, one message, and nothing on disk."""
    monkeypatch.setattr(System, "resolve", interrupt)
    result = done(f"{words} -o new", code=1)
    assert result.stdout == ""
    assert result.stderr == "mjfim: interrupted before there was a result; nothing was written\n"
    assert not (folder / "new").exists()


def test_interrupted_while_writing(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message does not deny files that are already written."""
    monkeypatch.setattr(draw, "save", interrupt)
    said = run("design study.toml -o new").stderr
    assert "design.npz" in names(folder / "new")
    assert "nothing was written" not in said


@pytest.mark.parametrize(
    ("place", "name", "options", "said"),
    [
        (ProgressDisplay, "__call__", "", "holds only a part of the results"),
        pytest.param(
            parameter_draws,
            "draw_parameters_system",
            "--samples 3",
            "no robots were drawn, because the run was interrupted",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_two_presses_during_a_fit_or_while_robots_are_drawn_keep_the_data(
    place: Any, name: str, options: str, said: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press_twice(*arguments: object) -> None:
        if getattr(arguments[-1], "iteration", 1) == 1:
            interrupt()
            interrupt()

    monkeypatch.setattr(place, name, press_twice)
    result = done(f"identify study.toml run.csv -o fit {options}", code=1)
    assert type(result.exception) is SystemExit
    assert names(folder / "fit") == {*ESTIMATE_DATA, MANIFEST}
    assert said in result.stderr
    status = read(folder / "fit" / "estimate.json")["status"]
    assert ("interrupted" in status) is not bool(options)


@pytest.mark.usefixtures("empty_figures")
def test_an_interrupted_check_is_written_and_marked_as_incomplete(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The accuracies are there; what is missing is named, and nothing is called sufficient."""
    whole = study_check.recursion_error
    monkeypatch.setattr(
        study_check, "recursion_error", lambda *task: (interrupt(), whole(*task))[1]
    )
    said = done("check study.toml -o new", code=1).stdout
    assert "this check is incomplete; it lacks the test of the derivatives" in said
    assert "every identifiable parameter reaches" not in said

    found = read(folder / "new" / "check.json")
    assert (found["ok"], found["complete"]) == (False, False)
    assert not found["self_test"]["passed"] and not found["self_test"]["finished"]
    monkeypatch.undo()
    stated = mjfim.check(mjfim.Experiment.from_file(folder / "study.toml"))
    loaded = mjfim.Check.load(folder / "new")
    assert [row.std for row in loaded.rows] == [row.std for row in stated.rows]
    assert loaded.missing and not stated.missing


# A program that runs the command line, and sends itself a signal when a module is imported.
PRESSED_DURING_IMPORT = """
import os
import runpy
import signal
import sys
from importlib.abc import MetaPathFinder


class Press(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGTERM)


module = sys.argv.pop(1)
sys.meta_path.insert(0, Press())
runpy.run_module("mjfim", run_name="__main__")
"""


@pytest.mark.parametrize(
    "module", ["mjfim.cli.main", pytest.param("numpy", marks=pytest.mark.slow), "mujoco"]
)
def test_a_press_while_the_program_or_a_verb_starts(module: str) -> None:
    """A verb imports numpy and mujoco when it runs."""
    words = ["check", MODELS / "cart_pendulum.toml"]
    ended = subprocess.run(
        [sys.executable, "-W", "error", "-c", PRESSED_DURING_IMPORT, module, *words],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        timeout=60.0,
    )
    assert ended.returncode == 1
    assert ended.stderr == f"mjfim: {NOTHING_SENTENCE}\n"
    assert not ended.stdout
