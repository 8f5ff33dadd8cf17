"""Algorithm 1 on a pendulum written in NumPy, with exact derivatives.

Only the algorithm is tested, without MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize

from mjfim.optimize import projection_operator
from mjfim.optimize.directions import LBFGS, MetricDescent
from mjfim.optimize.lq import TangentCurve, amplification_in_best_units
from mjfim.optimize.projection_operator import (
    Direction,
    Expansion,
    Iterate,
    Regulator,
    line_search,
    optimize,
)
from mjfim.parallel.budget import Budget, StopReason
from mjfim.records.design import Status
from tests.support.numerics import Array

DT, N = 0.05, 60
START, GOAL = np.array([0.4, 0.0]), np.array([np.pi, 0.0])
Q, R, TERMINAL = np.diag([1.0, 0.1]), np.array([[0.05]]), np.diag([20.0, 5.0])


@dataclass(frozen=True, eq=False)
class Curve:
    """A trajectory of the pendulum.

    Attributes:
        x: (N+1, 2) angle and rate.
        u: (N, 1) torque.
    """

    x: Array
    u: Array


def step(x: Array, u: Array) -> Array:
    """One sample of a damped pendulum; the angle is zero when it hangs down."""
    rate = x[1] + DT * (-np.sin(x[0]) - 0.1 * x[1] + u[0])
    return np.array([x[0] + DT * rate, rate])


def jacobians(x: Array) -> tuple[Array, Array]:
    """Derivatives of `step` by state and control."""
    bend = -DT * np.cos(x[0])
    drag = 1.0 - 0.1 * DT
    return np.array([[1.0 + DT * bend, DT * drag], [bend, drag]]), np.array([[DT * DT], [DT]])


@dataclass
class Pendulum:
    """Swing-up with a quadratic cost, as a problem that keeps every evaluated value.

    Attributes:
        sign: Sign of the gradient of `expand`.
        wall: Size of the torque above which a trial diverges.
        refinements: Number of times that `refine` returns a more accurate point.
        values: Every value that was asked for.
        gammas: Every step length that was tried.
    """

    sign: float = 1.0
    wall: float = np.inf
    refinements: int = 0
    values: list[float] = field(default_factory=list)
    gammas: list[float] = field(default_factory=list)

    def rollout(self, u: Array) -> Curve:
        """Trajectory without feedback."""
        return Curve(np.array(list(accumulate(u, step, initial=START))), u)

    def value(self, point: Curve) -> float:
        """The quadratic cost, infinite beyond the wall."""
        d, u = point.x - GOAL, point.u
        running = DT * (np.einsum("ki,ij,kj->", d[:-1], Q, d[:-1]) + R[0, 0] * np.sum(u**2))
        whole = 0.5 * (running + d[-1] @ TERMINAL @ d[-1])
        self.values.append(whole if np.abs(u).max() <= self.wall else np.inf)
        return self.values[-1]

    def size(self, point: Curve) -> float:
        """The cost itself."""
        return self.value(point)

    def expand(self, point: Curve) -> Expansion:
        """Exact first derivatives."""
        A, B = (np.array(m) for m in zip(*(jacobians(x) for x in point.x[:-1]), strict=True))
        a = DT * (point.x - GOAL) @ Q
        a[0], a[N] = 0.0, TERMINAL @ (point.x[N] - GOAL)
        return Expansion(A=A, B=B, a=self.sign * a, b=self.sign * DT * point.u @ R)

    def project(self, point: Curve, zeta: TangentCurve, gamma: float, K: Array) -> Curve:
        """The projection operator, sample by sample."""
        self.gammas.append(gamma)
        x, u = [START], []
        for k in range(N):
            u.append(
                point.u[k] + gamma * zeta.v[k] + K[k] @ (point.x[k] + gamma * zeta.z[k] - x[-1])
            )
            x.append(step(x[-1], u[-1]))
        return Curve(np.array(x), np.array(u))

    def difference(self, new: Curve, old: Curve) -> TangentCurve:
        """Difference of states and torques."""
        return TangentCurve(z=new.x - old.x, v=new.u - old.u)

    def refine(self, point: Curve) -> Curve | None:
        """The point itself while refinements are left, otherwise None."""
        if self.refinements == 0:
            return None
        self.refinements -= 1
        return replace(point)


def start(problem: Pendulum) -> Curve:
    """A small torque."""
    return problem.rollout(0.5 * np.sin(np.arange(N) * DT)[:, None])


METRIC = MetricDescent(Q * DT, R * DT, TERMINAL)
REGULATOR = Regulator(Q=np.eye(2) * DT, R=np.eye(1) * DT, terminal=np.eye(2))


def run(problem: Any, direction: Direction, **changes: Any) -> list[Iterate[Curve]]:
    """All iterates of a run."""
    settings = {
        "regulate": REGULATOR,
        "budget": Budget(),
        "tolerance": 1e-12,
        "max_iterations": 200,
        **changes,
    }
    return list(optimize(problem, start(problem), direction, **settings))


def begun(problem: Pendulum, direction: Direction) -> tuple[Curve, Expansion, Array, TangentCurve]:
    """The start, its expansion, the gains of the regulator there, and the direction."""
    point = start(problem)
    expansion = problem.expand(point)
    K = REGULATOR.gain(expansion)
    return point, expansion, K, direction(expansion, K)


@pytest.fixture(scope="module")
def optimum() -> float:
    """The smallest cost over controls, by SciPy."""
    problem = Pendulum()

    def cost(u: Array) -> tuple[float, Array]:
        point = problem.rollout(u[:, None])
        gradient = problem.expand(point).gradient(np.zeros((N, 1, 2)))
        return problem.value(point), gradient[:, 0]

    u = start(problem).u[:, 0]
    options = {"gtol": 1e-9, "maxiter": 800}
    return minimize(cost, u, jac=True, method="BFGS", options=options).fun


DIRECTIONS = {
    "metric": lambda: METRIC,
    "lbfgs": lambda: LBFGS(R * DT),
}


@pytest.mark.parametrize("method", DIRECTIONS)
@pytest.mark.parametrize("period", [1, 7, 1000])
def test_the_optimum_does_not_depend_on_how_often_the_regulator_is_renewed(
    method: str, period: int, optimum: float
) -> None:
    iterates = run(Pendulum(), DIRECTIONS[method](), regulate=replace(REGULATOR, period=period))
    assert iterates[-1].status is Status.CONVERGED
    assert iterates[-1].value == pytest.approx(optimum, rel=1e-7)

    # The cost falls, and only the last iterate has a status.
    assert all(b.value < a.value for a, b in pairwise(iterates))
    assert [i.index for i in iterates] == list(range(len(iterates)))
    assert not any(i.status for i in iterates[:-1])
    assert iterates[0].gamma == 0.0
    assert all(0.0 < i.gamma <= 1.0 for i in iterates[1:])


def test_convergence_compares_the_slope_with_the_cost() -> None:
    for tolerance in (1e-2, 1e-5):
        iterates = run(Pendulum(), METRIC, tolerance=tolerance)
        assert [i.slope <= tolerance * i.value for i in iterates].index(True) == len(iterates) - 1


@pytest.mark.parametrize("limit", [0, 1, 3])
def test_max_iterations_is_an_outcome_and_counts_accepted_steps(limit: int) -> None:
    last = run(Pendulum(), METRIC, max_iterations=limit)[-1]
    assert (last.status, last.index) == (Status.MAX_ITERATIONS, limit)


class Wrong(Pendulum):
    """A gradient that is wrong in part of the horizon."""

    def expand(self, point: Curve) -> Expansion:
        e = super().expand(point)
        a = np.array(e.a)
        a[N] *= -0.5
        return replace(e, a=a)


@pytest.mark.parametrize("method", DIRECTIONS)
@pytest.mark.parametrize("refinements", [0, 2])
@pytest.mark.parametrize("make", [partial(Pendulum, sign=-1.0), Wrong])
def test_a_wrong_gradient_stalls_and_never_raises_the_cost(
    make: Any, refinements: int, method: str
) -> None:
    """Better differences are used before."""
    problem = make(refinements=refinements)
    iterates = run(problem, DIRECTIONS[method]())
    assert iterates[-1].status is Status.STALLED
    assert not iterates[-1].status.success
    assert all(b.value <= a.value for a, b in pairwise(iterates))
    assert problem.refinements == 0


def test_better_differences_are_used_before_convergence_is_claimed(optimum: float) -> None:
    problem = Pendulum(refinements=1)
    iterates = run(problem, LBFGS(R * DT))
    assert problem.refinements == 0
    assert iterates[-1].status is Status.CONVERGED
    assert iterates[-1].value == pytest.approx(optimum, rel=1e-7)


@dataclass
class Upwards:
    """An ascent direction with a correct expansion."""

    def __call__(self, expansion: Expansion, K: Array) -> TangentCurve:
        zeta = METRIC(expansion, K)
        return TangentCurve(z=-zeta.z, v=-zeta.v)

    accept, reset = METRIC.accept, METRIC.reset


def searched(
    problem: Pendulum, factor: float, first: float = 1.0, budget: Any = None
) -> tuple[tuple[Curve, float] | None, float, float]:
    """Search along a multiple of the metric direction.

    Returns:
        Result of the line search, J at the first point, and the slope of the metric direction.
    """
    point, expansion, K, zeta = begun(problem, METRIC)
    along, slope = TangentCurve(z=factor * zeta.z, v=factor * zeta.v), expansion.slope(zeta)
    found = line_search(
        problem, point, along, abs(factor) * slope, K, budget=budget or Budget(), first=first
    )
    return found, problem.value(point), slope


@pytest.mark.parametrize(("wall", "first"), [(np.inf, 1.0), (6.0, 1.0), (np.inf, 0.125)])
@pytest.mark.parametrize("factor", [1.0, 10.0, 100.0, 1e4])
@pytest.mark.parametrize("sigma", [1e-4, 0.3])
def test_armijo_accepts_a_step_of_sufficient_decrease_however_long_the_direction(
    factor: float, sigma: float, wall: float, first: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond the wall, trials diverge."""
    monkeypatch.setattr(projection_operator, "SUFFICIENT_DECREASE", sigma)
    problem = Pendulum(wall=wall)
    (trial, gamma), value, slope = searched(problem, factor, first)
    assert 0.0 < gamma <= first

    # Between J at the start and the one that is asked for after the accepted one.
    accepts = [
        tried <= value + sigma * length * factor * slope
        for tried, length in zip(problem.values[1:-1], problem.gammas, strict=True)
    ]
    assert accepts == [False] * (len(accepts) - 1) + [True]
    assert (problem.value(trial), gamma) == (problem.values[-3], problem.gammas[-1])


