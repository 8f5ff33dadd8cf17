"""Control laws on the command line: a simulated closed loop, its fit, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import mjfim
from tests.support.cli import done, misused, run
from tests.support.closed_loop import ARM

EXPERIMENT = """
model = "{model}"
rate = 250.0
horizon = 1.2
[initial]
keyframe = "hanging"
control = {{ kind = "multisine", amplitude = 0.4, frequency = 1.0 }}
[parameters.mass]
target = "body/fore:mass"
true = 1.3
[parameters.kp]
target = "controller/shoulder:kp"
true = 60.0
nuisance = true
[controllers.shoulder]
kp = 50.0
kd = 4.0
latency = "4 ms"
[controllers.elbow]
kp = 30.0
kd = 1.5
[noise]
"qpos:shoulder" = 1e-3
"qpos:elbow" = 1e-3
[fit]
bootstrap = 0
"""


@pytest.fixture
def folder(here: Path) -> Path:
    """The current folder, with an experiment with laws."""
    (here / "arm.toml").write_text(EXPERIMENT.format(model=ARM.as_posix()))
    return here


def test_a_closed_loop_is_simulated(folder: Path) -> None:
    done("simulate arm.toml")
    header = (folder / "recording.csv").read_text().splitlines()[0].replace('"', "")
    assert header == "t,reference:shoulder,reference:elbow,qpos:shoulder,qpos:elbow"


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_an_estimate_says_which_laws_were_in_the_loop(folder: Path) -> None:
    done("simulate arm.toml")
    result = done("identify arm.toml recording.csv -o out")
    plain = " ".join(result.output.split())
    assert "The control of shoulder is that of its law in the loop, evaluated at 250 Hz" in plain
    assert "without the control laws of shoulder, elbow" in plain

    found = json.loads((folder / "out" / "estimate.json").read_text())
    assert [law["actuator"] for law in found["controllers"]] == ["shoulder", "elbow"]
    assert found["controllers"][0]["numbers"]["kp"] == pytest.approx(60.0, abs=1.0)
    loaded = mjfim.Estimate.load("out")
    assert loaded.motion is not None and loaded.motion.ctrl.shape[1] == 2
    assert "law in the loop" in (folder / "out" / "report.html").read_text()


@pytest.mark.usefixtures("folder")
def test_verbs_say_what_a_file_with_laws_serves() -> None:
    shown = done("validate arm.toml --verbose").output
    assert "It serves `identify` and `simulate`, not `design`" in " ".join(shown.split())
    assert "Control laws in the loop" in shown
    misused(run("design arm.toml -o new"), "controllers: design needs a control")
