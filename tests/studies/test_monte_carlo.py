"""The Monte-Carlo study, compared with theory and with separate estimates of all trials."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less

import mjfim
from mjfim.errors import ExperimentError, MjfimError, UnidentifiableError
from mjfim.excitation.task import DesignTask
from mjfim.identification.identify import identify
from mjfim.parallel.budget import StopToken
from mjfim.records.events import StudyEvent
from mjfim.records.trajectory import Recording, Trajectory
from mjfim.studies.monte_carlo import _statistics, monte_carlo
from tests.support.cart_pendulum import cart_pendulum

# Table III of the paper, diagonal, initial trajectory, 25 Hz
PAPER_BOUND = np.array([1.04e-3, 2.26e-3, 4.57e-2])


EXPERIMENT = cart_pendulum()


@pytest.fixture(scope="module")
def design() -> mjfim.Design:
    return mjfim.design(EXPERIMENT)


# The experiment over one second.
SHORT = EXPERIMENT.replace(horizon=1.0)


@pytest.fixture(scope="module")
def motion() -> Trajectory:
    """The initial trajectory of the short experiment."""
    return DesignTask.resolve(SHORT).initial


@pytest.mark.slow
def test_study_of_the_paper_at_25_hz(design: mjfim.Design) -> None:
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    study = monte_carlo(EXPERIMENT, curves, trials=60, seed=0, measure_rate=25.0)
    for s in study.sets.values():
        assert (s.failed, s.trials) == (0, 60)
        # Two standard deviations of a variance of 60 values, sqrt(2 / 60).
        assert_allclose(np.diag(s.covariance) / np.diag(s.crlb), 1.0, atol=0.37)
        low, high = s.efficiency_interval.T
        assert ((low < s.efficiency) & (s.efficiency < high)).all()
    assert_allclose(np.diag(study.sets["initial"].covariance), PAPER_BOUND, rtol=0.42)
    assert_allclose(study.information["initial"][0, 0], 961, rtol=0.01)


def test_the_seed_determines_the_result(motion: Trajectory) -> None:
    runs = [
        monte_carlo(SHORT, motion, trials=3, seed=seed).sets["final"].estimates
        for seed in (1, 1, 2)
    ]
    assert_array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


def test_interval_of_the_efficiency_has_the_stated_coverage() -> None:
    rng, bound = np.random.default_rng(1), np.eye(1)
    hits = 0
    for _ in range(400):
        low, high = _statistics(rng.standard_normal((50, 1)), bound, 0.0).efficiency_interval[0]
        hits += low <= 1.0 <= high
    assert abs(hits / 400 - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 400)

    # An estimator that scatters more is not efficient.
    wasteful = _statistics(1.2 * rng.standard_normal((4000, 1)), bound, 0.0)
    assert wasteful.efficiency_interval[0, 1] < 1.0


def test_failed_trials_are_counted_not_averaged() -> None:
    estimates = np.random.default_rng(2).standard_normal((100, 2))
    without = _statistics(estimates[1:], np.eye(2), 0.0)
    estimates[0] = np.nan
    s = _statistics(estimates, np.eye(2), 0.0)
    assert (s.failed, s.trials) == (1, 100)
    assert_allclose(s.covariance, without.covariance)


PAIR = ((0.05**2, 0.8 * 0.05**2), (0.8 * 0.05**2, 0.05**2))
VARIED = {
    "noise": {
        "qpos:hinge": {"sigma": 0.02, "rate": 25.0},
        "hinge_velocity": {"sigma": 0.1, "rate": 50.0},
    },
    "correlated": ({"outputs": ("qpos:slide", "qvel:hinge"), "covariance": PAIR},),
}


@pytest.mark.slow
def test_trials_with_correlated_noise_rates_and_nuisance_are_least_squares_estimates(
    design: mjfim.Design,
) -> None:
    nuisance = {"bias": {"qpos:slide": 0.05}, "delay": 0.01}
    task = DesignTask.resolve(EXPERIMENT.replace(**VARIED, nuisance=nuisance))
    ctrl, noise = design.trajectory.ctrl, task.system.noise
    found = monte_carlo(task.experiment, design.trajectory, trials=6, seed=5).sets["final"]
    exact, _ = task.plant.measure(task.parameters.true[None], ctrl)
    mask = noise.measured(400) > 0
    white = np.random.default_rng(5).spawn(1)[0].standard_normal((6, mask.sum()))
    std = np.sqrt(np.diag(found.crlb))
    free = EXPERIMENT.replace(**VARIED, nuisance={"bias": {"qpos:slide": True}, "delay": True})
    for i in range(3):
        z = np.zeros(mask.shape)
        z[mask] = white[i]
        y = np.where(mask, exact[0] + z @ noise.factor.T, np.nan)
        log = Recording(t=np.arange(401) * 0.01, ctrl=ctrl, y=y, outputs=task.system.outputs.names)
        alone = identify(free, [log])
        assert_array_less(np.abs(found.estimates[i] - alone.theta), 0.01 * std)
        assert_allclose(alone.std, std, rtol=0.2)


@pytest.mark.parametrize(
    ("parameters", "trials", "error", "said"),
    [
        ({}, 1, ExperimentError, "at least 2"),
        (
            {"blind": {"target": "body/cart:inertia[0]", "guess": 0.01, "prior": 1e-4}},
            4,
            UnidentifiableError,
            "blind: no effect",
        ),
    ],
)
def test_faults_are_named(
    parameters: dict[str, Any],
    trials: int,
    error: type[MjfimError],
    said: str,
    motion: Trajectory,
) -> None:
    """Too few trials, and a parameter that only its prior determines."""
    with pytest.raises(error, match=said):
        monte_carlo(SHORT.replace(parameters=parameters), motion, trials=trials)


def test_priors_do_not_enter_the_study(motion: Trajectory) -> None:
    sure = SHORT.replace(parameters={"m": {"prior": 1e-6}})
    plain, prior = (monte_carlo(e, motion, trials=3, seed=1) for e in (SHORT, sure))
    (found, expected) = (study.sets["final"] for study in (prior, plain))
    assert_allclose(found.estimates, expected.estimates, rtol=1e-9)
    assert_allclose(np.linalg.inv(prior.information["final"]), found.crlb)


def test_a_request_to_stop_keeps_the_finished_sets(motion: Trajectory) -> None:
    curves = {"initial": motion, "final": motion}
    token = StopToken()
    events = []

    def stop_after_the_first_set(event: StudyEvent) -> None:
        events.append((event.part, event.index, event.count, event.share))
        token.request()

    study = monte_carlo(SHORT, curves, trials=6, callback=stop_after_the_first_set, stop=token)
    assert set(study.sets) == {"initial"}
    assert events == [("initial", 0, 2, 1.0)]
