"""The fit in the types of mujoco.sysid: with equal models, data and weights both find the same."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mujoco import sysid
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError, MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import simulate_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.model.given import same_dynamics
from mjfim.output.export.sysid import SysidProblem, silenced, sysid_problem
from mjfim.records.trajectory import Recording
from tests.support.dense_residuals import dense_residuals
from tests.support.numerics import Array, body_task
from tests.support.paths import ROOT

CART = ROOT / "models" / "cart_pendulum.toml"
UNEQUAL = {"qpos:slide": 0.05, "qpos:hinge": 0.05, "qvel:slide": 0.005, "qvel:hinge": 0.005}
installed = pytest.mark.skipif(
    not hasattr(sysid, "ModelSequences"), reason="needs mujoco.sysid: pip install 'mjfim[sysid]'"
)


def cart(**tables: Any) -> DesignTask:
    """The cart-pendulum of the models, with some tables of its experiment replaced."""
    return DesignTask.resolve(Experiment.from_file(CART).model_copy(update=tables))


def residual(problem: SysidProblem, theta: Array) -> Array:
    """All residuals in one row."""
    with silenced():
        return np.concatenate(problem.residual(theta, problem.parameters.copy())[0])


@installed
def test_it_finds_the_estimate_of_mjfim() -> None:
    experiment = Experiment.from_file(CART).model_copy(update={"noise": UNEQUAL})
    task = DesignTask.resolve(experiment)
    recordings = [simulate_system(task.system, task.initial, seed) for seed in (0, 1)]
    problem = mjfim.export_sysid(experiment, recordings)
    with silenced():
        fit, _ = sysid.optimize(problem.parameters, problem.residual, verbose=False)
    estimate = mjfim.identify(experiment, recordings)
    assert np.abs((fit.as_vector() - estimate.theta) / estimate.std).max() < 1e-3


def coarse(folder: Path) -> tuple[DesignTask, Recording]:
    """Two engine steps per sample; velocities are measured at every second sample."""
    noise = {**UNEQUAL, "qvel:slide": {"sigma": 0.005, "rate": 25.0}}
    chirp = {"kind": "chirp", "amplitude": 2.0, "frequency": 0.3, "frequency_end": 1.0}
    tables = {"rate": 50.0, "measure_rate": 50.0, "initial": {"control": chirp}}
    experiment = Experiment.from_file(CART).replace(**tables).model_copy(update={"noise": noise})
    task = DesignTask.resolve(experiment)
    return task, simulate_system(task.system, task.initial, 1)


def whole(folder: Path) -> tuple[DesignTask, Recording]:
    """Free and ball joints by their states, some components of them only, and sensors."""
    noise = {"qpos:float": 0.01, "qvel:ball.rx": 0.02, "gyro": 0.02, "tip": 0.01}
    task = body_task(folder, noise=noise)
    return task, simulate_system(task.system, task.initial, 1)


def model(name: str) -> Callable[[Path], tuple[DesignTask, Recording]]:
    """One of the models: inertias in charts, servo gains, a tendon, a loop, an actuator's state."""

    def build(folder: Path) -> tuple[DesignTask, Recording]:
        task = DesignTask.resolve(Experiment.from_file(ROOT / "models" / f"{name}.toml"))
        return task, simulate_system(task.system, task.initial, 1)

    return build


MODELS = ("ball_pendulum", "servo_arm", "four_bar", "muscle_arm")
CASES = {
    "coarse": coarse,
    "whole": whole,
    **{name: model(name) for name in MODELS},
}


@installed
@pytest.mark.parametrize("case", CASES)
def test_sysid_gets_the_same_model_data_and_weights(case: str, tmp_path: Path) -> None:
    """Whitened residuals and the models agree at parameters near the guess."""
    task, recording = CASES[case](tmp_path)
    problem, p = sysid_problem(task.system, [recording]), task.parameters
    theta = np.clip(p.guess + 0.02 * p.magnitude * np.cos(np.arange(len(p))), p.lower, p.upper)
    moved = problem.parameters.copy()
    moved.update_from_vector(theta)
    built = problem.build_model(moved, problem.sequences.spec)
    assert same_dynamics(built, task.system.model_at(theta))
    fit = FitProblem.of(task.system, [recording])
    wanted = dense_residuals(fit, fit.begin(theta))
    mine = np.sort(np.abs(residual(problem, theta)))
    theirs = np.sort(np.abs(wanted.r[: fit.value_count]))  # priors follow the data
    assert_allclose(mine, theirs, rtol=1e-6, atol=1e-6)


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
        sysid_problem(task.system, [simulate_system(task.system, task.initial, 1)])


def test_without_the_extra_it_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(sysid, "ModelSequences", raising=False)
    with pytest.raises(MjfimError, match=r"pip install 'mjfim\[sysid\]'"):
        mjfim.export_sysid(Experiment.from_file(CART), [])
