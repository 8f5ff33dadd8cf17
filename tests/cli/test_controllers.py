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
def stated(tmp_path: Path) -> Path:
    """An experiment with laws."""
    path = tmp_path / "arm.toml"
    path.write_text(EXPERIMENT.format(model=ARM.as_posix()))
    return path


def test_a_closed_loop_is_simulated(stated: Path, tmp_path: Path) -> None:
    done("simulate", stated)
    header = (tmp_path / "recording.csv").read_text().splitlines()[0].replace('"', "")
    assert header == "t,reference:shoulder,reference:elbow,qpos:shoulder,qpos:elbow"


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_an_estimate_says_which_laws_were_in_the_loop(stated: Path, tmp_path: Path) -> None:
    log, folder = tmp_path / "recording.csv", tmp_path / "out"
    done("simulate", stated)

    result = done("identify", stated, log, "-o", folder)
    plain = " ".join(result.output.split())
    assert "The control of shoulder is that of its law in the loop, evaluated at 250 Hz" in plain
    assert "without the control laws of shoulder, elbow" in plain

    found = json.loads((folder / "estimate.json").read_text())
    assert [law["actuator"] for law in found["controllers"]] == ["shoulder", "elbow"]
    assert found["controllers"][0]["numbers"]["kp"] == pytest.approx(60.0, abs=1.0)
    loaded = mjfim.Estimate.load(folder)
    assert loaded.motion is not None and loaded.motion.ctrl.shape[1] == 2
    assert "law in the loop" in (folder / "report.html").read_text()


def test_verbs_say_what_a_file_with_laws_serves(stated: Path, tmp_path: Path) -> None:
    shown = done("validate", stated, "--verbose")
    assert "It serves `identify` and `simulate`, not `design`" in " ".join(shown.output.split())
    assert "Control laws in the loop" in shown.output

    misused(run("design", stated, "-o", tmp_path / "d"), "controllers: design needs a control")
