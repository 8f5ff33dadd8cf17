"""Losses against those of SciPy.

Values along a line through points with outliers are equal, and weights follow from values.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.optimize import least_squares

from mjfim.optimize.condensed_least_squares import RobustLoss
from tests.support.numerics import Array, richardson

Kind = Literal["linear", "huber", "soft_l1", "cauchy"]
KINDS = get_args(Kind)
T = np.linspace(0.0, 1.0, 80)


def points(seed: int) -> Array:
    """Points of a line with unit noise; every eighth point is far off to one side."""
    rng = np.random.default_rng(seed)
    y = 2.0 - 5.0 * T + rng.standard_normal(len(T))
    y[::8] += rng.uniform(8.0, 30.0, len(y[::8]))
    return y


def residuals(x: Array, y: Array) -> Array:
    """Residuals of the points from a line."""
    return x[0] + x[1] * T - y


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("scale", [0.7, 3.0])
def test_the_value_is_that_of_scipy(kind: Kind, scale: float) -> None:
    """Far from the optimum, and at it."""
    loss, y = RobustLoss(kind=kind, scale=scale), points(0)
    for evaluations in (1, 100):
        found = least_squares(
            residuals, [5.0, -9.0], args=(y,), loss=kind, f_scale=scale, max_nfev=evaluations
        )
        assert 0.5 * loss.value(residuals(found.x, y)) == pytest.approx(found.cost, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_the_weight_follows_from_the_value(kind: Kind) -> None:
    """Half of the derivative of the value is the squared weight times the residual.

    This holds below and above the scale.
    """
    loss = RobustLoss(kind=kind, scale=2.0)
    for r in (-40.0, -2.5, -1.0, -1e-3, 0.3, 1.9, 2.1, 7.0, 1e3):
        slope = 0.5 * richardson(
            lambda h, r=r: loss.value(np.array([r + h])), 1e-3 * max(abs(r), 0.1)
        )
        weight = loss.weight(np.array([r]))[0]
        assert weight**2 * r == pytest.approx(slope, rel=1e-6)
    assert loss.weight(np.zeros((3, 2))).shape == (3, 2)
    assert_array_equal(loss.weight(np.zeros(3)), 1.0)


@pytest.mark.parametrize("scale", [1.0, 3.0, 4.5])
def test_the_mean_square_of_inliers(scale: float) -> None:
    """Compare with a million normal numbers; a linear loss has no outliers."""
    r = np.random.default_rng(2).standard_normal(1_000_000)
    for kind in KINDS:
        loss = RobustLoss(kind=kind, scale=scale)
        assert loss.outlier_threshold == (np.inf if kind == "linear" else max(scale, 3.0))
        assert loss.inlier_mean_square == pytest.approx(
            np.mean(r[np.abs(r) <= loss.outlier_threshold] ** 2), rel=5e-3
        )
