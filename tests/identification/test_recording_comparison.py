"""Comparison of recordings against separate fits, and its rates of false and true alarms."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.identification.assessment.recording_comparison import compare_evidence
from mjfim.identification.assessment.robust_covariance import (
    block_length,
    independent_blocks,
    recording_evidence,
)
from mjfim.records.robots import RecordingComparison
from mjfim.records.trajectory import Recording
from tests.identification.test_robust_covariance import FINE, Linear, noise, waves
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.numerics import Array


def compared(model: Linear, y: Array, length: float = 1.0) -> RecordingComparison:
    """Compare the recordings y: (K, N) of a linear model."""
    theta, condensed = model.fitted(y)
    recording = condensed.segment_of_block
    rows = np.full(len(recording), float(FINE))
    blocks = independent_blocks(condensed, recording, rows, length)
    own = np.zeros((len(y), 0), dtype=int)
    evidence = recording_evidence(condensed, blocks, recording, own)
    return compare_evidence(
        theta,
        evidence,
        recordings=[f"run_{k + 1}.csv" for k in range(len(y))],
        parameters=[f"p{j}" for j in range(len(theta))],
        units=["kg"] * len(theta),
        is_single=np.ones(len(theta), dtype=bool),
    )


def simulated(seed: int, K: int, truth: tuple[float, ...], N: int = 400) -> tuple[Array, Array]:
    """Regressors of K recordings, and measured values with white noise."""
    X = waves(K, N, len(truth))
    return X, X @ np.array(truth) + noise(0.0, (K, N), np.random.default_rng(seed))


@pytest.mark.parametrize("with_offsets", [False, True])
def test_values_are_those_of_separate_fits(with_offsets: bool) -> None:
    K, N, c = 4, 160, 3
    X, y = simulated(0, K, (1.0, -2.0, 0.5), N)
    model = Linear(X=X, with_offsets=with_offsets)
    y[1] += 1.0 * X[1, :, 0]
    found = compared(model, y)
    for k in range(K):
        columns = [X[k], np.ones((N, 1))] if with_offsets else [X[k]]
        J = np.concatenate(columns, axis=1)
        alone = np.linalg.lstsq(J, y[k])[0][:c]
        np.testing.assert_allclose(found.values[k], alone, rtol=1e-8)

        # The deviations are the formal ones, a little larger where blocks happen to scatter more.
        formal = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:c]
        assert (found.std[k] >= 0.999 * formal).all()
        assert (found.std[k] <= 1.5 * formal).all()


def test_an_odd_recording_is_named_with_its_parameter() -> None:
    X, y = simulated(1, 5, (1.0, -2.0, 0.5))
    y[2] += 1.0 * X[2, :, 0]
    found = compared(Linear(X=X), y)
    (odd,) = found.odd
    assert (odd.index, odd.name) == (2, "run_3.csv")
    (parameter,) = odd.parameters
    assert parameter.name == "p0"
    assert parameter.p <= odd.p * (1.0 + 1e-9) < 1e-3
    assert parameter.value - parameter.others == pytest.approx(1.0, abs=0.3)
    assert "run_3.csv is odd: its p0 is" in str(odd) and "% above that of the others" in str(odd)
    assert found.apart == (0,)
    assert found.tau[0] > 0.2 and (found.tau[1:] < 0.1).all()
    assert found.prediction[0, 0] < found.interval[0, 0] < found.interval[0, 1]
    assert found.order[0] == 0
    assert found.joint_p < 1e-6


def test_two_odd_recordings_of_seven() -> None:
    X, y = simulated(2, 7, (1.0, -2.0))
    y[1] -= 2.0 * X[1, :, 1]
    y[5] += 1.0 * X[5, :, 0]
    found = compared(Linear(X=X), y)
    assert [odd.name for odd in found.odd] == ["run_2.csv", "run_6.csv"]


def test_two_recordings_disagree_without_an_odd_one() -> None:
    X, y = simulated(3, 2, (1.0, -2.0))
    y[1] += 1.0 * X[1, :, 0]
    found = compared(Linear(X=X), y)
    assert found.odd == ()
    assert found.apart == (0,)
    assert "differ in p0" in str(found)
    assert np.isinf(found.prediction).all()


def test_recordings_that_determine_some_parameters_only() -> None:
    """Recording k does not move parameter k; the last one moves a combination alone."""
    rng = np.random.default_rng(4)
    K, N, c = 4, 400, 3
    X = waves(K, N, c)
    for k in range(3):
        X[k, :, k] = 0.0
    X[3] = X[3, :, :1] * np.array([1.0, 2.0, 0.0])
    truth = np.array([1.0, -2.0, 0.5])
    y = X @ truth + noise(0.0, (K, N), rng)
    found = compared(Linear(X=X), y)
    expected = np.zeros((K, c), dtype=bool)
    expected[[0, 1, 2], [0, 1, 2]] = True
    expected[3] = True
    expected[3, 2] = True
    np.testing.assert_array_equal(np.isnan(found.values), expected)
    np.testing.assert_array_equal(np.isinf(found.std), expected)
    assert np.isfinite(found.mean).all()
    assert "agree" in str(found)

    # The combination of the last recording contradicts the others, though none of its parameters
    # is determined by it alone.
    y[3] += 1.0 * X[3, :, 0]
    odd = compared(Linear(X=X), y)
    assert [each.index for each in odd.odd] == [3]
    assert odd.odd[0].parameters == ()
    assert "combinations of its parameters differ" in str(odd.odd[0])


def test_a_combination_that_no_recording_determines() -> None:
    rng = np.random.default_rng(5)
    X = waves(3, 200, 2)
    X[..., 1] = 2.0 * X[..., 0]
    y = X @ np.array([1.0, 1.0]) + noise(0.0, (3, 200), rng)
    found = compared(Linear(X=X), y)
    assert np.isnan(found.values).all() and np.isnan(found.mean).all()
    assert 0.0 < found.joint_p <= 1.0


# ---- rates


def rates(
    sets: int, *, K: int, phi: float = 0.0, c: int = 3, noisy: float = 1.0, odd: float = 0.0
) -> tuple[float, float, float]:
    """Shares of sets with an odd recording, with the right one, and with a small joint p.

    Args:
        sets: Number of simulated sets of recordings.
        K: Number of recordings.
        phi: Correlation of successive noise values.
        c: Number of parameters.
        noisy: Factor of the noise of the first recording.
        odd: Difference of the first parameter of the last recording [standard deviations].
    """
    N = 400
    rng = np.random.default_rng(0)
    X = waves(K, N, c)
    growth = (1.0 + phi) / (1.0 - phi)
    std = np.sqrt(2.0 / N * growth)
    alarms, hits, joint = 0, 0, 0
    for _ in range(sets):
        y = noise(phi, (K, N), rng)
        y[0] *= noisy
        y[-1] += odd * std * X[-1, :, 0]
        found = compared(Linear(X=X), y, block_length([growth], K * N))
        alarms += bool(found.odd)
        joint += found.joint_p < 1e-3
        hits += bool(found.odd) and found.odd[0].index == K - 1
    return alarms / sets, hits / sets, joint / sets


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [{"K": 4}, {"K": 3, "phi": 0.9}, {"K": 5, "phi": 0.9, "c": 10}, {"K": 5, "noisy": 5.0}],
)
def test_rate_of_false_alarms(setting: dict[str, Any]) -> None:
    """The stated level is 1 %; 80 sets give more than 3 with a probability of 0.9 %."""
    alarms, _, joint = rates(80, **setting)
    assert alarms <= 3 / 80
    assert joint <= 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("K", "least"), [(3, 0.75), (8, 0.95)])
def test_rate_of_true_alarms(K: int, least: float) -> None:
    """A difference of eight standard deviations of one recording."""
    alarms, hits, _ = rates(60, K=K, phi=0.3, odd=8.0)
    assert hits >= least
    assert alarms - hits <= 0.02


# ---- fits


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    """Five recordings of the cart-pendulum; the friction of the third is 70 % larger."""
    control = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
    found = []
    for k in range(5):
        rubbing = {"c": {"true": 1.7 if k == 2 else 1.0}}
        stated = cart_pendulum(initial={"control": control}, horizon=2.0, parameters=rubbing)
        found.append(replace(logs_of(stated, k)[0], name=f"logs/run_{k + 1}.csv"))
    return found


@pytest.mark.slow
def test_a_fit_names_the_odd_recording(recordings: list[Recording]) -> None:
    experiment = cart_pendulum(fit={"bootstrap": 0})
    estimate = mjfim.identify(experiment, recordings)
    comparison = estimate.recording_comparison
    assert comparison is not None
    (odd,) = comparison.odd
    assert odd.name == "run_3.csv"
    assert [parameter.name for parameter in odd.parameters] == ["c"]
    assert odd.parameters[0].value == pytest.approx(1.7, abs=0.3)
    assert any(warning.startswith("run_3.csv is odd: its c is") for warning in estimate.warnings)

    # What moves is named with its values and their logs.
    (moved,) = (each for each in estimate.warnings if each.startswith("recordings disagree"))
    assert re.search(r"\bc \(from [\d.]+ in run_[1245]\.csv to 1\.\d+ .* in run_3\.csv\)", moved)

    # One step from the common estimate is nearly the fit of a recording alone.
    alone = mjfim.identify(experiment, recordings[:1])
    assert alone.recording_comparison is None
    difference = np.abs(comparison.values[0] - alone.theta) / alone.std
    assert difference.max() < 0.6

    # A friction that is stated to differ between recordings is no surprise.
    stated = experiment.replace(parameters={"c": {"per_recording": True, "nuisance": True}})
    differing = mjfim.identify(stated, recordings).recording_comparison
    assert differing is not None
    assert differing.parameters == ("m", "l", "c")
    assert differing.odd == ()
    np.testing.assert_array_equal(differing.is_stated, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(differing.values[:, 2], [1.0, 1.0, 1.7, 1.0, 1.0], atol=0.3)
    assert differing.tau[2] > 0.1
    assert differing.p[2] == 1.0
