"""Linear recursions, regulator and descent against plain loops and dense normal equations."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from mjfim.optimize.lq import (
    CurveCoordinates,
    LinearRecursion,
    RiccatiSolution,
    TangentCurve,
    Weights,
    amplification_in_best_units,
    largest_amplification,
    regulator,
)
from tests.support.lq import positive, random_system, random_weights


def form(weights: Weights, z: np.ndarray, v: np.ndarray) -> float:
    """The quadratic form of one tangent curve."""
    changes = np.diff(v, axis=0, prepend=0.0, append=0.0)
    of_states = np.einsum("ki,kij,kj->", z, weights.Q, z)
    of_controls = np.einsum("ku,kuw,kw->", v, weights.R, v) + np.sum(weights.W * changes**2)
    return of_states + of_controls + 2.0 * np.einsum("ku,kui,ki->", v, weights.S, z[:-1])


@pytest.mark.parametrize("steps", [False, True], ids=["free steps", "weighted steps"])
@pytest.mark.parametrize("feedback", [False, True])
def test_many_tangent_curves_at_once_are_those_one_by_one(steps: bool, feedback: bool) -> None:
    N, nx, nu = 8, 3, 2
    rng = np.random.default_rng(15)
    A, B = random_system(rng, N, nx, nu)
    weights = random_weights(rng, N, nx, nu, steps)
    K = feedback * rng.normal(size=(N, nu, nx))
    a, b = rng.normal(size=(4, N + 1, nx)), rng.normal(size=(4, N, nu))

    # The curves follow the dynamics, their coordinates are those stated, and gradients are dual.
    coordinates = CurveCoordinates(A=A, B=B, K=K)
    curves = coordinates.lift(b)
    assert_allclose(coordinates.coordinate(curves), b, rtol=0, atol=1e-9)
    moved = np.einsum("kij,nkj->nki", A, curves.z[:, :-1]) + np.einsum("kij,nkj->nki", B, curves.v)
    assert_allclose(curves.z[:, 1:], moved, rtol=0, atol=1e-9)
    slopes = np.einsum("nki,mki->nm", a, curves.z) + np.einsum("nki,mki->nm", b, curves.v)
    assert_allclose(np.einsum("nki,mki->nm", coordinates.gradient(a, b), b), slopes, rtol=1e-9)

    solution = RiccatiSolution.solve(A, B, weights)
    minima, forces = solution.descent(a, b), weights.half_gradient(curves)
    for i in range(4):
        minimum, curve = solution.descent(a[i], b[i]), TangentCurve(z=curves.z[i], v=curves.v[i])
        pairs = zip(forces, weights.half_gradient(curve), strict=True)
        for many, one in ((minima.z, minimum.z), (minima.v, minimum.v), *pairs):
            assert_allclose(many[i], one, rtol=1e-9, atol=1e-9)


def assert_minimum(cost: Callable[[np.ndarray], float], best: np.ndarray) -> None:
    """A quadratic cost rises equally in both directions from its minimum."""
    for unit in np.eye(best.size).reshape(-1, *best.shape):
        rise = cost(best + unit) - cost(best)
        assert rise > 0.0
        assert cost(best - unit) - cost(best) == pytest.approx(rise, rel=1e-6)


def test_regulator_gain_minimises_its_cost_over_a_finite_time_varying_horizon() -> None:
    rng = np.random.default_rng(7)
    A, B = random_system(rng, 9, 3, 2)
    Q, R, terminal = positive(rng, 3), positive(rng, 2), positive(rng, 3)
    weights = Weights.constant(9, Q, R, terminal)
    assert_array_equal(weights.Q, [*[Q] * 9, terminal])
    assert_array_equal(weights.R, [R] * 9)
    assert not weights.S.any() and not weights.W.any()
    K, z0 = regulator(A, B, Q, R, terminal), rng.normal(size=3)

    def cost(v: np.ndarray) -> float:
        z = LinearRecursion(A).forward(z0, np.einsum("kij,kj->ki", B, v))
        return form(weights, z, v)

    z = LinearRecursion(A - B @ K).forward(z0, np.zeros((9, 3)))
    assert_minimum(cost, -np.einsum("kui,ki->ku", K, z[:-1]))


@pytest.mark.parametrize("steps", [False, True], ids=["free steps", "weighted steps"])
@pytest.mark.parametrize("sizes", [(1, 2, 1), (2, 1, 1), (8, 3, 2), (25, 4, 1)])
def test_weighted_descent_is_the_minimum(sizes: Any, steps: bool) -> None:
    N, nx, nu = sizes
    rng = np.random.default_rng(N + 10 * nx)
    A, B = random_system(rng, N, nx, nu)
    a, b = rng.normal(size=(N + 1, nx)), rng.normal(size=(N, nu))
    weights = random_weights(rng, N, nx, nu, steps)

    def response(v: np.ndarray) -> np.ndarray:
        return LinearRecursion(A).forward(np.zeros(nx), np.einsum("kij,kj->ki", B, v))

    def cost(v: np.ndarray) -> float:
        z = response(v)
        return (np.sum(a * z) + np.sum(b * v)) + 0.5 * form(weights, z, v)

    zeta = RiccatiSolution.solve(A, B, weights).descent(a, b)
    assert_minimum(cost, zeta.v)
    assert_allclose(zeta.z, response(zeta.v), rtol=0, atol=1e-8 * max(np.abs(zeta.z).max(), 1.0))


def test_a_control_weight_that_is_not_positive_is_refused() -> None:
    A, B, flat = np.ones((3, 1, 1)), np.ones((3, 1, 1)), np.zeros((1, 1))
    with pytest.raises(np.linalg.LinAlgError, match="positive"):
        regulator(A, B, flat, np.array([[-1.0]]), flat)
    with pytest.raises(np.linalg.LinAlgError, match="positive"):
        RiccatiSolution.solve(A, B, Weights.constant(3, flat, flat, flat))


@pytest.mark.parametrize(("rows", "rhs"), [(3, "c"), (5, "c"), (4, "a"), (6, "a")])
def test_recursion_refuses_arrays_of_the_wrong_length(rows: int, rhs: str) -> None:
    recursion, wrong = LinearRecursion(np.ones((4, 2, 2))), np.ones((rows, 2))
    solve = recursion.adjoint if rhs == "a" else partial(recursion.forward, np.ones(2))
    with pytest.raises(ValueError, match="needs"):
        solve(wrong)


def test_growth_is_the_largest_amplification_from_the_start_or_to_the_end() -> None:
    rng = np.random.default_rng(11)
    A = 1.1 * np.linalg.qr(rng.standard_normal((12, 3, 3)))[0]
    product, largest = np.eye(3), 1.0
    for step in A:
        product = step @ product
        largest = max(largest, np.linalg.norm(product, 2))
    assert largest_amplification(A) == pytest.approx(largest)
    late = np.concatenate([0.01 * A, 3.0 * A])  # forgets the start, then explodes
    assert largest_amplification(late) == pytest.approx(3.3**12)


def test_growth_in_best_units_counts_neither_drift_nor_slow_oscillation() -> None:
    """It is that of an unstable motion."""
    # The position of a cart that keeps its speed for 100 s.
    drift = np.tile([[1.0, 0.1], [0.0, 1.0]], (1000, 1, 1))
    assert largest_amplification(drift) > 99.0
    assert amplification_in_best_units(drift) == pytest.approx(1.0)

    # A pendulum that swings once a minute.
    turn = 2.0 * np.pi / 60.0
    cosine, sine = np.cos(0.5 * turn), np.sin(0.5 * turn)
    swing = np.tile([[cosine, sine / turn], [-turn * sine, cosine]], (240, 1, 1))
    assert largest_amplification(swing) > 9.0
    assert amplification_in_best_units(swing) == pytest.approx(2.0, rel=1e-2)

    # An inverted pendulum, whose deviations grow by a factor of e in 0.3 s.
    rate = 1.0 / 0.3
    cosh, sinh = np.cosh(0.01 * rate), np.sinh(0.01 * rate)
    fall = np.tile([[cosh, sinh / rate], [rate * sinh, cosh]], (200, 1, 1))
    assert amplification_in_best_units(fall) == pytest.approx(np.exp(2.0 * rate), rel=1e-6)

    # Deviations that overflow have grown without a bound.
    assert np.isinf(amplification_in_best_units(np.full((400, 1, 1), 10.0)))


def test_growth_in_best_units_of_many_stable_oscillators_needs_no_feedback() -> None:
    # Twenty equal masses in a row, each coupled to its neighbours by a spring, without damping.
    n = 20
    stiffness = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    zero = np.zeros((n, n))
    step = expm(0.5 * np.block([[zero, np.eye(n)], [-stiffness, zero]]))
    chain = np.tile(step, (60, 1, 1))
    assert amplification_in_best_units(chain) < 10.0

    # The same in other units, with the sizes of its own.
    units = np.repeat([1e3, 1e-2], n)
    other = chain * units / units[:, None]
    assert amplification_in_best_units(other, 1.0 / units) < 10.0
