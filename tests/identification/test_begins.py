"""Recordings that do not begin at the stated initial state: found, said, and fitted well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import MODELS

CLEAN = ("cart_pendulum", "quadrotor", "servo_arm", "four_bar")


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum, which hangs at rest at first."""
    return cart_pendulum()


def swung(experiment: mjfim.Experiment, seed: int = 1) -> Recording:
    """Six seconds of the motion of the paper."""
    t = 0.01 * np.arange(600)
    return mjfim.simulate(experiment, ((1.0 + t / 4.0) * np.sin(2.0 * t))[:, None], seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "said", "widest"),
    [("late", "slide +0.2 m/s", 0.05), ("elsewhere", "hinge +", 0.01)],
)
def test_a_log_that_begins_elsewhere_is_fitted_and_said(
    experiment: mjfim.Experiment, kind: str, said: str, widest: float
) -> None:
    """The intervals are nearly those of a log that begins as stated, and hold the true values."""
    if kind == "late":
        log = swung(experiment)
        log = replace(log, t=log.t[100:] - log.t[100], ctrl=log.ctrl[100:], y=log.y[100:])
    else:
        aside = {"keyframe": None, "qpos": [0.0, np.pi + 1.0]}
        initial = experiment.initial.model_copy(update=aside)
        log = swung(experiment.model_copy(update={"initial": initial}))
    estimate = mjfim.identify(experiment, [log], progress=False)
    assert not estimate.misfit and estimate.success
    assert any("does not begin where [initial] says" in each for each in estimate.warnings)
    assert any(said in each for each in estimate.warnings)
    low, high = estimate.interval.T
    true = np.array([2.0, 1.0, 1.0])
    assert np.all((low < true) & (true < high))
    assert 0.5 * (high[0] - low[0]) < widest * true[0]


def test_more_noise_than_stated_is_no_other_begin(experiment: mjfim.Experiment) -> None:
    """The scatter of the first rows counts where it is larger than the stated noise."""
    system, rng = System.resolve(experiment, threads=1), np.random.default_rng(0)
    log = swung(experiment)
    for _ in range(20):
        noisy = replace(log, y=log.y + 0.15 * rng.standard_normal(log.y.shape))
        assert not FitTask.of(system, [noisy]).elsewhere


@pytest.mark.parametrize("name", CLEAN)
def test_no_other_begin_is_seen_in_clean_logs(name: str) -> None:
    """Ten logs of each model begin as stated, under a random control."""
    stated = mjfim.Experiment.from_file(MODELS / f"{name}.toml")
    system, rng = System.resolve(stated, threads=1), np.random.default_rng(1)
    for seed in range(10):
        control = 0.1 * np.cumsum(rng.standard_normal((40, len(system.inputs))), axis=0)
        log = mjfim.simulate(stated, control, seed)
        assert not FitTask.of(system, [log]).elsewhere
