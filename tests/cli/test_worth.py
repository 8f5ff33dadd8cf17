"""`mjfim worth` on the command line."""

from __future__ import annotations

from pathlib import Path

from tests.support.cli import done, loads, names, read, run


def test_an_experiment_is_answered_with_and_without_a_sensor(study: Path, tmp_path: Path) -> None:
    result = done("worth", study, "--add", "gyro:bob=0.01", "--json", "-o", tmp_path / "out")
    found = loads(result.stdout)
    assert found == read(tmp_path / "out" / "worth.json")
    added = [each for each in found["sensors"] if each["is_added"]]
    assert [each["name"] for each in added] == ["gyro of bob"]
    assert added[0]["present"]["c"] < found["std"]["c"]
    assert {"worth.png", "report.html"} <= names(tmp_path / "out")


def test_a_folder_of_a_design_names_its_experiment(archived: Path) -> None:
    result = run("worth", archived.parent, "--seconds", "0", "--json")
    assert result.exit_code == 0 and loads(result.stdout)["source"] == "the design"


def test_a_sensor_without_noise_is_refused(study: Path) -> None:
    result = run("worth", study, "--add", "gyro:bob")
    assert result.exit_code == 2 and "SENSOR=SIGMA" in result.stderr
