"""Draws from a truncated normal distribution against rejection sampling and against theory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import ks_2samp, kstest, norm

from mjfim.identification.assessment import parameter_draws
from mjfim.identification.assessment.parameter_draws import (
    MIN_SWEEPS,
    draw_truncated_normal,
)
from tests.support.numerics import Array

INFINITE = np.full(3, np.inf)
STD = np.array([1.0, 3.0, 0.5])


def covariance_of(std: Array, correlation: float) -> Array:
    """Covariance of variables of which each pair has the same correlation."""
    count = len(std)
    matrix = np.full((count, count), correlation) + (1.0 - correlation) * np.eye(count)
    return matrix * np.outer(std, std)


def require_same_distribution(drawn: Array, kept: Array) -> None:
    """Require that two samples of three variables agree along several directions."""
    for direction in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0.3, 0], [1, -0.3, 1], [0, 1, -6]):
        assert ks_2samp(drawn @ direction, kept @ direction).pvalue > 1e-3


def truncated(
    mean: Array, covariance: Array, lower: Array, upper: Array, count: int, seed: int, **rest: Any
) -> Array:
    """Draws from a truncated normal distribution."""
    rng = np.random.default_rng(seed)
    return draw_truncated_normal(mean, covariance, lower, upper, count, rng, **rest)


@pytest.mark.parametrize("correlation", [-0.45, 0.0, 0.9, 0.999])
def test_bounds_cut_off_as_rejection_does(correlation: float) -> None:
    mean, covariance = (
        np.array([0.0, 1.0, 2.0]),
        covariance_of(np.array([1.0, 3, 0.5]), correlation),
    )
    lower, upper = np.array([0.0, -1.0, -np.inf]), np.array([np.inf, 4.0, 2.3])
    drawn = truncated(mean, covariance, lower, upper, 3000, 2)
    assert ((lower <= drawn) & (drawn <= upper)).all()

    plain = np.random.default_rng(3).multivariate_normal(mean, covariance, 60_000)
    require_same_distribution(drawn, plain[((lower <= plain) & (plain <= upper)).all(axis=1)])


def test_an_interval_far_in_the_tail() -> None:
    one = np.ones(1)
    drawn = truncated(0.0 * one, np.eye(1), -7.0 * one, 7.0 * one, 2000, 4)
    assert kstest(drawn[:, 0], norm.cdf).pvalue > 1e-3

    # The mean is at the bound, and a narrow interval remains.
    drawn = truncated(one, np.eye(1), one, one + 1e-9, 9, 4)
    assert ((drawn >= 1.0) & (drawn <= 1.0 + 1e-9)).all()
    assert len(np.unique(drawn)) > 1


def test_a_singular_covariance_keeps_its_directions() -> None:
    direction = np.array([1.0, -2.0, 0.0])
    lower = np.array([0.5, -np.inf, -np.inf])
    mean = np.array([1.0, 2.0, 3.0])
    drawn = truncated(mean, np.outer(direction, direction), lower, INFINITE, 500, 5)
    assert_allclose(drawn[:, 0] * 2.0 + drawn[:, 1], 4.0, atol=1e-9)
    assert_array_equal(drawn[:, 2], 3.0)
    assert drawn[:, 0].min() >= 0.5


# A matrix [[x, y], [y, z]] of three variables, by its slopes.
SLOPES = np.array([[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]], dtype=float)


@pytest.mark.parametrize("correlation", [0.0, -0.45, 0.9])
def test_a_positive_definite_matrix_cuts_off_as_rejection_does(
    correlation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fewest sweeps are enough, and a bound of a single variable holds as well."""
    monkeypatch.setattr(parameter_draws, "SWEEPS", MIN_SWEEPS)
    mean, covariance = (
        np.array([1.0, 0.3, 0.5]),
        covariance_of(np.array([1.0, 3, 0.5]), correlation),
    )
    lower = np.array([-np.inf, -0.4, -np.inf])
    bound = (np.tensordot(mean, SLOPES, axes=1), SLOPES)
    drawn = truncated(mean, covariance, lower, INFINITE, 800, 6, matrices=[bound])

    def inside(draws: Array) -> Array:
        """Draws at which the matrix is positive definite and the bound holds."""
        x, y, z = draws.T
        return draws[(x > 0.0) & (x * z > y**2) & (y >= lower[1])]

    assert len(inside(drawn)) == 800
    kept = inside(np.random.default_rng(7).multivariate_normal(mean, covariance, 60_000))
    assert 1000 < len(kept) < 30_000
    require_same_distribution(drawn, kept)


def test_units_of_a_matrix_do_not_change_the_draws() -> None:
    mean, covariance = np.array([1.0, 0.3, 0.5]), covariance_of(STD, 0.5)
    at_mean = np.tensordot(mean, SLOPES, axes=1)
    own, other = (
        truncated(
            mean, covariance, -INFINITE, INFINITE, 50, 7, matrices=[(at_mean * u, SLOPES * u)]
        )
        for u in (np.ones((2, 2)), np.outer([1e-6, 1e4], [1e-6, 1e4]))
    )
    assert_allclose(own, other, rtol=1e-6, atol=1e-9)
