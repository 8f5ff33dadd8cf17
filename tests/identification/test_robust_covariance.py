"""Robust uncertainty against the spread of many repetitions of a simulated experiment.

The models are linear and the truth is known, so that every part of `robust_uncertainty` can be
compared with that spread.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from scipy.signal import lfilter

from mjfim.identification.assessment.robust_covariance import (
    Uncertainty,
    block_length,
    covering_covariance,
    merge_blocks,
    robust_uncertainty,
)
from mjfim.optimize.condensed_least_squares import Condensed
from tests.support.numerics import Array

# Rows of a block of the linearisation.
FINE = 8


@dataclass(frozen=True, eq=False)
class Linear:
    """Recordings of `y = X theta + noise`.

    Attributes:
        X: (K, N, c) regressors of K recordings.
        with_offsets: Whether every recording has an unknown offset.
        prior: Standard deviation of the prior on theta.
    """

    X: Array
    with_offsets: bool = False
    prior: float = np.inf

    def fitted(self, y: Array) -> tuple[Array, Condensed]:
        """Estimate from y: (K, N), and the linearisation there."""
        K, N, c = self.X.shape
        n = int(self.with_offsets)
        offsets = np.kron(np.eye(K), np.ones((N, n)))
        wide = np.hstack([offsets, self.X.reshape(K * N, c)])
        known = np.eye(K * n + c)[K * n :] / self.prior
        values = np.append(y.ravel(), np.zeros(c))
        found = np.linalg.lstsq(np.vstack([wide, known]), values)[0]
        r = (wide @ found - y.ravel()).reshape(K, N, 1)
        rows = np.concatenate([np.ones((K, N, n)), self.X, r], axis=2)
        stacked = rows.reshape(-1, FINE, n + c + 1)
        theta = found[K * n :]
        return theta, Condensed(
            blocks=np.linalg.qr(np.pad(stacked, ((0, 0), (0, c), (0, 0))), mode="r"),
            segment_of_block=np.repeat(np.arange(K), N // FINE),
            private_rows=np.zeros((K, 0, n + c + 1)),
            common_rows=np.column_stack([np.eye(c), theta]) / self.prior,
        )

    def assessed(self, y: Array, length: float, draws: int = 0) -> tuple[Array, Array, Uncertainty]:
        """Estimate, its formal standard deviations and its robust uncertainty."""
        theta, condensed = self.fitted(y)
        formal = np.sqrt(np.diag(np.linalg.inv(condensed.information())))
        return theta, formal, assess(condensed, theta, length, draws)


def assess(
    condensed: Condensed,
    theta: Array,
    length: float,
    draws: int = 0,
    inflation: float = 1.0,
    is_white: bool = True,
) -> Uncertainty:
    """The robust uncertainty of an estimate with blocks of at least some length."""
    blocks = condensed.segment_of_block
    return robust_uncertainty(
        condensed,
        theta,
        blocks,
        np.full(len(blocks), float(FINE)),
        min_rows=length,
        draws=draws,
        rng=np.random.default_rng(0),
        own=np.zeros((len(condensed.private_rows), 0), dtype=int),
        inflation=inflation,
        is_white=is_white,
    )


def waves(K: int, N: int, c: int, slow: float = 3.0) -> Array:
    """(K, N, c) slow regressors, which autocorrelated noise disturbs most."""
    angles = 2 * np.pi * slow * np.outer(np.arange(N) / N, np.arange(1, c + 1))
    return np.cos(angles + np.arange(c) + np.arange(K)[:, None, None])


def noise(phi: float, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """AR(1) of unit variance along the last axis."""
    e = rng.standard_normal(shape) * np.sqrt(1.0 - phi**2)
    e[:, 0] /= np.sqrt(1.0 - phi**2)
    return lfilter([1.0], [1.0, -phi], e)


@pytest.mark.parametrize(
    ("phi", "with_offsets", "prior"),
    [
        (0.0, False, np.inf),
        (0.0, True, np.inf),
        (0.9, False, np.inf),
        (0.9, True, np.inf),
        (0.0, False, 0.03),
    ],
)
@pytest.mark.slow
def test_deviations_are_the_spread_of_estimates_and_intervals_cover_the_truth(
    phi: float, with_offsets: bool, prior: float
) -> None:
    """With correlated noise, the formal deviation is much too small.

    The coverage is nearly 95 % and not 100 %; formal intervals cover less. A truth that is drawn
    from the prior scatters less than the prior says.
    """
    K, N = (4, 480) if with_offsets else (1, 1600)
    model, rng = Linear(waves(K, N, 2), with_offsets, prior), np.random.default_rng(11)
    length = block_length([(1 + phi) / (1 - phi)], K * N)
    found = []
    for _ in range(150):
        truth = (prior if np.isfinite(prior) else 0.0) * rng.standard_normal(2)
        offsets = 3.0 * rng.standard_normal((K, 1)) * with_offsets
        y = model.X @ truth + offsets + noise(phi, (K, N), rng)
        theta, formal, result = model.assessed(y, length, draws=150)
        low, high = result.interval.T
        covered = (low <= truth) & (truth <= high)
        bootstrap = result.draws.std(axis=0)
        found.append((theta - truth, formal, result.sandwich, bootstrap, covered))
    errors, formal, sandwich, bootstrap, covered = map(np.array, zip(*found, strict=True))

    true = errors.std(axis=0)
    assert (true < prior).all()
    for deviation in (sandwich, bootstrap):
        assert_allclose(deviation.mean(axis=0), true, rtol=0.25 if phi else 0.15)
    naive = (np.abs(errors) < 1.96 * formal).mean()
    if phi:
        assert naive < 0.8
        assert (formal.mean(axis=0) < 0.4 * true).all()
    else:
        assert naive > 0.9
        assert_allclose(sandwich.mean(axis=0), formal.mean(axis=0), rtol=0.05)
    assert covered.sum() >= stats.binom.ppf(0.001, covered.size, 0.92)
    assert not covered.all(), "an interval that is never wrong is too wide"


@pytest.mark.parametrize(
    ("spread", "K", "N", "phi", "slow", "sets"),
    [
        pytest.param([0.4, 0.0], 8, 480, 0.5, 3.0, 60, marks=pytest.mark.slow, id="one differs"),
        pytest.param([0.0] * 3, 10, 480, 0.92, 1.0, 150, marks=pytest.mark.slow, id="few blocks"),
        pytest.param([0.5] * 3, 5, 1200, 0.0, 0.7, 40, id="differences are no scatter"),
    ],
)
def test_recordings_that_disagree_are_found_and_no_others(
    spread: list[float], K: int, N: int, phi: float, slow: float, sets: int
) -> None:
    """Unknowns differ between recordings by a normal spread, which the interval includes.

    Few blocks of one recording often scatter little by chance, which is no alarm. Residuals at the
    common estimate contain the differences, which must not count as scatter within a recording.
    """
    rng = np.random.default_rng(5)
    model, differs = Linear(waves(K, N, len(spread), slow)), np.array(spread) > 0.0
    length = block_length([60.0 if slow < 1.0 else (1 + phi) / (1 - phi)], K * N)
    apart, between = [], []
    for _ in range(sets):
        truth = spread * rng.standard_normal((K, len(spread)))
        y = np.einsum("knc,kc->kn", model.X, truth) + noise(phi, (K, N), rng)
        theta, _, result = model.assessed(y, length)
        apart.append(np.isin(np.arange(len(spread)), result.apart))
        between.append(result.between)
        assert (result.interval[:, 1] - theta >= 1.95 * result.between).all()
    assert not differs.any() or np.any(apart & differs, axis=1).mean() >= 0.96
    assert np.any(apart & ~differs, axis=1).mean() <= 0.05
    assert_allclose(np.mean(np.square(between), axis=0), np.square(spread), atol=0.07)


def test_estimates_from_single_recordings_are_their_fits() -> None:
    """Exact for a linear model; NaN for a recording that does not determine all unknowns."""
    rng = np.random.default_rng(1)
    X = waves(4, 240, 3)
    X[2, :, 1] = X[2, :, 0]
    y = rng.standard_normal((4, 240))
    _, _, result = Linear(X).assessed(y, 16.0)
    for k in (0, 1, 3):
        assert_allclose(result.each[k], np.linalg.lstsq(X[k], y[k])[0], rtol=1e-6)
    assert np.isnan(result.each[2]).all()


def test_the_interval_is_the_hull() -> None:
    """It contains the formal interval, the sandwich interval and the 2.5 and 97.5 % draws."""
    y = noise(0.9, (1, 1600), np.random.default_rng(4))
    theta, formal, result = Linear(waves(1, 1600, 2)).assessed(y, 80.0, draws=400)
    tails = np.quantile(result.draws, [0.025, 0.975], axis=0)
    side = np.maximum(1.959 * formal, 1.96 * result.sandwich)
    low, high = result.interval.T
    assert (low <= np.minimum(theta - side, tails[0]) + 1e-12).all()
    assert (high >= np.maximum(theta + side, tails[1]) - 1e-12).all()
    assert result.draws.shape == (400, 2)


def test_residuals_that_are_alike_in_slow_parts_count_as_few_groups() -> None:
    """A model that errs in its slow parts alone; four groups by strength, and Student's factor."""
    X = np.ones((1, 64 * FINE, 1))
    slow = np.repeat(np.arange(64) % 4 == 0, FINE)
    X[0, slow] = 0.2
    y = (
        X[..., 0] * 2.0
        + np.where(slow, 3.0, 0.0)
        + noise(0.0, X.shape[:2], np.random.default_rng(1))
    )
    theta, condensed = Linear(X).fitted(y)
    narrow, wide = (assess(condensed, theta, FINE, is_white=each) for each in (True, False))
    r = X[0, :, 0] * theta - y[0]
    score = X[0, :, 0] * r
    groups = np.concatenate([score[slow], score[~slow]]).reshape(4, -1).sum(axis=1)
    std = np.sqrt(4.0 / 3.0 * np.sum((groups - groups.mean()) ** 2)) / np.sum(X**2)
    half = float(stats.t.ppf(0.975, 3)) * std
    assert half > 1.5 * (narrow.interval[0, 1] - theta[0])
    assert_allclose(wide.interval[0], theta + np.array([-half, half]), rtol=1e-9)


