"""Noise: whitening against SciPy's normal density, missing values marginalised, and information per
second kept.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from mjfim.plant.outputs import Noise

Array = NDArray[np.float64]

ROOT = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.8, 0.5, 0.0, 0.0], [-0.3, 0.4, 2.0, 0.0], [0.0, 0.0, 0.0, 0.1]]
)
FULL = ROOT @ ROOT.T  # the last output is uncorrelated with the others


def correlated(strides: tuple[int, ...] = (1, 1, 1, 1)) -> Noise:
    """Four outputs, three of them correlated."""
    return Noise(covariance=FULL, strides=np.array(strides))


def test_jacobians_are_whitened_like_residuals() -> None:
    """With any trailing axes; products of whitened rows are the Fisher information by the precision
    matrix.
    """
    G = np.random.default_rng(2).standard_normal((5, 4, 3))
    noise = correlated()
    white = noise.whiten(G)
    for j in range(3):
        assert_allclose(white[..., j], noise.whiten(G[..., j]), rtol=1e-13, atol=1e-13)
    wanted = sum(G[k].T @ np.linalg.inv(FULL) @ G[k] for k in range(1, 5))
    rows = noise.whitened_rows(G)
    assert rows.shape == (16, 3)
    assert_allclose(rows.T @ rows, wanted, rtol=1e-11)
    assert_allclose(noise.precision, np.linalg.inv(FULL), rtol=1e-11, atol=1e-13)
    assert_allclose(noise.sigma, np.sqrt(np.diag(FULL)), rtol=1e-15)


def test_strides_select_the_samples_of_each_output() -> None:
    noise = correlated((2, 2, 2, 3))
    wanted = np.zeros((8, 4))
    wanted[2::2, :3] = wanted[3::3, 3] = 1.0
    assert_array_equal(noise.measured(7), wanted)
    G = np.random.default_rng(3).standard_normal((8, 4, 2))
    rows, precision = noise.whitened_rows(G), np.linalg.inv(FULL)
    information = np.zeros((2, 2))
    for measured, g in zip(wanted.astype(bool), G, strict=True):
        information += g[measured].T @ precision[np.ix_(measured, measured)] @ g[measured]
    assert_allclose(rows.T @ rows, information, rtol=1e-11)


def test_missing_values_are_marginalised() -> None:
    """The density of the present values agrees with SciPy, whatever stands in place of missing
    ones.
    """
    rng = np.random.default_rng(4)
    values = rng.standard_normal((12, 4))
    present = rng.random((12, 4)) < 0.6
    present[3], present[5] = False, True
    noise = correlated()
    kept = np.where(present, values, np.nan)
    white = noise.whiten_present(kept, present)
    assert white.shape == (present.sum(),)
    ends = np.cumsum(present.sum(axis=1))[:-1]
    for row, seen, own in zip(values, present, np.split(white, ends), strict=True):
        if seen.any():
            density = multivariate_normal(np.zeros(seen.sum()), FULL[np.ix_(seen, seen)])
            drop = density.logpdf(np.zeros(seen.sum())) - density.logpdf(row[seen])
            assert drop == pytest.approx(0.5 * own @ own, rel=1e-10)
        else:
            assert own.size == 0
    assert_array_equal(noise.whiten_present(np.where(present, values, 7.0), present), white)
    # taking rows of the joint whitening instead would condition on zeros
    conditioned = noise.whiten(np.where(present, values, 0.0))[present]
    assert np.abs(conditioned - white).max() > 0.1


def test_samples_have_the_stated_covariance() -> None:
    """The error is that expected of a sample covariance."""
    drawn = correlated().sample(40_000, np.random.default_rng(6))
    spread = np.sqrt((FULL**2 + np.outer(np.diag(FULL), np.diag(FULL))) / len(drawn))
    assert np.abs((drawn.T @ drawn / len(drawn) - FULL) / spread).max() < 4.0
    again = correlated().sample(40_000, np.random.default_rng(6))
    assert_array_equal(drawn, again)
    white = correlated().whiten(drawn)
    assert_allclose(np.cov(white.T), np.eye(4), atol=0.03)


@pytest.mark.parametrize("coarsen", [1, 3])
def test_measuring_every_sample_keeps_the_information_per_second(coarsen: int) -> None:
    """The period of the other grid is `coarsen` times longer; the outputs have different rates."""
    strides, stride, N, rate = np.array([4, 4, 4, 6]), 2, 72, 100.0
    G = np.array([[1.0, 0.2], [-0.5, 1.0], [0.3, 0.3], [2.0, -1.0]])  # the same at all samples
    fine = Noise(covariance=FULL, strides=strides)
    before = fine.whitened_rows(np.broadcast_to(G, (N + 1, *G.shape)))
    coarse = fine.at_every_sample(stride)
    after = coarse.whitened_rows(np.broadcast_to(G, (N // coarsen + 1, *G.shape)))
    assert coarse.strides.tolist() == [1] * 4
    assert_allclose(
        after.T @ after / (rate / coarsen), before.T @ before / (rate / stride), rtol=1e-11
    )
    ratio = coarse.covariance[:3, :3] / FULL[:3, :3]
    assert_allclose(ratio, ratio[0, 0])  # correlations stay
