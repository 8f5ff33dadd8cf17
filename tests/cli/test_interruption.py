"""Ctrl-C: exit code 1, one message, and the best result so far on disk."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mjfim
from mjfim.cli.progress import ProgressDisplay
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.identification.assessment import parameter_draws
from mjfim.output import archive
from mjfim.output.folders import DESIGN_ARCHIVE
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots import draw
from mjfim.parallel.budget import NOTHING_SENTENCE
from mjfim.records.events import FitEvent
from mjfim.studies import check as study_check
from tests.fuzz.result_files import faults_of
from tests.support.cli import (
    DESIGN,
    ESTIMATE_DATA,
    PROCESS,
    done,
    names,
    read,
    run,
    write_experiment,
)
from tests.support.paths import MODELS, ROOT


def interrupt(*_: object, **__: object) -> None:
    """Send SIGINT to this process, as Ctrl-C does."""
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(1000):  # the handler runs between two instructions
        pass


@pytest.mark.parametrize("verb", ["design", "identify", "montecarlo"])
def test_interrupted_before_a_result(
    verb: str,
    study: Path,
    archived: Path,
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Exit code 1, one message, and nothing on disk."""
    monkeypatch.setattr(System, "resolve", interrupt)
    inputs = {"design": [], "identify": [recorded], "montecarlo": [archived]}[verb]
    result = run(verb, study, *inputs, "-o", tmp_path / "out")
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == "mjfim: interrupted before there was a result; nothing was written\n"
    assert names(tmp_path) == set()


def test_interrupted_while_writing(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message does not deny files that are already written."""
    monkeypatch.setattr(draw, "save", interrupt)
    result = run("design", study, "-o", tmp_path / "out")
    assert "design.npz" in names(tmp_path / "out")
    assert "nothing was written" not in result.stderr


def test_two_presses_during_an_estimation_keep_its_data(
    study: Path, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press_twice(display: ProgressDisplay, event: FitEvent) -> None:
        for _ in range(2 if event.iteration == 1 else 0):
            interrupt()

    monkeypatch.setattr(ProgressDisplay, "__call__", press_twice)
    result = run("identify", study, recorded, "-o", tmp_path / "fit")
    assert (result.exit_code, type(result.exception)) == (1, SystemExit)
    assert names(tmp_path / "fit") == {*ESTIMATE_DATA, MANIFEST}
    assert "holds only a part of the results" in result.stderr
    assert "interrupted" in read(tmp_path / "fit" / "estimate.json")["status"]


@pytest.mark.slow
def test_presses_while_robots_are_drawn_keep_the_fit(
    study: Path, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def drawn_for_ever(*_: object) -> None:
        """A user presses twice while robots are drawn, which takes long."""
        interrupt()
        interrupt()
        pytest.fail("drawing goes on")

    monkeypatch.setattr(parameter_draws, "draw_parameters_system", drawn_for_ever)
    result = run("identify", study, recorded, "-o", tmp_path / "fit", "--samples", 3)
    assert (result.exit_code, type(result.exception)) == (1, SystemExit)
    assert names(tmp_path / "fit") == {*ESTIMATE_DATA, MANIFEST}
    assert "no robots were drawn, because the run was interrupted" in result.stderr


@pytest.mark.usefixtures("empty_figures")
def test_an_interrupted_check_is_written_and_marked_as_incomplete(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The accuracies are there; what is missing is named, and nothing is called sufficient."""
    whole = study_check.recursion_error

    def recursion_error(*arguments: Any) -> float:
        interrupt()
        return whole(*arguments)

    monkeypatch.setattr(study_check, "recursion_error", recursion_error)
    result = done("check", study, "-o", tmp_path / "out", code=1)
    assert "this check is incomplete; it lacks the test of the derivatives" in result.stdout
    assert "every identifiable parameter reaches" not in result.stdout

    found = read(tmp_path / "out" / "check.json")
    assert (found["ok"], found["complete"]) == (False, False)
    assert not found["self_test"]["passed"] and not found["self_test"]["finished"]
    monkeypatch.undo()
    stated = mjfim.check(mjfim.Experiment.from_file(study))
    loaded = mjfim.Check.load(tmp_path / "out")
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


@pytest.mark.slow
def test_interrupted_design_leaves_the_best_so_far(tmp_path: Path) -> None:
    """Exit code 1, all files can be read, and the result is better than the start."""
    path = write_experiment(tmp_path, tolerance="1e-12", max_iterations="200\nstarts = 10000")
    words = [*PROCESS, "design", path, "-o", tmp_path / "out", "--threads", "1"]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        told = iter(process.stderr.readline, "")
        try:
            assert any(re.search(r"iteration +[1-9]\d", line) for line in told)
            process.send_signal(signal.SIGINT)
            _, rest = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 1
    assert "Traceback" not in rest
    assert "wrote" in rest
    out = tmp_path / "out"

    # On a busy computer there is no time for all pictures, which the last sentence says then.
    # It is not rehearsed.
    missing = (DESIGN | {MANIFEST}) - names(out) - {"rehearsal.png", "valley.png", "worth.png"}
    assert missing <= DESIGN - set(DESIGN_ARCHIVE)
    assert bool(missing) == (f"`mjfim report {out} --pictures`" in rest)
    data = read(out / "design.json")
    assert data["status"] == "interrupted"
    assert data["final"]["eigenvalues"][0] > 5 * data["initial"]["eigenvalues"][0]
    task = DesignTask.resolve(mjfim.Experiment.from_file(path))
    cost = evaluate_task(task, archive.read_design(out / "design.npz")["final"]).cost
    assert cost == pytest.approx(data["final"]["cost"], rel=1e-6)
    assert [fault for file in out.iterdir() for fault in faults_of(file)] == []
