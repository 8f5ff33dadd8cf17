"""Tasks of identifications: a model, parameters, noise and recordings are enough."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.paths import MODELS
from tests.support.terms import recorded

MINIMAL: dict[str, Any] = {
    "rate": 100.0,
    "parameters": {
        "m": {"target": "body/bob:mass", "guess": 2.5, "true": 2.0, "bounds": [0.1, 10.0]},
        "c": {"target": "joint/hinge:damping", "guess": 1.4, "true": 1.0, "bounds": [0.0, 10.0]},
    },
    "noise": {"state": 0.05},
}


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """An experiment without horizon, initial state, control, cost or settings of a design."""
    return mjfim.Experiment(model=str(MODELS / "cart_pendulum.xml"), **MINIMAL)


@pytest.fixture(scope="module")
def recording(experiment: mjfim.Experiment) -> Recording:
    """A noisy recording at the true parameters."""
    system = System.resolve(experiment)
    ctrl = 10.0 * np.sin(2.0 * np.pi * 0.7 * np.arange(300) * system.dt)[:, None]
    return dataclasses.replace(recorded(system, ctrl, 0), name="log")


def test_a_minimal_experiment_identifies_its_parameters(
    experiment: mjfim.Experiment, recording: Recording
) -> None:
    estimate = mjfim.identify(experiment, [recording], threads=1)
    assert estimate.converged and not estimate.misfit
    assert (np.abs(estimate.theta - [2.0, 1.0]) < 4.0 * estimate.std).all()

    (errors,) = mjfim.predict(experiment, estimate.theta, [recording], threads=1)
    assert_allclose(errors.rms, 0.05, rtol=0.2)


def test_a_design_of_a_minimal_experiment_says_what_is_missing(
    experiment: mjfim.Experiment,
) -> None:
    with pytest.raises(ExperimentError, match="design needs `horizon`"):
        mjfim.design(experiment)
    with pytest.raises(ExperimentError, match="check without recordings needs `horizon`"):
        mjfim.check(experiment)


def test_the_start_is_moved_inside_the_bounds_of_a_bounded_method(
    experiment: mjfim.Experiment, recording: Recording
) -> None:
    start = np.array([50.0, -1.0])
    bounded = FitTask.of(System.resolve(experiment), [recording], start=start)
    assert_array_equal(bounded.start, [10.0, 0.0])
    unbounded = FitTask.of(System.resolve(experiment), [recording], start=start, method="newton")
    assert_array_equal(unbounded.start, start)


def test_recordings_that_count_twice_are_refused(
    experiment: mjfim.Experiment, recording: Recording
) -> None:
    """The same data twice, or fitted and predicted."""
    with pytest.raises(RecordingError, match="log is given twice: it would count twice"):
        mjfim.identify(experiment, [recording, recording])
    with pytest.raises(RecordingError, match="log is given twice: a fitted recording"):
        mjfim.identify(experiment, [recording], held_out=[recording])
    with pytest.raises(RecordingError, match="log is given twice"):
        mjfim.check(experiment, recordings=[recording, recording])


@pytest.mark.parametrize(("name", "row"), [("ctrl:force", 57), ("qvel:slide", 301)])
def test_one_extreme_value_is_named_where_the_simulation_diverges(
    experiment: mjfim.Experiment, recording: Recording, name: str, row: int
) -> None:
    """A fault of the log is the likely cause, so the message says where it is."""
    ctrl, y = recording.ctrl.copy(), recording.y.copy()
    if name.startswith("ctrl"):
        ctrl[row - 1, 0] = 1e200
    else:
        y[row - 1, recording.outputs.index(name)] = 1e200
    faulty = dataclasses.replace(recording, ctrl=ctrl, y=y)

    message = rf"diverges at the start .*; log: column '{name}' holds 1e\+200 in row {row} of"
    with pytest.raises(SimulationDivergedError, match=message):
        mjfim.identify(experiment, [faulty], threads=1)


def log_of_another_rate(
    folder: Path, timestep: float, t: Array
) -> tuple[mjfim.Experiment, Recording]:
    """A cart-pendulum at 100 Hz and a log of it, whose control jumps at the times t: (M,) [s].

    The log is a simulation in plain MuJoCo, whose steps end at the rows of the log.
    """
    model = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    model = model.replace('timestep="0.01"', f'timestep="{timestep}"')
    (folder / "other.xml").write_text(model, encoding="utf-8")
    experiment = mjfim.Experiment(
        model=str(folder / "other.xml"), **{**MINIMAL, "noise": {"state": 0.001}}
    )
    system, rng = System.resolve(experiment, threads=1), np.random.default_rng(1)

    truth = system.model_at(system.parameters.true)
    data = mujoco.MjData(truth)
    data.qpos[:] = system.space.split(system.nominal_initial_state)[0]
    ctrl = 10.0 * rng.standard_normal((len(t) - 1, 1))
    y = [np.append(data.qpos, data.qvel)]
    for u, period in zip(ctrl, np.diff(t), strict=True):
        steps = int(np.ceil(period / timestep - 1e-6))
        truth.opt.timestep = period / steps
        data.ctrl[:] = u
        mujoco.mj_step(truth, data, steps)
        y.append(np.append(data.qpos, data.qvel))

    noisy = np.array(y) + 0.001 * rng.standard_normal((len(t), 4))
    return experiment, Recording(t=t, ctrl=ctrl, y=noisy, outputs=system.outputs.names, name="log")


@pytest.mark.slow
@pytest.mark.parametrize("rate", [125, "irregular", "inside steps"])
def test_a_log_of_any_rate_is_fitted_where_engine_steps_end_at_its_rows(
    rate: int | str, tmp_path: Path
) -> None:
    """Controls jump between the samples at 100 Hz, and act there.

    Held as a mean over each sample they gave a misfit, with the warning to state the rate. Jumps
    inside engine steps are a misfit with this remedy.
    """
    count = 200 if rate == "irregular" else 125
    t = np.arange(count + 1) / count
    if rate == "irregular":
        t[1:-1] += np.random.default_rng(2).choice([-0.0015, 0.0, 0.0005], count - 1)

    is_inside = rate == "inside steps"
    experiment, log = log_of_another_rate(tmp_path, 0.01 if is_inside else 0.0005, t)
    estimate = mjfim.identify(experiment, [log], threads=1)
    assert estimate.misfit == is_inside
    if is_inside:
        (cause,) = [w for w in estimate.warnings if 'timestep="0.008", and rate = 125' in w]
        assert "lie inside the engine steps of the model (0.01 s)" in cause
    else:
        assert abs(estimate.chi2 / estimate.dof - 1.0) < 5.0 * np.sqrt(2.0 / estimate.dof)
        assert (np.abs(estimate.theta - [2.0, 1.0]) < 4.0 * estimate.std).all()