def test_groups_of_data_tell_about_all_unknowns_together() -> None:
    """Unknowns of a wrong model that differ in four stages of the data, one more than the others.

    Widths of those that err alike scatter less than by three degrees of freedom, and the intervals
    of the one cover it as well.
    """
    rng, size = np.random.default_rng(7), np.array([6.0, *[2.0] * 11])
    X = rng.choice([-1.0, 1.0], (1, 80 * FINE, 12))
    sides = []
    for _ in range(60):
        stages = np.repeat(size * rng.standard_normal((4, 12)), 20 * FINE, axis=0)
        y = np.sum(X * stages, axis=2) + noise(0.0, X.shape[:2], rng)
        theta, condensed = Linear(X).fitted(y)
        sides.append(assess(condensed, theta, FINE, is_white=False).interval)
    low, high = np.moveaxis(sides, 2, 0)
    covered = (low <= 0.0) & (high >= 0.0)
    assert covered[:, 0].mean() >= 0.9
    # It would be 0.48 with three degrees of freedom.
    assert np.log(high - low)[:, 1:].std(axis=0).mean() < 0.36


def test_blocks_are_four_autocorrelation_times_long() -> None:
    """A block has one row for white residuals, and at most a twentieth of the data."""
    assert block_length([1.0, 1.2], 10_000) == 1.0
    assert block_length([2.0, 9.0], 10_000) == 36.0
    assert block_length([1000.0], 10_000) == 500.0
    assert block_length([], 10_000) == 1.0
    assert block_length([5.0], 3) == 1.0


