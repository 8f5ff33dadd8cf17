"""Problem (8) of the paper with psi among the states: directions and linearisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.excitation.task import DesignTask
from mjfim.optimize.directions import MetricDescent
from mjfim.optimize.lq import LinearRecursion, TangentCurve
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from tests.support.numerics import (
    Array,
    body_task,
    cart_task,
    relative_error,
)

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

TRACKING = {"tracking": {"slide": 0.3, "hinge": 0.1}, "control": 1e-2}
SENSED = {"angle": 0.01, "acc": 0.3, "drive": 0.1}

CORRELATED = ({"outputs": ("angle", "drive"), "covariance": ((1e-4, 5e-4), (5e-4, 0.01))},)


def expanded(task: DesignTask) -> Expansion:
    """Expansion of J about the initial trajectory, with psi among the states."""
    problem = replace(task.problem, extends=True)
    return problem.expand(problem.point(task.initial, CENTRAL_DIFFERENCES))


def both_directions(
    task: DesignTask, psi_weight: float
) -> tuple[Expansion, TangentCurve, TangentCurve]:
    """Expansion, metric descent, extended metric descent with a weight on psi."""
    dt, p, nx = task.dt, len(task.theta), task.space.nx
    Q, R = np.diag(task.tracking + 0.02) * dt, np.diag(task.control_weight) * dt
    wide = np.zeros((nx * (1 + p), nx * (1 + p)))
    wide[:nx, :nx] = Q
    wide[nx:, nx:] = psi_weight * dt * np.eye(nx * p)
    expansion, K = expanded(task), np.zeros((task.samples, task.plant.nu, nx))
    return (
        expansion,
        MetricDescent(Q, R, 3.0 * Q)(expansion, K),
        extended_direction(expansion, K, wide, R, 3.0 * wide),
    )


def extended_direction(e: Expansion, K: Array, Q: Array, R: Array, terminal: Array) -> TangentCurve:
    """The direction zeta of the extended problem."""
    return MetricDescent(Q, R, terminal, weighs_psi=True)(e, K)


CASES = {
    "cart E": lambda f: cart_task(f, cost=TRACKING),
    "cart A": lambda f: cart_task(f, cost={**TRACKING, "criterion": "A"}),
    "cart D sensors": lambda f: cart_task(
        f, "Euler", noise=SENSED, cost={**TRACKING, "criterion": "D"}
    ),
    "cart, correlated, nuisances": lambda f: cart_task(
        f,
        noise=SENSED,
        correlated=CORRELATED,
        nuisance={"initial": 0.05, "bias": 0.1, "delay": 0.02},
    ),
    "free body": body_task,
}


@pytest.mark.parametrize("case", CASES)
def test_without_weight_on_psi_the_extended_direction_is_that_of_metric_descent(
    case: str, tmp_path
) -> None:
    _, plain, wide = both_directions(CASES[case](tmp_path), 0.0)
    assert relative_error(wide.v, plain.v) < 5e-6  # the accuracy of the mixed differences of both
    assert relative_error(wide.z, plain.z) < 5e-6


def test_with_weight_on_psi_the_extended_direction_is_another_descent_direction(tmp_path) -> None:
    expansion, plain, wide = both_directions(CASES["cart E"](tmp_path), 1.0)
    assert relative_error(wide.v, plain.v) > 1e-2
    assert expansion.slope(wide) < 0.0


@pytest.mark.parametrize("case", CASES)
def test_extended_slope_is_the_reduced_slope(case: str, tmp_path) -> None:
    task = CASES[case](tmp_path)
    e, rng = expanded(task), np.random.default_rng(1)
    wide = e.extended
    for _ in range(3):
        v = rng.normal(size=task.control.shape)
        z = LinearRecursion(e.A).forward(np.zeros(e.A.shape[1]), np.einsum("kij,kj->ki", e.B, v))
        full = LinearRecursion(wide.A).forward(
            np.zeros(wide.A.shape[1]), np.einsum("kij,kj->ki", wide.B, v)
        )
        np.testing.assert_allclose(full[:, : z.shape[1]], z, rtol=1e-5, atol=1e-5 * np.abs(z).max())
        assert wide.slope(TangentCurve(z=full, v=v)) == pytest.approx(
            e.slope(TangentCurve(z=z, v=v)), rel=1e-4
        )
        partial = np.zeros_like(full)
        partial[:, : z.shape[1]] = z
        assert wide.slope(TangentCurve(z=partial, v=v)) != pytest.approx(
            e.slope(TangentCurve(z=z, v=v)), rel=0.1
        )


@pytest.mark.parametrize("case", ["cart E", "free body"])
def test_tangent_vectors_of_the_extended_system_are_differences_of_psi_between_trajectories(
    case: str, tmp_path
) -> None:
    task = CASES[case](tmp_path)
    wide, nx, p = expanded(task).extended, task.space.nx, len(task.theta)
    v, h = np.cos(9.0 * task.t)[:, None] * np.ones(task.plant.nu), 1e-2
    full = LinearRecursion(wide.A).forward(
        np.zeros(nx * (1 + p)), np.einsum("kij,kj->ki", wide.B, v)
    )
    up, down = (task.plant.simulate(task.theta, task.control + s * h * v) for s in (1, -1))
    psi = [task.plant.derivatives.sensitivity(task.theta, curve).psi for curve in (up, down)]
    change = np.swapaxes(psi[0] - psi[1], 1, 2).reshape(task.samples + 1, p, nx) / (2 * h)
    moved = full[:, nx:].reshape(task.samples + 1, p, nx)
    for j in range(p):
        assert relative_error(moved[:, j], change[:, j]) < 1e-3


def test_x_does_not_depend_on_psi_in_the_extended_system(tmp_path) -> None:
    task = CASES["cart E"](tmp_path)
    wide = expanded(task).extended
    np.testing.assert_array_equal(wide.A[:, :4, 4:], 0.0)
    L = task.plant.derivatives.linearize(task.theta, task.initial)
    assert relative_error(wide.A[:, :4, :4], L.A) < 1e-5
    assert relative_error(wide.B[:, :4], L.B) < 1e-5


def test_an_expansion_without_psi_is_refused(tmp_path) -> None:
    task = cart_task(tmp_path)
    plain = task.problem.expand(task.problem.point(task.initial, CENTRAL_DIFFERENCES))
    assert plain.extended is None
    with pytest.raises(ValueError, match="extended"):
        extended_direction(plain, np.zeros((50, 1, 4)), np.eye(16), np.eye(1), np.eye(16))