def test_armijo_gives_up_on_an_ascent_direction_that_claims_to_descend(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It accepts no step that is too short to change the cost."""
    problem = Pendulum()
    monkeypatch.setattr(projection_operator, "MAX_TRIALS", 12)
    assert searched(problem, -1.0)[0] is None
    assert len(problem.values) == 14  # the start, every trial, and the start again
    monkeypatch.setattr(projection_operator, "MAX_TRIALS", 100)
    found, value, _ = searched(problem, -1.0)
    assert found is None or problem.value(found[0]) < value


def test_the_line_search_ends_with_its_time_and_the_descent_with_its_last_iterate() -> None:
    problem, asked = Pendulum(), iter([None, None, StopReason.SECONDS])
    short = type("Short", (), {"exhausted": property(lambda _: next(asked))})()
    assert searched(problem, -1.0, budget=short)[0] is None
    assert len(problem.values) == 5  # three trials between the start and itself

    # An ascent direction is not called converged.
    iterates = run(Pendulum(), Upwards(), budget=Budget(seconds=0.0))
    assert [iterate.status for iterate in iterates] == [None]
    iterates = run(Pendulum(), Upwards(), max_iterations=5)
    assert iterates[-1].status is not Status.CONVERGED
    assert iterates[-1].value <= iterates[0].value


def learned(memory: int) -> tuple[LBFGS, Expansion, Array]:
    """An L-BFGS after some iterations, the next expansion, and K."""
    problem, direction = Pendulum(), LBFGS(R * DT, memory)
    iterates = run(problem, direction, max_iterations=9, regulate=replace(REGULATOR, period=1000))
    K = REGULATOR.gain(problem.expand(iterates[0].point))
    return direction, problem.expand(iterates[-1].point), K


def test_lbfgs_direction_is_minus_the_inverse_bfgs_matrix_times_the_gradient() -> None:
    direction, expansion, K = learned(memory=6)
    pairs = [(s.ravel(), y.ravel()) for s, y, _ in direction._pairs]
    assert len(pairs) == 6
    s, y = pairs[-1]
    inverse = np.eye(N) / (R * DT)
    H = inverse * (s @ y) / (y @ inverse @ y)
    for s, y in pairs:  # dense update, eq. 6.17 of Nocedal & Wright
        V = np.eye(N) - np.outer(y, s) / (s @ y)
        H = V.T @ H @ V + np.outer(s, s) / (s @ y)
    zeta = direction(expansion, K)
    expected = -H @ expansion.gradient(K).ravel()
    c = expansion.coordinates(K).coordinate(zeta).ravel()
    assert_allclose(c, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert expansion.slope(zeta) < 0.0


def test_lbfgs_refuses_pairs_of_negative_curvature_and_can_be_reset() -> None:
    direction = LBFGS(R * DT)
    _, expansion, K, _ = begun(Pendulum(), direction)
    other = replace(expansion, b=expansion.b + 1.0)
    gradient = other.gradient(K) - expansion.gradient(K)
    direction.accept(other, K, other.lift(K, -gradient))
    assert direction._pairs == ()
    assert direction.reset() is False
    direction(expansion, K)
    direction.accept(other, K, other.lift(K, gradient))
    assert len(direction._pairs) == 1
    assert direction.reset() is True
    assert direction._pairs == ()


def test_lbfgs_on_a_finer_grid_keeps_its_direction() -> None:
    """The direction repeats each sample where the gradient of each is shared by four."""
    direction, _, _ = learned(memory=6)
    fine = direction.refined(R * DT / 4, 4)
    g = np.cos(np.arange(N))[:, None]
    moves = []
    for each, b in ((direction, g), (fine, np.repeat(g, 4, axis=0) / 4)):
        still = np.zeros((len(b), 1, 1))
        expansion = Expansion(A=still, B=still, a=np.zeros((len(b) + 1, 1)), b=b)
        moves.append(each(expansion, still).v)
    assert_allclose(moves[1], np.repeat(moves[0], 4, axis=0), rtol=1e-9)


def test_feedback_only_above_the_threshold_of_amplification(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The amplification is not computed where the threshold decides alone."""
    expansion = Pendulum().expand(start(Pendulum()))
    amplification = amplification_in_best_units(expansion.A)

    def gain(threshold: float) -> Array:
        return replace(REGULATOR, feedback_threshold=threshold).gain(expansion)

    assert not gain(1.01 * amplification).any()
    assert_array_equal(gain(0.99 * amplification), REGULATOR.gain(expansion))
    monkeypatch.delattr(projection_operator, "amplification_in_best_units")
    assert not gain(np.inf).any()
    assert gain(0.0).any()