@pytest.mark.parametrize(
    ("recording", "rows", "length", "expected"),
    [
        ([], [], 5.0, []),
        ([0, 0, 1, 1], [1, 1, 1, 1], 1.0, [0, 1, 2, 3]),
        ([0, 0, 0, 0, 0, 1], [1, 1, 1, 1, 1, 1], 4.0, [0, 0, 0, 0, 0, 1]),
        ([0, 0, 0, 0, 0, 1], [1, 1, 1, 1, 1, 1], 3.0, [0, 0, 0, 1, 1, 2]),
        ([0, 0, 0, 0], [4, 1, 5, 2], 4.0, [0, 1, 1, 2]),
    ],
)
def test_merged_blocks_are_short_runs_of_one_recording(
    recording: list[int], rows: list[int], length: float, expected: list[int]
) -> None:
    """They are as short as possible, and the last one has at least half of the length."""
    found = merge_blocks(np.array(recording, dtype=int), np.array(rows, dtype=float), length)
    assert_array_equal(found, expected)


def test_a_covering_covariance_is_at_least_both_in_every_direction() -> None:
    rng = np.random.default_rng(3)
    first, second = (B @ B.T for B in rng.normal(size=(2, 4, 4)))
    second[:, 0] = second[0] = 0.0
    found = covering_covariance(first, second)
    for smaller in (first, second):
        assert np.linalg.eigvalsh(found - smaller)[0] > -1e-9
    for factor in (0.1, 9.0):
        covering = covering_covariance(first, factor * first)
        assert_allclose(covering, max(factor, 1.0) * first, rtol=1e-6)


def test_inflated_residuals_widen_what_the_data_say_but_not_the_prior() -> None:
    X, y = waves(1, 480, 2), noise(0.0, (1, 480), np.random.default_rng(6))
    for prior, factor in ((np.inf, 100.0), (1e-6, 1.0)):
        theta, condensed = Linear(X, prior=prior).fitted(y)
        plain, wide = (assess(condensed, theta, 1.0, inflation=each) for each in (1.0, 100.0))
        assert_array_equal(plain.interval, wide.interval)
        ratio = np.diag(wide.covariance) / np.diag(plain.covariance)
        assert_allclose(ratio, factor, rtol=0.35)


def test_no_combination_is_better_known_than_by_the_formal_covariance() -> None:
    """Twelve unknowns, whose combinations are known to 1e-5 to 1 of them, keep their digits."""
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.standard_normal((12, 12)))[0]
    sizes = np.geomspace(1.0, 1e-5, 12)
    plain = rng.standard_normal((1600, 12))
    _, condensed = Linear((plain * sizes @ axes)[None]).fitted(rng.standard_normal((1, 1600)))
    found = assess(condensed, np.zeros(12), 16.0)

    # In coordinates in which the formal covariance is nearly that of all combinations alike.
    scaled = sizes[:, None] * (axes @ found.covariance @ axes.T) * sizes
    root = np.linalg.cholesky(plain.T @ plain)
    relative = np.linalg.eigvalsh(root.T @ scaled @ root)
    assert relative.min() > 0.99
    assert relative.max() < 3.0
