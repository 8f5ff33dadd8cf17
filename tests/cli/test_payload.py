"""`mjfim payload`: its files, its sentences, exit codes, and wrong inputs."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.output.manifest import MANIFEST
from tests.support.cli import ESTIMATE, done, misused, names, read, run, write_experiment

# A load on the pendulum of the cart, which the experiment states for a design.
LOAD = """
[terms.load]
kind = "payload"
body = "bob"

[parameters.load]
target = "term/load:mass"
guess = 0.1
true = 0.3
"""


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_a_payload_is_said_and_written(tmp_path: Path) -> None:
    robot = write_experiment(tmp_path)
    loaded = tmp_path / "loaded.toml"
    loaded.write_text(robot.read_text(encoding="utf-8") + LOAD, encoding="utf-8")
    unloaded_log, log = tmp_path / "unloaded.csv", tmp_path / "loaded.csv"
    done("simulate", robot, "-o", unloaded_log)
    done("simulate", loaded, "-o", log, "--seed", 1)

    # The experiment with the load says where it is; the log without it says what the robot is.
    out = tmp_path / "out"
    result = run("payload", loaded, log, "--without", unloaded_log, "-o", out, "--size", "0.1")
    # What would take long to draw is left out.
    assert names(out) - {"recordings.png", "horizons.png"} == {*ESTIMATE, MANIFEST} - {"pairs.png"}
    data = read(out / "estimate.json")
    said = " ".join(result.stdout.split())
    assert "The payload at bob has a mass of" in said
    payload = data["payload"]
    low, high = payload["mass_interval"]
    assert low <= 0.3 <= high
    assert payload["source"] == "the recordings without the payload"
    assert payload["edge"] in (None, 0.1)
    assert '<body name="payload"' in (out / "identified.xml").read_text(encoding="utf-8")

    assert "The payload at bob" in (out / "report.html").read_text(encoding="utf-8")


def test_misuse_is_one_message(tmp_path: Path) -> None:
    robot = write_experiment(tmp_path)
    log, out = tmp_path / "log.csv", tmp_path / "out"
    log.write_text("t\n0\n", encoding="utf-8")
    misused(run("payload", robot, log, "-o", out), "body: name the body", "valid: ")
    misused(run("payload", robot, log, "-o", out, "--body", "bib"), "body: unknown body 'bib'")
    misused(run("payload", robot, log, "-o", out, "--body", "world"), "body: 'world'", "move")
    misused(run("payload", robot, log, "-o", out, "--body", "bob", "--size", "-1"), "size: -1")
    gone = tmp_path / "gone"
    misused(run("payload", robot, log, "-o", out, "--from", gone), f"{gone}: no such file")
    misused(run("payload", robot, log, "-o", out, "--without", f"{gone}.csv"), "gone.csv: no such")
    assert not out.exists()
