"""Export to mujoco.sysid: with equal models, data and weights sysid and mjfim find equal values."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mujoco import sysid

from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.simulate import simulate_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.output.archive import write_recording
from mjfim.output.mjcf.write import same_dynamics
from mjfim.output.sysid.comparison import chi2, fit_with_sysid, report
from mjfim.output.sysid.sequences import build, export
from mjfim.records.trajectory import Recording
from tests.support.cli import misused, run
from tests.support.dense_residuals import dense_residuals
from tests.support.numerics import Array, body_task, filtered_task
from tests.support.paths import ROOT

CART = ROOT / "models" / "cart_pendulum.toml"
UNEQUAL = {"qpos:slide": 0.05, "qpos:hinge": 0.05, "qvel:slide": 0.005, "qvel:hinge": 0.005}
installed = pytest.mark.skipif(
    not hasattr(sysid, "ModelSequences"), reason="needs mujoco.sysid: pip install 'mjfim[sysid]'"
)


def cart(**tables: Any) -> DesignTask:
    """The cart-pendulum of the models, with some tables of its experiment replaced."""
    return DesignTask.resolve(Experiment.from_file(CART).model_copy(update=tables))


def noiseless(task: DesignTask, theta: Array | None = None) -> Recording:
    """Outputs of the initial control without noise, at the true values."""
    values = task.parameters.true if theta is None else theta
    y, _ = task.plant.measure(values[None], task.control)
    return Recording(
        t=np.arange(len(y[0])) * task.dt,
        ctrl=task.control,
        y=y[0],
        outputs=task.system.outputs.names,
    )


def residual(exported: Any, theta: Array, weighted: bool) -> Array:
    """All residuals in one row."""
    found, _, _ = exported.residual(weighted)(theta, exported.parameters.copy())
    return np.concatenate(found)


@installed
@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize(
    "noise",
    [{"state": 0.05}, UNEQUAL, {"slide_position": 0.05, "hinge_velocity": 0.005}],
    ids=["state", "unequal", "sensors"],
)
def test_sysid_recovers_the_truth_without_lag(noise: dict[str, float], weighted: bool) -> None:
    task = cart(noise=noise)
    exported = export(task.system, [noiseless(task)])
    fit = fit_with_sysid(exported, weighted)
    np.testing.assert_allclose(fit.theta, task.parameters.true, rtol=1e-6)
    assert fit.status.startswith("Terminated after") and fit.seconds > 0.0


@installed
def test_states_are_compared_as_sysid_does_and_sensors_without_its_lag() -> None:
    task = cart()
    exported = export(task.system, [simulate_system(task.system, task.initial, 0)])
    own = sysid.build_residual_fn(models_sequences=[exported.sequences])
    theirs = np.concatenate(own(task.parameters.guess, exported.parameters.copy())[0])
    np.testing.assert_allclose(
        residual(exported, task.parameters.guess, weighted=False), theirs, rtol=0, atol=1e-12
    )
    names = ["slide_position", "hinge_angle", "slide_velocity", "hinge_velocity"]
    task = cart(noise=dict.fromkeys(names, 0.05))
    exported = export(task.system, [noiseless(task)])
    own = sysid.build_residual_fn(models_sequences=[exported.sequences])
    theirs = np.concatenate(own(task.parameters.true, exported.parameters.copy())[0])
    assert np.abs(residual(exported, task.parameters.true, weighted=False)).max() < 1e-10
    assert np.abs(theirs).max() > 1e-3  # the lag: without noise, at the true values


def coarse(folder: Path) -> tuple[DesignTask, Recording]:
    """Two engine steps per sample; velocities are measured at every second sample."""
    noise = {**UNEQUAL, "qvel:slide": {"sigma": 0.005, "rate": 25.0}}
    values = Experiment.from_file(CART).model_dump(exclude_unset=True) | {
        "rate": 50.0,
        "measure_rate": 50.0,
        "noise": noise,
    }
    values["initial"]["control"] = {
        "kind": "chirp",
        "amplitude": 2.0,
        "frequency": 0.3,
        "frequency_end": 1.0,
    }
    task = DesignTask.resolve(Experiment(**values, directory=CART.parent))
    return task, simulate_system(task.system, task.initial, 1)


def whole(folder: Path) -> tuple[DesignTask, Recording]:
    """Free and ball joints by their states, some components of them only, and sensors."""
    noise = {"qpos:float": 0.01, "qvel:ball.rx": 0.02, "gyro": 0.02, "tip": 0.01}
    task = body_task(folder, noise=noise)
    return task, simulate_system(task.system, task.initial, 1)


def activated(folder: Path) -> tuple[DesignTask, Recording]:
    """An actuator with a state."""
    task = filtered_task(folder)
    return task, simulate_system(task.system, task.initial, 1)


def model(name: str) -> Callable[[Path], tuple[DesignTask, Recording]]:
    """One of the models: inertias in charts, servo gains, a tendon, a loop."""

    def build(folder: Path) -> tuple[DesignTask, Recording]:
        task = DesignTask.resolve(Experiment.from_file(ROOT / "models" / f"{name}.toml"))
        return task, simulate_system(task.system, task.initial, 1)

    return build


MODELS = ("ball_pendulum", "servo_arm", "four_bar", "muscle_arm")
CASES = {
    "coarse": coarse,
    "whole": whole,
    "activated": activated,
    **{name: model(name) for name in MODELS},
}


@installed
@pytest.mark.parametrize("case", CASES)
def test_sysid_gets_the_same_model_data_and_weights(case: str, tmp_path: Path) -> None:
    """Whitened residuals and the compiled MjSpec agree at parameters near the guess."""
    task, recording = CASES[case](tmp_path)
    exported, p = export(task.system, [recording]), task.parameters
    theta = np.clip(p.guess + 0.02 * p.magnitude * np.cos(np.arange(len(p))), p.lower, p.upper)
    moved = exported.parameters.copy()
    moved.update_from_vector(theta)
    before = exported.sequences.spec.to_xml()
    built = build(moved, exported.sequences.spec)
    assert same_dynamics(built, task.system.model_at(theta))
    assert exported.sequences.spec.to_xml() == before
    fit = FitProblem.of(task.system, [recording])
    wanted = dense_residuals(fit, fit.begin(theta))
    assert wanted is not None
    mine = residual(exported, theta, weighted=True)
    np.testing.assert_allclose(np.sum(mine**2), np.sum(wanted.r**2), rtol=1e-6)
    data = fit.value_count  # priors follow the data
    np.testing.assert_allclose(np.sum(mine[:data] ** 2), chi2(exported, theta), rtol=1e-12)
    np.testing.assert_allclose(
        np.sort(np.abs(mine[:data])), np.sort(np.abs(wanted.r[:data])), rtol=1e-6, atol=1e-6
    )


@installed
def test_times_off_the_grid_are_read_between_the_steps() -> None:
    task = cart()
    fine, rng = noiseless(task), np.random.default_rng(4)
    rows = np.sort(rng.choice(np.arange(1, 400), 300, replace=False))
    t = fine.t[rows] + rng.uniform(-2e-3, 2e-3, 300)
    t[0] = 0.0
    y = np.column_stack([np.interp(t, fine.t, column) for column in fine.y.T])
    recording = Recording(t=t, ctrl=fine.ctrl[rows[:-1]], y=y, outputs=fine.outputs)
    exported, fit = export(task.system, [recording]), FitProblem.of(task.system, [recording])
    wanted = dense_residuals(fit, fit.begin(task.parameters.true))
    assert wanted is not None
    mine = residual(exported, task.parameters.true, weighted=True)
    np.testing.assert_allclose(mine, -wanted.r, atol=1e-3)


@installed
def test_the_report_draws_components_and_outputs_of_a_low_rate(tmp_path: Path) -> None:
    """The report of sysid indexes signals although it draws their components."""
    task, recording = whole(tmp_path)
    exported = export(task.system, [recording])
    assert "tip[2]" in report(exported, fit_with_sysid(exported, weighted=True))
    assert set(exported.layout.mapping) == {"hull_qpos", "ball_qvel", "gyro", "tip"}
    task, recording = coarse(tmp_path)
    exported = export(task.system, [recording])
    _, _, records = exported.residual(weighted=True)(
        task.parameters.guess, exported.parameters, return_pred_all=True
    )
    assert list(records[0][0].signal_mapping) == [
        "slide_qpos",
        "hinge_qpos",
        "slide_qvel",
        "hinge_qvel",
    ]
    known, drawn = recording.y[1:, 2], records[0][0].data[:, 2]
    assert np.isnan(known).any() and np.isfinite(drawn).all()
    np.testing.assert_array_equal(drawn[np.isfinite(known)], known[np.isfinite(known)])


# Lines of progress of mjfim's own fit, and of work that is silent for a while.
PROGRESS = re.compile(r"all data: iteration \d+, cost \S+, step \S+ σ|.* \(\d+ s\)")


@installed
def test_the_command_compares_both_and_writes_the_report(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """With unequal noise the weighted fit agrees with mjfim; the unweighted one does not."""
    task = cart(noise=UNEQUAL)
    text = CART.read_text(encoding="utf-8").replace(
        "state = 0.05", "\n".join(f'"{k}" = {v}' for k, v in UNEQUAL.items())
    )
    text = re.sub(
        r'"(cart_pendulum\.\w+)"', lambda match: f'"{(CART.parent / match[1]).as_posix()}"', text
    )
    experiment = tmp_path / "experiment.toml"
    experiment.write_text(text, encoding="utf-8")
    files = [tmp_path / f"recording_{seed}.csv" for seed in (0, 1)]
    for seed, path in enumerate(files):
        write_recording(path, simulate_system(task.system, task.initial, seed), task.system)
    shown = run("export-sysid", experiment, *files, "-o", tmp_path / "out")
    assert shown.exit_code == 0, shown.stderr
    told = [line for line in shown.stderr.splitlines() if not PROGRESS.fullmatch(line)]
    assert not told and capfd.readouterr() == ("", ""), "messages of sysid"
    assert "Estimates from these recordings" in shown.stdout and "iter:" not in shown.stdout
    found = json.loads((tmp_path / "out" / "comparison.json").read_text(encoding="utf-8"))
    assert (
        found["parameters"] == ["m", "l", "c"]
        and found["true"] == [2.0, 1.0, 1.0]
        and found["start"] == [2.5, 1.4, 1.4]
    )
    assert found["recordings"] == [str(path) for path in files]
    std = np.array(found["mjfim"]["std"])
    off = {
        key: (np.array(found[key]["theta"]) - found["mjfim"]["theta"]) / std
        for key in ("sysid_weighted", "sysid_default")
    }
    assert np.abs(off["sysid_weighted"]).max() < 1e-3
    assert np.abs(off["sysid_default"]).max() > 0.5
    assert found["sysid_weighted"]["chi2"] == pytest.approx(found["mjfim"]["chi2"], rel=1e-6)
    assert found["sysid_default"]["chi2"] > found["mjfim"]["chi2"]
    html = (tmp_path / "out" / "sysid_report.html").read_text(encoding="utf-8")
    assert "Parameter Distribution" in html and "recording_1.csv" in html and "hinge_qvel" in html


@installed
@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"nuisance": {"initial": 0.1}}, "numbers of the model only"),
        ({"nuisance": {"delay": 0.01}}, "delay: sysid fits"),
        ({"fit": {"segments": 1.0}}, "stated initial state only"),
    ],
)
def test_what_sysid_cannot_fit_is_refused(tables: dict[str, Any], said: str) -> None:
    task = DesignTask.resolve(Experiment.from_file(CART).replace(**tables))
    with pytest.raises(ExperimentError, match=said):
        export(task.system, [noiseless(task)])


@installed
def test_misuse_ends_with_a_sentence(tmp_path: Path) -> None:
    misused(run("export-sysid", CART, tmp_path / "none.csv", "-o", tmp_path / "out"), "none.csv")
    assert not (tmp_path / "out").exists()


def test_without_the_extra_it_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(sysid, "ModelSequences", raising=False)
    (tmp_path / "recording.csv").touch()
    words = (CART, tmp_path / "recording.csv", "-o", tmp_path / "out")
    misused(run("export-sysid", *words), "pip install 'mjfim[sysid]'")
    assert not (tmp_path / "out").exists()
