"""`mjfim identify`: its files and exit codes, and recordings that it refuses."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from typer.testing import Result

import mjfim
from mjfim.output.manifest import MANIFEST
from tests.support.cli import ESTIMATE, done, loads, misused, names, read, run, write_experiment


def test_identify_leaves_its_files(home: Path, identified: Result) -> None:
    """All promised files; the error is less than four standard deviations."""
    assert identified.exit_code == 0
    assert names(home / "fit") == ESTIMATE | {MANIFEST}
    data = read(home / "fit" / "estimate.json")
    assert loads(identified.stdout) == data
    assert np.all(np.abs(np.subtract(data["theta"], [2.0, 1.0, 1.0])) < 4 * np.array(data["std"]))
    model = mujoco.MjModel.from_xml_path(str(home / "fit" / "identified.xml"))
    assert model.body("bob").mass[0] == pytest.approx(data["theta"][0], rel=1e-5)


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_identify_several_recordings(folder: Path, identified: Result) -> None:
    """Two recordings give smaller deviations than one; pictures that take long are named."""
    done("simulate study.toml out -o b.csv --seed 5")
    result = done("identify study.toml run.csv b.csv -o fit --method newton")
    assert names(folder / "fit") - {MANIFEST} == (ESTIMATE - {"fit.png"}) | {
        "fit_1.png",
        "recordings.png",
    }
    assert "not drawn: fit_2" in result.stdout + result.stderr
    both, one = read(folder / "fit" / "estimate.json"), loads(identified.stdout)
    assert np.all(np.array(both["std"]) < 0.85 * np.array(one["std"]))
    assert both["recordings"] == ["run.csv", "b.csv"]


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_misfit(folder: Path) -> None:
    """The model cannot explain the recording: the exit code and the text say so."""
    header, *rows = (folder / "run.csv").read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows[:61]]
    bent = [",".join([t, u, str(float(s) + 0.5 * float(t)), *rest]) for t, u, s, *rest in cells]
    (folder / "odd.csv").write_text("\n".join([header, *bent]) + "\n", encoding="utf-8")
    result = done("identify study.toml odd.csv -o fit", code=1)
    assert read(folder / "fit" / "estimate.json")["misfit"] is True
    assert "residuals are" in " ".join(result.stdout.split())


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_drawn_robots(folder: Path) -> None:
    """A table and a model for each robot; the next run into the folder replaces or removes them."""
    out, words = folder / "fit", "identify study.toml run.csv -o fit"
    result = done(f"{words} --samples 3 --seed 7")
    assert names(out) - {MANIFEST} == ESTIMATE | {"samples.csv", "samples.png", "samples"}
    models = {f"robot_000{i}.xml" for i in (1, 2, 3)}
    assert names(out / "samples") - {MANIFEST} == models
    data = read(out / "estimate.json")
    assert (data["draws"]["count"], data["draws"]["seed"]) == (3, 7)
    assert "3 robots were drawn" in result.stdout
    first = (out / "samples.csv").read_text(encoding="utf-8")

    # The seed alone decides. A file that was edited is the user's.
    (out / "samples" / "robot_0002.xml").write_text("edited", encoding="utf-8")
    misused(run(f"{words} --samples 2"), "robot_0002.xml: changed after mjfim wrote it")
    done(f"{words} --samples 2 --seed 7 --force")
    assert names(out / "samples") - {MANIFEST} == models - {"robot_0003.xml"}
    assert first.startswith((out / "samples.csv").read_text(encoding="utf-8"))

    # Without the option, nothing of them remains.
    done(words)
    assert names(out) - {MANIFEST} == ESTIMATE
    assert read(out / "estimate.json")["draws"] is None


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_no_robots_are_drawn_from_undetermined_parameters(folder: Path) -> None:
    """The fit is kept, and the message names the parameter."""
    more = '1\n[parameters.extra]\ntarget = "body/cart:inertia[1]"'
    write_experiment(folder, max_iterations=more)
    said = done("identify study.toml run.csv -o fit --samples 5", code=1).stderr
    sentence = "--samples: no robots were drawn: the recordings do not determine extra"
    assert sentence in " ".join(said.split())
    assert {"samples", "samples.csv", "samples.png"}.isdisjoint(names(folder / "fit"))
    assert read(folder / "fit" / "estimate.json")["draws"] is None


@pytest.mark.usefixtures("empty_figures")
def test_the_accuracy_that_a_design_predicted_stands_beside_the_estimates(folder: Path) -> None:
    done("simulate study.toml out -o held.csv --seed 5")
    words = "identify study.toml run.csv -o fit --held-out held.csv --force --predicted"
    done(f"{words} out")
    stated = mjfim.Design.load("out").stated_std
    assert_allclose(read(folder / "fit" / "estimate.json")["predicted_std"], stated, rtol=1e-9)
    (prediction,) = mjfim.Estimate.load("fit").predictions
    assert prediction.held_out and prediction.recording is not None
    misused(run(f"{words} empty"), "design.npz: this file is missing")
