"""`mjfim worth` on the command line."""

from __future__ import annotations

from pathlib import Path

from tests.support.cli import done, loads, names, read


def test_an_experiment_is_answered_with_and_without_a_sensor(folder: Path) -> None:
    found = loads(done("worth study.toml --add gyro:bob=0.01 --json -o new").stdout)
    assert found == read(folder / "new" / "worth.json")
    (added,) = [each for each in found["sensors"] if each["is_added"]]
    assert added["name"] == "gyro of bob"
    assert added["present"]["c"] < found["std"]["c"]
    assert {"worth.png", "report.html"} <= names(folder / "new")

    # A folder of a design names its experiment.
    assert loads(done("worth out --seconds 0 --json").stdout)["source"] == "the design"
