"""The relaxed barrier on bounds of every kind.

It is twice differentiable and defined outside the bounds.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

from mjfim.optimize.cost_models import (
    BarrierExpansion,
    Bounds,
    curvature_factors,
    relaxed_log_barrier,
)
from mjfim.optimize.lq import TangentCurve
from tests.support.lq import random_weights
from tests.support.numerics import Array, relative_error

INF = np.inf
S = np.array([-3.0, -0.2, 0.0, 0.04, 0.0499, 0.0501, 0.06, 0.4, 1.0, 3.0])


@pytest.mark.parametrize("delta", [0.05, 0.3])
def test_derivatives_agree_with_differences_on_both_sides(delta: float) -> None:
    h = 1e-6
    value, slope, curvature = relaxed_log_barrier(S, delta)
    up, down = relaxed_log_barrier(S + h, delta), relaxed_log_barrier(S - h, delta)
    assert relative_error(slope, (up[0] - down[0]) / (2 * h)) < 1e-8
    smooth = np.abs(S - delta) > 2 * h
    assert relative_error(curvature[smooth], ((up[1] - down[1]) / (2 * h))[smooth]) < 1e-7
    assert np.isfinite(value).all()
    assert (slope < 0.0).all() and (curvature > 0.0).all()


def test_the_barrier_is_the_logarithm_inside_and_grows_without_limit_outside() -> None:
    inside = np.array([0.2, 0.7, 1.0, 2.5])
    assert_array_equal(relaxed_log_barrier(inside, 0.1)[0], -np.log(inside))
    outside = relaxed_log_barrier(np.array([-1e6, -10.0, -1.0, 0.0, 0.1]), 0.1)[0]
    assert (np.diff(outside) < 0.0).all()
    assert np.isfinite(outside).all()
    # at the bound itself: 1/2 (4 - 1) - log delta
    assert relaxed_log_barrier(np.array([0.0]), 0.1)[0][0] == pytest.approx(1.5 - np.log(0.1))


LOWER = np.array([-1.0, -INF, 2.0, -INF, -0.5, -INF])
UPPER = np.array([3.0, 0.5, INF, INF, INF, -40.0])


def test_the_scale_is_half_of_the_range_or_the_magnitude_of_the_only_bound() -> None:
    """It is at least 1 with a single bound, and 1 without bounds."""
    assert_array_equal(Bounds.from_range(LOWER, UPPER).scale, [2.0, 1.0, 2.0, 1.0, 1.0, 40.0])


def test_margins_are_distances_to_the_nearer_bound() -> None:
    r = np.array([[2.5, 0.4, 2.0, 1e9, 7.0, -41.0], [-1.5, 0.6, 1.0, -1e9, -0.5, -39.0]])
    expected = [[0.5, 0.1, 0.0, INF, 7.5, 1.0], [-0.5, -0.1, -1.0, INF, 0.0, -1.0]]
    assert_allclose(Bounds.from_range(LOWER, UPPER).margin(r), expected, atol=1e-12)


def test_tightening_moves_both_bounds_inwards_and_keeps_the_scale() -> None:
    bounds = Bounds.from_range(LOWER, UPPER)
    shares = np.array([0.1, 0.2, 0.5, 0.3, 0.0, 0.01])
    inner = bounds.tightened(shares)
    assert_allclose(inner.lower, [-0.8, -INF, 3.0, -INF, -0.5, -INF])
    assert_allclose(inner.upper, [2.8, 0.3, INF, INF, INF, -40.4])
    assert_array_equal(inner.scale, bounds.scale)


@pytest.mark.parametrize("delta", [0.1, 1e-3])
def test_the_barrier_of_bounds_is_the_sum_over_both_bounds(delta: float) -> None:
    """Its derivatives by every number, inside and outside, agree with differences."""
    bounds, h = Bounds.from_range(LOWER, UPPER), 1e-5
    r = np.array([[2.4, 0.2, 2.7, 5.0, 0.3, -60.0], [3.3, 0.8, 1.1, -5.0, -0.9, -35.0]])

    def values(numbers: Array) -> Array:
        sides = np.array([numbers - LOWER, UPPER - numbers]) / bounds.scale
        beta = relaxed_log_barrier(np.where(np.isfinite(sides), sides, 1.0), delta)[0]
        return 0.25 * beta.sum(axis=0)

    value, slope, curvature = bounds.barrier(r, delta, 0.25)
    up, down = (bounds.barrier(r + move, delta, 0.25)[1] for move in (h, -h))
    assert value == pytest.approx(values(r).sum(), rel=1e-12)
    difference = (values(r + h) - values(r - h)) / (2 * h)
    assert_allclose(slope, difference, rtol=1e-6, atol=1e-6)
    assert_allclose(curvature, (up - down) / (2 * h), rtol=1e-4)
    assert not slope[:, 3].any() and not curvature[:, 3].any()  # no bound
    middle = Bounds.from_range(np.array([-1.0]), np.array([3.0])).barrier(np.ones((1, 1)), 0.1, 1.0)
    assert (middle[0], middle[1].item()) == (0.0, 0.0)


def test_the_largest_relative_move_is_over_observations_and_controls() -> None:
    N, nx, nu = 4, 2, 1
    observations = np.zeros((N, 1, 2, nx + nu))
    observations[2, 0, 1] = [0.0, 3.0, 1.0]  # what is shown there moves by 3 z_1 + v over its scale
    z, v = np.zeros((N + 1, nx)), np.zeros((N, nu))
    barrier = BarrierExpansion(
        a=z + 1.0,
        b=v + 2.0,
        weights=random_weights(np.random.default_rng(0), N, nx, nu, steps=True),
        observations=observations,
        control_scale=np.array([8.0]),
        control_step_scale=np.array([np.inf]),
    )
    v[0] = -2.0  # the control alone
    assert barrier.largest_relative_move(TangentCurve(z=z, v=v)) == pytest.approx(0.25)
    z[2], v[2] = [9.0, -0.4], 0.1
    assert barrier.largest_relative_move(TangentCurve(z=z, v=v)) == pytest.approx(1.1)

    # Another weight of the barrier changes no range.
    double = barrier.scaled(2.0)
    assert (double.a.flat[0], double.b.flat[0]) == (2.0, 4.0)
    for name in "QSRW":
        assert_array_equal(getattr(double.weights, name), 2.0 * getattr(barrier.weights, name))
    assert_array_equal(double.observations, observations)


@pytest.mark.parametrize(
    ("s", "slope", "bend", "delta"),
    [(0.3, 5.0, 0.1, 1e-3), (1.0, 0.01, 0.5, 1e-3), (0.5, 300.0, 0.1, 1e-2), (0.2, 30.0, 4.0, 0.1)],
)
def test_models_with_the_curvature_along_their_minimum_lead_to_that_of_the_barrier(
    s: float, slope: float, bend: float, delta: float
) -> None:
    """The minimum of slope x + bend x^2 / 2 + beta(s + x) follows from a few quadratic models."""
    slack, factors = np.array([s]), np.ones(1)
    _, first, second = relaxed_log_barrier(slack, delta)
    newton = -(slope + first) / (bend + second)
    for _ in range(20):
        x = -(slope + first) / (bend + factors * second)
        factors = curvature_factors(slack, x, factors, delta)

    def rise(x: float) -> float:
        return slope + bend * x + relaxed_log_barrier(slack + x, delta)[1][0]

    wanted = brentq(rise, -2.0, 2.0)
    assert x[0] == pytest.approx(wanted, rel=1e-3)
    assert abs(newton[0] - wanted) > 0.2 * abs(
        wanted
    )  # the curvature at the beginning leads elsewhere
