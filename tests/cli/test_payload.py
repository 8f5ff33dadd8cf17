"""`mjfim payload`: its files, its sentences, exit codes, and wrong inputs."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.output.manifest import MANIFEST
from tests.support.cli import ESTIMATE, done, names, read, run, write_experiment

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
def test_a_payload_is_said_and_written(here: Path) -> None:
    write_experiment(here)
    text = Path("study.toml").read_text(encoding="utf-8")
    Path("loaded.toml").write_text(text + LOAD, encoding="utf-8")
    done("simulate study.toml -o unloaded.csv")
    done("simulate loaded.toml -o loaded.csv --seed 1")

    # The experiment with the load says where it is; the log without it says what the robot is.
    out = here / "out"
    result = run("payload loaded.toml loaded.csv --without unloaded.csv -o out --size 0.1")
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
