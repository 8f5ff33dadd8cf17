"""The relaxed barrier on bounds of every kind.

It is twice differentiable and defined outside the bounds.
"""

from __future__ import annotations

from dataclasses import replace

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
from mjfim.optimize.lq import TangentCurve, Weights
from tests.support.numerics import Array, relative_error

INF = np.inf
S = np.array([-3.0, -0.2, 0.0, 0.04, 0.0499, 0.0501, 0.06, 0.4, 1.0, 3.0])


@pytest.mark.parametrize("delta", [0.1, 1e-4])
def test_the_barrier_is_twice_continuous_where_it_relaxes(delta: float) -> None:
    """Value, slope and curvature agree from both sides; the curvature falls towards the inside and
    is constant outside.
    """
    h = 1e-9
    below, above = (
        relaxed_log_barrier(np.array([delta * (1.0 + sign * h)]), delta) for sign in (-1.0, 1.0)
    )
    for order, (left, right) in enumerate(zip(below, above, strict=True)):
        assert_allclose(left * delta**order, right * delta**order, rtol=0, atol=1e-7)
    curvature = [
        relaxed_log_barrier(np.array([delta * (1.0 + s)]), delta)[2][0] * delta**2
        for s in (-0.1, 0.1)
    ]
    assert curvature == pytest.approx([1.0, 1.1**-2])


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
    bounds, weight = Bounds.from_range(LOWER, UPPER), 0.25
    r = np.array([[2.4, 0.2, 2.7, 5.0, 0.3, -60.0], [3.3, 0.8, 1.1, -5.0, -0.9, -35.0]])

    def value(numbers: Array) -> float:
        total = 0.0
        for i, (low, high, scale) in enumerate(
            zip(bounds.lower, bounds.upper, bounds.scale, strict=True)
        ):
            for s in ((numbers[:, i] - low) / scale, (high - numbers[:, i]) / scale):
                total += weight * float(np.sum(relaxed_log_barrier(s[np.isfinite(s)], delta)[0]))
        return total

    barrier = bounds.barrier(r, delta, weight)
    assert barrier.value == pytest.approx(value(r), rel=1e-12)
    assert (barrier.slope[:, 3] == 0.0).all() and (barrier.curvature[:, 3] == 0.0).all()  # free
    middle = Bounds.from_range(np.array([-1.0]), np.array([3.0])).barrier(np.ones((1, 1)), 0.1, 1.0)
    assert (middle.value, float(middle.slope[0, 0])) == (0.0, 0.0)
    h = 1e-5
    for k, i in np.ndindex(*r.shape):
        e = np.zeros_like(r)
        e[k, i] = h
        size = max(abs(barrier.slope[k, i]), 1.0)
        assert barrier.slope[k, i] == pytest.approx(
            (value(r + e) - value(r - e)) / (2 * h), abs=1e-6 * size
        )
        up, down = (
            bounds.barrier(r + e, delta, weight).slope,
            bounds.barrier(r - e, delta, weight).slope,
        )
        assert_allclose((up - down)[k, i] / (2 * h), barrier.curvature[k, i], rtol=1e-4)


def test_the_largest_relative_move_is_over_observations_and_controls() -> None:
    N, nx, nu = 4, 2, 1
    observations = np.zeros((N, 1, 2, nx + nu))
    observations[2, 0, 1] = [0.0, 3.0, 1.0]  # what is shown there moves by 3 z_1 + v over its scale
    free = Weights.constant(N, np.zeros((nx, nx)), np.zeros((nu, nu)), np.zeros((nx, nx)))
    barrier = BarrierExpansion(
        a=np.zeros((N + 1, nx)),
        b=np.zeros((N, nu)),
        weights=free,
        observations=observations,
        control_scale=np.array([8.0]),
        control_step_scale=np.array([np.inf]),
    )
    z, v = np.zeros((N + 1, nx)), np.zeros((N, nu))
    v[0] = -2.0
    assert barrier.largest_relative_move(TangentCurve(z=z, v=v)) == pytest.approx(
        0.25
    )  # the control alone
    z[2], v[2] = [9.0, -0.4], 0.1
    assert barrier.largest_relative_move(TangentCurve(z=z, v=v)) == pytest.approx(1.1)
    weights = Weights(Q=free.Q + 1.0, S=free.S + 2.0, R=free.R + 3.0, W=free.W + 4.0)
    other = replace(barrier, a=barrier.a + 1.0, b=barrier.b + 2.0, weights=weights)
    double = other.scaled(2.0)
    found = [double.a, double.b, *(getattr(double.weights, name) for name in "QSRW")]
    assert [float(array.flat[0]) for array in found] == [2.0, 4.0, 2.0, 4.0, 6.0, 8.0]
    assert_array_equal(double.observations, observations)  # ranges, not weights


@pytest.mark.parametrize(
    ("s", "slope", "bend", "delta"),
    [(0.3, 5.0, 0.1, 1e-3), (1.0, 0.01, 0.5, 1e-3), (0.5, 300.0, 0.1, 1e-2), (0.2, 30.0, 4.0, 0.1)],
)
def test_models_with_the_curvature_along_their_minimum_lead_to_that_of_the_barrier(
    s: float, slope: float, bend: float, delta: float
) -> None:
    """The minimum of slope x + bend x^2 / 2 + beta(s + x) follows from a few quadratic models."""
    slack = np.array([s])
    _, first, second = relaxed_log_barrier(slack, delta)
    factors = np.ones(1)
    for _ in range(20):
        x = -(slope + first) / (bend + factors * second)
        factors = curvature_factors(slack, x, factors, delta)
    wanted = brentq(
        lambda x: slope + bend * x + relaxed_log_barrier(np.array([s + x]), delta)[1][0], -2.0, 2.0
    )
    assert x[0] == pytest.approx(wanted, rel=1e-3)
    # the curvature at the beginning leads elsewhere
    newton = -(slope + first[0]) / (bend + second[0])
    assert abs(newton - wanted) > 0.2 * abs(wanted)


def test_the_curvature_along_a_step_is_that_at_its_beginning_without_a_step_or_a_bound() -> None:
    slacks = np.array([0.5, 1e-4, -0.02, INF, INF])
    changes = np.array([0.0, 0.0, 0.0, 3.0, -3.0])
    assert_array_equal(curvature_factors(slacks, changes, np.ones(5), 1e-3), np.ones(5))
