"""`log J + mu B`: its slope for every criterion, and the reevaluation of points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.search.interior_problem import DIVERGED_POINT, InteriorProblem, values_of
from mjfim.excitation.task import DesignTask
from mjfim.optimize.projection_operator import Expansion
from tests.support.limits import along_control, directions_of, slope_check
from tests.support.numerics import Array, cart_task

LIMITS = {
    "control": {"force": (-5.0, 4.5)},
    "position": {"slide": (-0.4, 0.35), "hinge": (1.0, 6.0)},
    "velocity": 3.0,
    "control_rate": 60.0,
}
COSTS = {
    "E": {},
    "smooth E": {},
    "A": {"cost": {"criterion": "A", "control": 1e-2}},
    "D": {"cost": {"criterion": "D", "control": 1e-2}},
    "D, heavier": {"cost": {"criterion": "D", "information": 3.0, "tracking": {"slide": 0.5}}},
    "c": {"cost": {"criterion": "c", "combination": {"m": 1.0, "l": -1.0}}},
    "robust": {
        "robust": {"samples": 2},
        "cost": {"criterion": "A"},
        "parameters": {
            "m": {"target": "body/bob:mass", "prior": 0.2},
            "c": {"target": "joint/hinge:damping", "prior": 0.1},
        },
    },
}


def problem_of(name: str, folder: Path, **tables: Any) -> tuple[DesignTask, InteriorProblem]:
    """The cart-pendulum within limits, some of which its initial control violates."""
    task = cart_task(folder, limits=LIMITS, **{**COSTS[name], **tables}).relaxed()
    base = task.problem
    if name == "smooth E":
        base = replace(base, information=replace(base.information, power=40.0))
    return task, InteriorProblem(base=base, constraints=constraint_set_of(task), mu=0.2, delta=0.05)


def check(
    task: DesignTask, problem: InteriorProblem, expansion: Expansion, h: float = 2e-4
) -> float:
    """Largest relative error of the slope of the problem's value along random controls."""
    gradient = expansion.gradient(np.zeros((task.samples, 1, task.space.nx)))

    def value(ctrl: Array) -> float:
        return problem.value(problem.point(ctrl))

    return slope_check(task, gradient, value, directions_of(task, 4), h)


@pytest.mark.parametrize("name", COSTS)
def test_the_value_is_stated_and_its_slope_agrees_with_simulated_controls(
    name: str, tmp_path: Path
) -> None:
    """With the barrier, whose expansion is also given separately, and without it."""
    task, problem = problem_of(name, tmp_path)
    point = problem.point(task.control)
    J = task.problem.point(task.initial).cost
    if name == "smooth E":
        assert point.point.cost > J  # at most p^(1/q) above it
        J = point.point.cost
    # The merit is log J; for D-optimality it is J over the number of parameters and the weight.
    weight = 3.0 if "heavier" in name else 1.0
    expected = J / (3 * weight) if "D" in name else np.log(J)
    assert point.merit == pytest.approx(expected, rel=1e-4)
    values = along_control(task, problem.constraints)
    assert point.barrier == pytest.approx(problem.constraints.value(values, 0.05), rel=1e-12)
    assert problem.value(point) == pytest.approx(point.merit + 0.2 * point.barrier, rel=1e-12)
    assert problem.size(point) == 1.0

    expansion = problem.expand(point)
    assert check(task, problem, expansion) < 5e-3
    barrier = expansion.barrier
    alone = replace(expansion, a=expansion.a - barrier.a, b=expansion.b - barrier.b)
    assert check(task, replace(problem, mu=0.0), alone) < 5e-3
    twice = replace(problem, mu=0.4).expand(point).barrier
    assert_allclose(twice.b, 2.0 * barrier.b, rtol=1e-12)


def test_a_reevaluated_point_equals_that_of_the_new_problem(tmp_path: Path) -> None:
    """For another mu, delta, constraints or criterion, without an engine step."""
    task, problem = problem_of("E", tmp_path)
    point = problem.point(task.control)
    tight = problem.constraints.tightened({"control": 0.1, "position": 0.05, "velocity": 0.2})
    smooth = replace(problem.base, information=replace(problem.base.information, power=10.0))
    for other in (
        replace(problem, mu=0.02, delta=0.006),
        replace(problem, constraints=tight),
        replace(problem, base=smooth),
        replace(problem, base=smooth, constraints=tight, mu=1e-3, delta=3e-4),
    ):
        begun = task.plant.simulator.steps
        again = other.reevaluate(point)
        assert task.plant.simulator.steps == begun
        fresh = other.point(task.control)
        assert (again.merit, again.barrier) == (fresh.merit, fresh.barrier)
        assert other.value(again) == other.value(fresh) != problem.value(point)
        e, f = other.expand(again), other.expand(fresh)
        assert_allclose(e.a, f.a, rtol=1e-9)
        assert_allclose(e.b, f.b, rtol=1e-9)


def test_a_diverged_trial_has_infinite_value(tmp_path: Path) -> None:
    task, problem = problem_of("E", tmp_path)
    for own in (problem, replace(problem, with_cost=False)):
        point = own.point(1e12 * task.control)
        assert point is DIVERGED_POINT
        assert own.value(point) == np.inf and own.reevaluate(point) is point
        for ask in (values_of, own.expand):
            with pytest.raises(ValueError, match="diverged"):
                ask(point)


def test_a_projected_point_is_simulated_open_loop(tmp_path: Path) -> None:
    """Feedback changes the control; the point is that of the changed control."""
    task, problem = problem_of("E", tmp_path)
    point = problem.point(task.control)
    expansion = problem.expand(point)
    way, open_loop = np.sin(7.0 * task.t)[:, None], np.zeros((task.samples, 1, 4))
    for K in (open_loop, open_loop + np.array([1.0, 0.5, 0.3, 0.2])):
        zeta = expansion.lift(K, way)
        moved = problem.project(point, zeta, 0.1, K)
        assert problem.value(moved) == problem.value(problem.point(moved.ctrl))
        change = np.abs(moved.ctrl - task.control - 0.1 * zeta.v).max()
        assert change < (1e-12 if K is open_loop else 0.05)
        assert K is open_loop or change > 1e-12
        difference, state = problem.difference(moved, point), values_of(moved).trajectory.state
        assert_allclose(difference.v, moved.ctrl - task.control, rtol=0, atol=1e-15)
        assert_allclose(difference.z, state - task.initial.state, rtol=0, atol=1e-12)
    assert problem.refine(point) is None
