"""Random effects against their defining equations, dense least squares and simulated sets."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, f

from mjfim.identification.assessment.recording_comparison import (
    between_variance,
    difference,
    f_tail,
    random_effects,
    satterthwaite,
    with_scatter,
)
from tests.support.numerics import Array


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
    found = random_effects(values, variances, 1e9)
    assert_array_equal(found.count, [2, 1, 0])
    assert_allclose(found.mean, [1.5, 5.0, nothing])
    assert_allclose(found.variance, [0.5, 2.0, np.inf])
    assert_allclose(found.p, [chi2(1).sf(0.5), 1.0, 1.0])
    assert not np.isfinite(found.prediction).any()


@pytest.mark.parametrize("tau", [0.0, 1.0, 3.0])
def test_intervals_for_another_recording_hold_its_estimate(tau: float) -> None:
    """Exact for equal variances, whatever the scatter between recordings is."""
    rng = np.random.default_rng(1)
    count, sets = 4, 4000
    values = rng.normal(size=(count + 1, sets)) * np.hypot(1.0, tau)
    low, high = random_effects(values[:-1], np.ones((count, sets)), 1e9).prediction.T
    inside = (low <= values[-1]) & (values[-1] <= high)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


def part_of(J: Array, b: Array) -> Array:
    """Information and its product with the estimate, from rows and their values."""
    return np.column_stack([J.T @ J, J.T @ b])


@pytest.mark.parametrize("ranks", [[4, 4], [2, 3, 4], [1, 1, 1, 1], [2, 2, 1]])
def test_difference_is_the_increase_of_squares(ranks: list[int]) -> None:
    """Dense least squares with one theta for each part, and with one for all."""
    rng = np.random.default_rng(3)
    size = 4
    rows = [rng.normal(size=(rank, size)) for rank in ranks]
    y = [rng.normal(size=rank) for rank in ranks]
    parts = np.array([part_of(J, b) for J, b in zip(rows, y, strict=True)])

    # Each part alone explains its data exactly, because it has at most as many rows as unknowns.
    J, b = np.concatenate(rows), np.concatenate(y)
    together = np.linalg.lstsq(J, b)[0]
    squares, dof = difference(parts)
    assert squares == pytest.approx(np.sum((J @ together - b) ** 2), rel=1e-9, abs=1e-12)
    assert dof == len(b) - np.linalg.matrix_rank(J)


def test_scatter_adds_to_the_covariance_also_of_singular_information() -> None:
    rng = np.random.default_rng(4)
    J, estimate, tau2 = rng.normal(size=(3, 3)), rng.normal(size=3), np.diag([0.5, 0.0, 2.0])
    full = part_of(J, J @ estimate)

    # Information about one direction: its variance grows by the scatter along it.
    direction = np.array([1.0, 2.0, -1.0])
    rank_one = part_of(direction[None], np.array([3.0]))
    found, of_one = with_scatter(np.array([full, rank_one]), tau2)
    A, vector = found[:, :-1], found[:, -1]
    expected = np.linalg.inv(J.T @ J) + tau2
    assert_allclose(np.linalg.inv(A), expected, rtol=1e-9, atol=1e-12)
    assert_allclose(np.linalg.solve(A, vector), estimate, rtol=1e-8)
    assert_allclose(of_one * (1.0 + direction @ tau2 @ direction), rank_one, atol=1e-11)
    assert_array_equal(with_scatter(rank_one, 0.0 * tau2), rank_one)


def test_distributions() -> None:
    assert f_tail(6.0, 3, 10.0) == pytest.approx(f(3, 10).sf(2.0))
    assert f_tail(6.0, 0, 10.0) == 1.0
    assert_allclose(
        satterthwaite(np.array([0.0, 1.0, 0.5]), 50.0, 2), [50.0, 2.0, 1.0 / (0.25 / 50 + 0.125)]
    )
