"""Draws from a truncated normal distribution against rejection sampling and against theory."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ks_2samp, kstest, norm, truncnorm

from mjfim.identification.assessment import parameter_draws
from mjfim.identification.assessment.parameter_draws import (
    MIN_SWEEPS,
    draw_truncated_normal,
)
from tests.support.numerics import Array

INFINITE = np.full(3, np.inf)


def covariance_of(std: Array, correlation: float) -> Array:
    """Covariance of variables of which each pair has the same correlation."""
    count = len(std)
    matrix = np.full((count, count), correlation) + (1.0 - correlation) * np.eye(count)
    return np.asarray(matrix * np.outer(std, std))


def require_same_distribution(drawn: Array, kept: Array) -> None:
    """Require that two samples of three variables agree along several directions."""
    for direction in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0.3, 0], [1, -0.3, 1], [0, 1, -6]):
        assert ks_2samp(drawn @ direction, kept @ direction).pvalue > 1e-3


def test_without_bounds_the_moments_are_those_of_the_normal_distribution() -> None:
    mean, std = np.array([1.0, -2.0, 30.0]), np.array([1e-6, 2.0, 1e5])
    covariance = covariance_of(std, 0.7)
    rng = np.random.default_rng(1)
    drawn = draw_truncated_normal(mean, covariance, -INFINITE, INFINITE, 4000, rng)
    for j in range(3):
        assert kstest(drawn[:, j], norm(mean[j], std[j]).cdf).pvalue > 1e-3
    np.testing.assert_allclose(np.corrcoef(drawn.T)[0, 1:], 0.7, atol=0.03)


@pytest.mark.parametrize("correlation", [-0.45, 0.0, 0.9, 0.999])
def test_bounds_cut_off_as_rejection_does(correlation: float) -> None:
    mean, std = np.array([0.0, 1.0, 2.0]), np.array([1.0, 3.0, 0.5])
    covariance = covariance_of(std, correlation)
    lower, upper = np.array([0.0, -1.0, -np.inf]), np.array([np.inf, 4.0, 2.3])
    rng = np.random.default_rng(2)
    drawn = draw_truncated_normal(mean, covariance, lower, upper, 3000, rng)
    assert ((lower <= drawn) & (drawn <= upper)).all()

    plain = rng.multivariate_normal(mean, covariance, 60_000)
    require_same_distribution(drawn, plain[((lower <= plain) & (plain <= upper)).all(axis=1)])


def test_many_estimates_at_their_bounds() -> None:
    """Rejection would keep one of 2^14 draws."""
    zero, std = np.zeros(14), np.linspace(0.1, 10.0, 14)
    rng = np.random.default_rng(3)
    drawn = draw_truncated_normal(zero, np.diag(std**2), zero, np.full(14, np.inf), 1000, rng)
    for j in range(14):
        assert kstest(drawn[:, j] / std[j], truncnorm(0.0, np.inf).cdf).pvalue > 1e-3


def test_an_interval_far_in_the_tail() -> None:
    rng = np.random.default_rng(4)
    bound = np.array([7.0])
    drawn = draw_truncated_normal(np.zeros(1), np.eye(1), -bound, bound, 2000, rng)
    assert kstest(drawn[:, 0], norm.cdf).pvalue > 1e-3

    # The mean is at the bound, and a narrow interval remains.
    drawn = draw_truncated_normal(np.ones(1), np.eye(1), np.ones(1), np.ones(1) + 1e-9, 9, rng)
    assert ((drawn >= 1.0) & (drawn <= 1.0 + 1e-9)).all()
    assert len(np.unique(drawn)) > 1


def test_a_singular_covariance_keeps_its_directions() -> None:
    mean = np.array([1.0, 2.0, 3.0])
    direction = np.array([1.0, -2.0, 0.0])
    covariance = np.outer(direction, direction)
    lower = np.array([0.5, -np.inf, -np.inf])
    rng = np.random.default_rng(5)
    drawn = draw_truncated_normal(mean, covariance, lower, INFINITE, 500, rng)
    np.testing.assert_allclose(drawn[:, 0] * 2.0 + drawn[:, 1], 4.0, atol=1e-9)
    np.testing.assert_array_equal(drawn[:, 2], 3.0)
    assert drawn[:, 0].min() >= 0.5


# A matrix [[x, y], [y, z]] of three variables, by its slopes.
SLOPES = np.array([[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]], dtype=float)


@pytest.mark.parametrize("correlation", [0.0, -0.45, 0.9])
def test_a_positive_definite_matrix_cuts_off_as_rejection_does(
    correlation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fewest sweeps are enough, and a bound of a single variable holds as well."""
    monkeypatch.setattr(parameter_draws, "SWEEPS", MIN_SWEEPS)
    mean, std = np.array([1.0, 0.3, 0.5]), np.array([1.0, 3.0, 0.5])
    covariance = covariance_of(std, correlation)
    lower, upper = np.array([-np.inf, -0.4, -np.inf]), INFINITE
    bound = (np.tensordot(mean, SLOPES, axes=1), SLOPES)
    rng = np.random.default_rng(6)
    drawn = draw_truncated_normal(mean, covariance, lower, upper, 800, rng, matrices=[bound])

    def is_inside(x: Array) -> Array:
        """Whether the matrix is positive definite and the bound holds."""
        is_positive = (x[:, 0] > 0.0) & (x[:, 0] * x[:, 2] > x[:, 1] ** 2)
        return np.asarray(is_positive & (x[:, 1] >= lower[1]))

    assert is_inside(drawn).all()
    plain = rng.multivariate_normal(mean, covariance, 60_000)
    kept = plain[is_inside(plain)]
    assert 1000 < len(kept) < 30_000
    require_same_distribution(drawn, kept)


def test_units_of_a_matrix_do_not_change_the_draws() -> None:
    mean, covariance = np.array([1.0, 0.3, 0.5]), covariance_of(np.array([1.0, 3.0, 0.5]), 0.5)
    at_mean = np.tensordot(mean, SLOPES, axes=1)
    drawn = []
    for units in (np.ones((2, 2)), np.outer([1e-6, 1e4], [1e-6, 1e4])):
        bound = (at_mean * units, SLOPES * units)
        rng = np.random.default_rng(7)
        drawn.append(
            draw_truncated_normal(mean, covariance, -INFINITE, INFINITE, 50, rng, matrices=[bound])
        )
    np.testing.assert_allclose(drawn[0], drawn[1], rtol=1e-6, atol=1e-9)
