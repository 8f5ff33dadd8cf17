"""`mjfim check` from the command line: the table, the files, exit codes, misuse."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

import mjfim
from mjfim.output.plots.check import check_figure
from tests.support.cli import MODELS, loads, names, read, run, write_experiment


@pytest.fixture(scope="module")
def study(tmp_path_factory) -> Path:
    """A short experiment."""
    return write_experiment(tmp_path_factory.mktemp("check"))


def test_a_table_a_verdict_and_nothing_on_disk(study: Path) -> None:
    before = names(study.parent)
    result = run("check", study)
    assert result.exit_code == 0
    for word in ("m (kg)", "relative σ", "repetitions", "Verdict", "self-test passed", "best case"):
        assert word in result.stdout
    assert names(study.parent) == before


def test_json_is_the_same_as_the_file(study: Path, tmp_path) -> None:
    result = run("check", study, "--json", "-o", tmp_path / "out")
    told = loads(result.stdout)
    assert told == read(tmp_path / "out" / "check.json")
    assert names(tmp_path / "out") == {"check.json", "check.npz", "check.png"}
    assert imread(tmp_path / "out" / "check.png").shape[0] > 300
    assert told["ok"] is True
    assert [row["name"] for row in told["parameters"]] == ["m", "l", "c"]
    assert np.shape(told["correlation"]) == (3, 3)
    assert told["self_test"]["passed"] is True


def test_what_cannot_be_told_alone_is_exit_code_1_and_names_it() -> None:
    result = run("check", MODELS / "double_pendulum.toml")
    assert result.exit_code == 1
    assert "m1r1 + 0.3 m2" in result.stdout
    assert "I1 + 0.09 m2" in result.stdout
    assert "dry friction" in result.stdout  # and that it is not smooth


def test_designs_and_recordings_are_looked_at_instead(study: Path, tmp_path) -> None:
    assert run("design", study, "-o", tmp_path / "d").exit_code in (0, 1)
    archive = tmp_path / "d" / "design.npz"
    designed = loads(run("check", study, "--design", archive, "--json").stdout)
    assert designed["source"] == "the given trajectory"
    sigma = read(tmp_path / "d" / "design.json")["final"]["std"]
    np.testing.assert_allclose([row["std"] for row in designed["parameters"]], sigma, rtol=1e-4)
    run("simulate", study, archive, "-o", tmp_path / "r.csv")
    recorded = loads(run("check", study, tmp_path / "r.csv", "--json").stdout)
    assert recorded["source"] == "1 recording"
    np.testing.assert_allclose([row["std"] for row in recorded["parameters"]], sigma, rtol=1e-4)


def test_misuse(study: Path, tmp_path) -> None:
    for words, said in (
        ((tmp_path / "no.toml",), "no.toml"),
        ((study, tmp_path / "no.csv"), "no.csv"),
        ((study, "--design", tmp_path / "no.npz"), "no.npz"),
    ):
        result = run("check", *words)
        assert result.exit_code == 2
        assert said in result.stderr
        assert "Traceback" not in result.stderr


@pytest.mark.slow
def test_the_picture_shows_parameters_that_are_not_known_alone() -> None:
    found = mjfim.check(mjfim.Experiment.from_file(MODELS / "double_pendulum.toml"))
    figure = check_figure(found)
    bars, heat = figure.axes[0], figure.axes[1]
    assert [label.get_text() for label in bars.get_yticklabels()] == list(found.wanted)
    hatched = [patch for patch in bars.patches if patch.get_hatch()]
    assert len(hatched) == 3
    shown = heat.images[0].get_array()
    assert shown.shape == (7, 7)
    assert np.ma.getmaskarray(shown)[:3].all()
