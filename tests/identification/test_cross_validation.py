"""Predictions of data that were not fitted, single recordings, and remarks about poor data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import identify_system
from mjfim.recordings.checks import plausibility_remarks
from mjfim.records.trajectory import Recording
from tests.support import terms
from tests.support.cart_pendulum import cart_pendulum
from tests.support.dense_residuals import dense_residuals
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def base() -> mjfim.Experiment:
    return cart_pendulum(fit={"bootstrap": 0, "segments": "whole"})


@pytest.fixture(scope="module")
def short(base: mjfim.Experiment) -> mjfim.Experiment:
    """The experiment for two seconds, where a fit tries much because it does not succeed."""
    return base.replace(horizon=2.0)


def recorded(task: DesignTask, seed: int, swing: float = 1.0) -> Recording:
    """One recording at the true parameters."""
    trajectory = task.plant.simulate(task.theta, swing * task.control)
    return simulate_system(task.system, trajectory, seed)


@pytest.mark.slow
def test_held_out_errors_are_the_noise_and_the_nominal_ones_are_not(base: mjfim.Experiment) -> None:
    task = DesignTask.resolve(base)
    other = recorded(task, 1, 1.5)
    found = identify_system(task.system, [recorded(task, 0)], held_out=[other])
    (prediction,) = found.predictions
    assert prediction.held_out
    assert_allclose(prediction.identified.rms, 0.05, rtol=0.12)
    assert (prediction.nominal.rms > 1.5 * prediction.identified.rms).any()
    assert prediction.ratio < 0.8
    (alone,) = mjfim.predict(task.experiment, found.theta, [other])
    assert_allclose(alone.rms, prediction.identified.rms, rtol=1e-9)
    assert (alone.mae < alone.rms).all()

    # The outputs are those of which the errors are told; the first row begins the simulation.
    errors = prediction.identified_outputs - prediction.recording.y
    rms = np.sqrt(np.nanmean(errors[1:] ** 2, axis=0))
    assert_allclose(rms, prediction.identified.rms, rtol=1e-9)


@pytest.mark.slow
def test_a_single_recording_predicts_its_end(base: mjfim.Experiment) -> None:
    task = DesignTask.resolve(base)
    recording = recorded(task, 0)
    late = np.array(recording.y)
    late[320:] += 1.0
    (prediction,) = identify_system(task.system, [replace(recording, y=late)]).predictions
    assert prediction.name.startswith("last 25 %")
    assert_allclose(
        prediction.identified.rms[0], np.sqrt(0.8 + 0.05**2), rtol=0.1
    )  # 80 of 100 rows


@pytest.mark.slow
def test_every_recording_has_a_separate_bias(short: mjfim.Experiment) -> None:
    one = short.replace(nuisance={"bias": {"qpos:hinge": True}})
    task = DesignTask.resolve(one.replace(nuisance={"per_recording": True}))
    plain = DesignTask.resolve(short)
    biases = (0.1, -0.2, 0.0)
    recordings = []
    for seed, bias in enumerate(biases):
        clean = recorded(plain, seed)
        shift = bias * (np.array(clean.outputs) == "qpos:hinge")
        recordings.append(replace(clean, y=clean.y + shift, name=f"log {seed}"))
    found = identify_system(task.system, recordings)
    assert_allclose(found.per_recording["bias qpos:hinge"], biases, atol=0.02)
    assert found.parameters[3] == "bias qpos:hinge"
    assert np.all(np.abs(found.theta[:3] - task.parameters.true[:3]) < 4.0 * found.std[:3])
    assert not found.misfit
    assert mjfim.identify(one, recordings).misfit

    # The unknowns are m, l, c and the first recording's bias, and those of the others.
    fit = FitProblem.of(task.system, recordings)
    J = dense_residuals(fit, fit.begin(found.theta)).J
    covariance = np.linalg.inv(J.T @ J)
    assert_allclose(found.std, np.sqrt(np.diag(covariance))[:4], rtol=0.02)


def test_per_recording_belongs_to_nuisance(base: mjfim.Experiment) -> None:
    with pytest.raises(mjfim.MjfimError, match="nuisance = true"):
        base.replace(parameters={"m": {"per_recording": True}})


def test_a_quick_motion_of_a_drone_is_not_taken_for_noise() -> None:
    """Rotors that switch every third row shake the drone; only a model tells this from noise."""
    stated = mjfim.Experiment.from_file(ROOT / "models" / "quadrotor.toml")
    system = System.resolve(stated.replace(noise={"state": 1e-3}))
    roll = np.where((np.arange(120) // 3) % 2 == 0, 1.0, -1.0)
    ctrl = 0.4905 + 0.05 * roll[:, None] * np.array([1.0, -1.0, 1.0, -1.0])
    flight = terms.recorded(system, ctrl)
    exact = terms.recorded(system, ctrl, share=0.0).y

    def remarks(recording: Recording, predicted: np.ndarray | None) -> str:
        """Remarks about rough outputs."""
        found = plausibility_remarks(system.channels, recording, predicted)
        return "; ".join(each for each in found if "is rough" in each)

    assert "qvel:base.rx is rough" in remarks(flight, None)
    assert not remarks(flight, exact)

    # A control that jumps from row to row is named.
    jumping = replace(flight, ctrl=np.random.default_rng(0).normal(size=ctrl.shape))
    found = " ".join(plausibility_remarks(system.channels, jumping, exact))
    assert "jumps from row to row" in found

    # Spikes are found beside the same motion, in any unit of the output.
    i = flight.outputs.index("qvel:base.rx")
    y = np.array(flight.y)
    y[::20, i] += 5.0 * np.nanstd(y[:, i])
    found = remarks(replace(flight, y=y), exact)
    assert found.startswith("qvel:base.rx is rough") and found.count("is rough") == 1
    assert "not explained by the identified motion" in found
