"""Comparison of recordings against separate fits, theory, and its rates of alarms."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, f, t

import mjfim
from mjfim.identification.assessment.recording_comparison import (
    between_variance,
    compare_evidence,
    difference,
    f_tail,
    heterogeneity,
    prediction,
    random_effects,
    satterthwaite,
)
from mjfim.identification.assessment.robust_covariance import (
    block_length,
    independent_blocks,
    recording_evidence,
)
from mjfim.records.robots import RecordingComparison
from tests.identification.test_robust_covariance import FINE, Linear, noise, waves
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.numerics import Array


def compared(model: Linear, y: Array, length: float = 1.0) -> RecordingComparison:
    """Compare the recordings y: (K, N) of a linear model."""
    theta, condensed = model.fitted(y)
    recording = condensed.segment_of_block
    blocks = independent_blocks(condensed, recording, np.full(len(recording), float(FINE)), length)
    own = np.zeros((len(y), 0), dtype=int)
    return compare_evidence(
        theta,
        recording_evidence(condensed, blocks, recording, own),
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
    X, y = simulated(0, 4, (1.0, -2.0, 0.5), 160)
    y[1] += X[1, :, 0]
    found = compared(Linear(X=X, with_offsets=with_offsets), y)
    for k in range(4):
        J = np.column_stack([X[k], np.ones((160, int(with_offsets)))])
        assert_allclose(found.values[k], np.linalg.lstsq(J, y[k])[0][:3], rtol=1e-8)

        # The deviations are the formal ones, a little larger where blocks happen to scatter more.
        formal = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))[:3]
        assert (found.std[k] >= 0.999 * formal).all()
        assert (found.std[k] <= 1.5 * formal).all()


def test_an_odd_recording_is_named_with_its_parameter() -> None:
    X, y = simulated(1, 5, (1.0, -2.0, 0.5))
    y[2] += X[2, :, 0]
    found = compared(Linear(X=X), y)
    (odd,) = found.odd
    assert (odd.index, odd.name) == (2, "run_3.csv")
    assert odd.parameters == ("p0",) and odd.p < 1e-3
    words = re.compile(r"run_3.csv is odd: its p0 is .* % above that of the others \((.*) ±.*")
    own, others = re.fullmatch(words, str(odd))[1].split(" against ")
    assert float(own.split()[0]) - float(others) == pytest.approx(1.0, abs=0.3)
    assert found.tau[0] > 0.2 and (found.tau[1:] < 0.1).all()
    assert found.prediction[0, 0] < found.interval[0, 0] < found.interval[0, 1]
    assert (found.apart, found.order[0]) == ((0,), 0)
    assert found.joint_p < 1e-6

    # Two of seven are odd; of two that disagree, none is.
    X, y = simulated(2, 7, (1.0, -2.0))
    y[[1, 5]] += np.array([[-2.0], [1.0]]) * X[[1, 5], :, [1, 0]]
    assert [odd.index for odd in compared(Linear(X=X), y).odd] == [1, 5]
    X, y = simulated(3, 2, (1.0, -2.0))
    y[1] += X[1, :, 0]
    found = compared(Linear(X=X), y)
    assert (found.odd, found.apart) == ((), (0,))
    assert "differ in p0" in str(found)
    assert np.isinf(found.prediction).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("K", "phi", "c", "noisy", "odd", "hits"),
    [
        (4, 0.0, 3, 1.0, 0.0, 0.0),
        (5, 0.9, 10, 1.0, 0.0, 0.0),
        (5, 0.0, 3, 5.0, 0.0, 0.0),
        (3, 0.3, 3, 1.0, 8.0, 0.75),
        (8, 0.3, 3, 1.0, 8.0, 0.95),
    ],
)
def test_rates_of_alarms(K: int, phi: float, c: int, noisy: float, odd: float, hits: float) -> None:
    """The stated level is 1 %; 80 sets give more than 3 with a probability of 0.9 %.

    The noise of the first recording is larger by a factor, and the first parameter of the last
    recording differs by some standard deviations.
    """
    N, sets = 400, 80
    rng = np.random.default_rng(0)
    X = waves(K, N, c)
    growth = (1.0 + phi) / (1.0 - phi)
    found = []
    for _ in range(sets):
        y = noise(phi, (K, N), rng)
        y[0] *= noisy
        y[-1] += odd * np.sqrt(2.0 / N * growth) * X[-1, :, 0]
        found.append(compared(Linear(X=X), y, block_length([growth], K * N)))
    first = [each.odd[0].index for each in found if each.odd]
    right = first.count(K - 1) if odd else 0
    assert right >= hits * sets
    assert len(first) - right <= 3
    assert odd or sum(each.joint_p < 1e-3 for each in found) <= 1


def test_recordings_that_determine_some_parameters_only() -> None:
    """Recording k does not move parameter k; the last one moves a combination alone."""
    X, _ = simulated(4, 4, (0.0, 0.0, 0.0))
    X[:3] *= 1.0 - np.eye(3)[:, None]
    X[3] = X[3, :, :1] * np.array([1.0, 2.0, 0.0])
    y = X @ np.array([1.0, -2.0, 0.5]) + noise(0.0, (4, 400), np.random.default_rng(4))
    found = compared(Linear(X=X), y)
    unknown = np.vstack([np.eye(3), np.ones(3)]).astype(bool)
    assert_array_equal(np.isnan(found.values), unknown)
    assert_array_equal(np.isinf(found.std), unknown)
    assert np.isfinite(found.mean).all()
    assert "agree" in str(found)

    # The combination of the last recording contradicts the others, though none of its parameters
    # is determined by it alone.
    y[3] += X[3, :, 0]
    (odd,) = compared(Linear(X=X), y).odd
    assert (odd.index, odd.parameters) == (3, ())
    assert "combinations of its parameters differ" in str(odd)


def test_a_combination_that_no_recording_determines() -> None:
    X, y = simulated(5, 3, (1.0, 0.0))
    X[..., 1] = 2.0 * X[..., 0]
    found = compared(Linear(X=X), y)
    assert np.isnan(found.values).all() and np.isnan(found.mean).all()
    assert 0.0 < found.joint_p <= 1.0


@pytest.mark.slow
def test_a_fit_names_the_odd_recording() -> None:
    """The friction of the third of five recordings of the cart-pendulum is 70 % larger."""
    control = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
    experiment = cart_pendulum(
        initial={"control": control}, horizon=1.5, fit={"bootstrap": 0, "segments": "whole"}
    )
    rubbing = experiment.replace(parameters={"c": {"true": 1.7}})
    recordings = [
        replace(logs_of(rubbing if k == 2 else experiment, k)[0], name=f"logs/run_{k + 1}.csv")
        for k in range(5)
    ]
    estimate = mjfim.identify(experiment, recordings)
    comparison = estimate.recording_comparison
    (odd,) = comparison.odd
    assert (odd.name, odd.parameters) == ("run_3.csv", ("c",))
    assert any(warning.startswith("run_3.csv is odd: its c is") for warning in estimate.warnings)

    # What moves is named with its values and their logs.
    (moved,) = (each for each in estimate.warnings if each.startswith("recordings disagree"))
    assert re.search(r"\bc \(from [\d.]+ in run_[1245]\.csv to 1\.\d+ .* in run_3\.csv\)", moved)

    # A friction that is stated to differ between recordings is no surprise.
    stated = experiment.replace(parameters={"c": {"per_recording": True, "nuisance": True}})
    differing = mjfim.identify(stated, recordings).recording_comparison
    assert (differing.parameters, differing.odd) == (("m", "l", "c"), ())
    assert differing.is_stated.tolist() == [0.0, 0.0, 1.0]
    assert_allclose(differing.values[:, 2], [1.0, 1.0, 1.7, 1.0, 1.0], atol=0.3)
    assert differing.tau[2] > 0.1 and differing.p[2] == 1.0


def test_between_variance_solves_the_equation_of_paule_and_mandel() -> None:
    rng = np.random.default_rng(0)
    variances = rng.uniform(0.1, 4.0, (7, 30))
    values = rng.normal(size=(7, 30)) * np.sqrt(variances + np.linspace(0.0, 9.0, 30))
    found = between_variance(values, variances)

    # Weighted squares of the deviations are their expected value, or less without scatter.
    w = 1.0 / (variances + found)
    mean = np.sum(w * values, axis=0) / w.sum(axis=0)
    squares = np.sum(w * (values - mean) ** 2, axis=0)
    assert_allclose(squares[found > 0.0], 6.0, rtol=1e-8)
    assert (squares[found == 0.0] <= 6.0).all()
    assert 10 < np.sum(found > 0.0) < 30 and (found >= 0.0).all()


def test_missing_estimates_are_left_out() -> None:
    nothing = np.nan
    values = np.array([[1.0, nothing, nothing], [2.0, nothing, nothing], [nothing, 5.0, nothing]])
    variances = np.where(np.isnan(values), np.inf, [[1.0], [1.0], [2.0]])
    mean, variance, tau2 = random_effects(values, variances)
    assert_allclose(mean, [1.5, 5.0, nothing])
    assert_allclose(variance, [0.5, 2.0, np.inf])
    assert_allclose(heterogeneity(values, variances, 1e9)[1], [chi2(1).sf(0.5), 1.0, 1.0])
    assert not np.isfinite(prediction(values, variances, tau2)).any()


def test_the_interval_for_another_recording_is_that_of_student() -> None:
    """With equal variances, whatever the scatter between recordings is."""
    values = np.array([[1.0], [2.0], [4.0], [7.0]])
    for variance in (1e-3, 10.0):
        variances = np.full((4, 1), variance)
        found = prediction(values, variances, between_variance(values, variances))
        half = t(3).ppf(0.975) * values.std(ddof=1) * np.sqrt(1.25)
        assert_allclose(found[0], [3.5 - half, 3.5 + half], rtol=1e-6)


@pytest.mark.parametrize("ranks", [[4, 4], [2, 3, 4], [1, 1, 1, 1], [2, 2, 1]])
def test_difference_is_the_increase_of_squares(ranks: list[int]) -> None:
    """Dense least squares with one theta for each part, and with one for all."""
    rng = np.random.default_rng(3)
    size = 4
    rows = [rng.normal(size=(rank, size)) for rank in ranks]
    y = [rng.normal(size=rank) for rank in ranks]
    parts = np.array([np.column_stack([J.T @ J, J.T @ b]) for J, b in zip(rows, y, strict=True)])

    # Each part alone explains its data exactly, because it has at most as many rows as unknowns.
    J, b = np.concatenate(rows), np.concatenate(y)
    together = np.linalg.lstsq(J, b)[0]
    squares, dof = difference(parts)
    assert squares == pytest.approx(np.sum((J @ together - b) ** 2), rel=1e-9, abs=1e-12)
    assert dof == len(b) - np.linalg.matrix_rank(J)


def test_distributions() -> None:
    assert f_tail(6.0, 3, 10.0) == pytest.approx(f(3, 10).sf(2.0))
    assert f_tail(6.0, 0, 10.0) == 1.0
    assert_allclose(
        satterthwaite(np.array([0.0, 1.0, 0.5]), 50.0, 2), [50.0, 2.0, 1.0 / (0.25 / 50 + 0.125)]
    )
