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
from tests.support.cli import (
    ESTIMATE,
    done,
    loads,
    misused,
    names,
    read,
    run,
    write_experiment,
)


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
def test_identify_several_recordings(
    home: Path, study: Path, recorded: Path, identified: Result, tmp_path: Path
) -> None:
    """Two recordings give smaller deviations than one; pictures that take long are named."""
    design, second = home / "out" / "design.npz", tmp_path / "b.csv"
    done("simulate", study, design, "-o", second, "--seed", 5)

    words = ("-o", tmp_path / "fit", "--method", "newton")
    result = done("identify", study, recorded, second, *words)
    assert names(tmp_path / "fit") - {MANIFEST} == (ESTIMATE - {"fit.png"}) | {
        "fit_1.png",
        "recordings.png",
    }
    assert "not drawn: fit_2" in result.stdout + result.stderr
    both, one = read(tmp_path / "fit" / "estimate.json"), loads(identified.stdout)
    assert np.all(np.array(both["std"]) < 0.85 * np.array(one["std"]))
    assert both["recordings"] == [str(recorded), str(second)]


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_misfit(study: Path, recorded: Path, tmp_path: Path) -> None:
    """The model cannot explain the recording: the exit code and the text say so."""
    header, *rows = recorded.read_text(encoding="utf-8").splitlines()
    cells = [row.split(",") for row in rows[:61]]
    bent = [[t, u, str(float(s) + 0.5 * float(t)), *rest] for t, u, s, *rest in cells]
    odd = tmp_path / "odd.csv"
    odd.write_text("\n".join([header, *(",".join(row) for row in bent)]) + "\n", encoding="utf-8")
    result = done("identify", study, odd, "-o", tmp_path / "fit", code=1)
    assert read(tmp_path / "fit" / "estimate.json")["misfit"] is True
    assert "residuals are" in " ".join(result.stdout.split())


def test_a_bad_recording_beside_a_good_one_is_named(
    study: Path, recorded: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.csv"
    text = recorded.read_text(encoding="utf-8")
    bad.write_text(text.replace("ctrl:force", "force", 1), encoding="utf-8")
    result = run("identify", study, recorded, bad, "-o", tmp_path / "out")
    misused(result, "bad.csv", "'ctrl:force' is missing")
    assert names(tmp_path) == {"bad.csv"}


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_drawn_robots(study: Path, recorded: Path, tmp_path: Path) -> None:
    """A table and a model for each robot; the next run into the folder replaces or removes them."""
    out = tmp_path / "fit"
    words = ("identify", study, recorded, "-o", out)
    result = done(*words, "--samples", 3, "--seed", 7)
    assert names(out) - {MANIFEST} == ESTIMATE | {"samples.csv", "samples.png", "samples"}
    models = {f"robot_000{i}.xml" for i in (1, 2, 3)}
    assert names(out / "samples") - {MANIFEST} == models
    data = read(out / "estimate.json")
    assert (data["draws"]["count"], data["draws"]["seed"]) == (3, 7)
    assert "3 robots were drawn" in result.stdout
    first = (out / "samples.csv").read_text(encoding="utf-8")

    # The seed alone decides. A file that was edited is the user's.
    (out / "samples" / "robot_0002.xml").write_text("edited", encoding="utf-8")
    misused(run(*words, "--samples", 2), "robot_0002.xml: changed after mjfim wrote it")
    done(*words, "--samples", 2, "--seed", 7, "--force")
    assert names(out / "samples") - {MANIFEST} == {"robot_0001.xml", "robot_0002.xml"}
    second = (out / "samples.csv").read_text(encoding="utf-8")
    assert first.startswith(second)

    # Without the option, nothing of them remains.
    done(*words)
    assert names(out) - {MANIFEST} == ESTIMATE
    assert read(out / "estimate.json")["draws"] is None


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.slow
def test_no_robots_are_drawn_from_undetermined_parameters(
    study: Path, recorded: Path, tmp_path: Path
) -> None:
    """The fit is kept, and the message names the parameter."""
    path = write_experiment(tmp_path)
    with path.open("a", encoding="utf-8") as experiment:
        experiment.write('\n[parameters.extra]\ntarget = "body/cart:inertia[1]"\n')
    out = tmp_path / "fit"
    result = done("identify", path, recorded, "-o", out, "--samples", 5, code=1)
    said = " ".join(result.stderr.split())
    assert "--samples: no robots were drawn: the recordings do not determine extra" in said
    assert {"samples", "samples.csv", "samples.png"}.isdisjoint(names(out))
    assert read(out / "estimate.json")["draws"] is None


@pytest.mark.usefixtures("empty_figures")
def test_the_accuracy_that_a_design_predicted_stands_beside_the_estimates(
    home: Path, study: Path, recorded: Path, tmp_path: Path
) -> None:
    folder, held = tmp_path / "fit", tmp_path / "held.csv"
    done("simulate", study, home / "out" / "design.npz", "-o", held, "--seed", 5)
    words = ("identify", study, recorded, "-o", folder, "--held-out", held, "--predicted")
    done(*words, home / "out")
    stated = mjfim.Design.load(home / "out").stated_std
    assert_allclose(read(folder / "estimate.json")["predicted_std"], stated, rtol=1e-9)
    (prediction,) = mjfim.Estimate.load(folder).predictions
    assert prediction.held_out and prediction.recording is not None
    misused(run(*words, tmp_path, "--force"), "design.npz: this file is missing")
