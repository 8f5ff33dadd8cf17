"""Problem (8) of the paper with psi among the states: directions and linearisation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

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


def directions(task: DesignTask, psi_weight: float) -> tuple[Expansion, TangentCurve, TangentCurve]:
    """Expansion, metric descent, and metric descent with a weight on psi."""
    dt, nx = task.dt, task.space.nx
    Q, R = np.diag(task.tracking + 0.02) * dt, np.diag(task.control_weight) * dt
    of_psi = np.full(nx * len(task.theta), psi_weight * dt)
    wide = np.diag(np.concatenate([np.diag(Q), of_psi]))
    expansion, K = expanded(task), np.zeros((task.samples, task.plant.nu, nx))
    plain, extended = (
        MetricDescent(weight, R, 3.0 * weight, weighs_psi=weight is wide)(expansion, K)
        for weight in (Q, wide)
    )
    return expansion, plain, extended


LATE = {"initial": 0.05, "bias": 0.1, "delay": 0.02}
CASES = {
    "cart E": lambda f: cart_task(f, cost=TRACKING),
    "cart D sensors": lambda f: cart_task(
        f, "Euler", noise=SENSED, cost={**TRACKING, "criterion": "D"}
    ),
    "cart, correlated, nuisances": lambda f: cart_task(
        f, noise=SENSED, correlated=CORRELATED, nuisance=LATE
    ),
    "free body": body_task,
}


@pytest.mark.parametrize("case", CASES)
def test_without_weight_on_psi_the_extended_direction_is_that_of_metric_descent(
    case: str, tmp_path
) -> None:
    """With a weight on psi, it is another descent direction."""
    task = CASES[case](tmp_path)
    _, plain, wide = directions(task, 0.0)
    # The accuracy of the mixed differences of both.
    assert relative_error(wide.v, plain.v) < 5e-6
    assert relative_error(wide.z, plain.z) < 5e-6
    expansion, plain, wide = directions(task, 1.0)
    assert relative_error(wide.v, plain.v) > 1e-2
    assert expansion.slope(wide) < 0.0


@pytest.mark.parametrize("case", CASES)
def test_extended_slope_is_the_reduced_slope(case: str, tmp_path) -> None:
    task = CASES[case](tmp_path)
    e, rng = expanded(task), np.random.default_rng(1)
    open_loop = np.zeros((task.samples, task.plant.nu, task.space.nx))
    for v in rng.normal(size=(3, *task.control.shape)):
        short, full = e.lift(open_loop, v), response(e.extended, v)
        z = full[:, : task.space.nx]
        assert_allclose(z, short.z, rtol=1e-5, atol=1e-5 * np.abs(z).max())
        slope = e.slope(short)
        assert e.extended.slope(TangentCurve(z=full, v=v)) == pytest.approx(slope, rel=1e-4)

        # The change of psi matters.
        full[:, task.space.nx :] = 0.0
        assert e.extended.slope(TangentCurve(z=full, v=v)) != pytest.approx(slope, rel=0.1)


def response(wide: Expansion, v: Array) -> Array:
    """States of the extended system after a change of the control."""
    zero = np.zeros(wide.A.shape[1])
    return LinearRecursion(wide.A).forward(zero, np.einsum("kij,kj->ki", wide.B, v))


def test_an_expansion_without_psi_is_refused(tmp_path) -> None:
    task = cart_task(tmp_path)
    plain = task.problem.expand(task.problem.point(task.initial, CENTRAL_DIFFERENCES))
    assert plain.extended is None
    with pytest.raises(ValueError, match="extended"):
        MetricDescent(np.eye(16), np.eye(1), np.eye(16), weighs_psi=True)(
            plain, np.zeros((50, 1, 4))
        )
