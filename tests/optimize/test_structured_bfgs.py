"""Directions under hard limits.

Metrics are compared with dense matrices, and the optimum of a small problem with that of SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from mjfim.experiment.initial import spline_basis
from mjfim.optimize.cost_models import BarrierExpansion, Bounds
from mjfim.optimize.lq import CurveCoordinates, LinearRecursion, TangentCurve, Weights
from mjfim.optimize.projection_operator import (
    Armijo,
    Expansion,
    Iterate,
    Regulator,
    optimize,
)
from mjfim.optimize.structured_bfgs import (
    BasisMetric,
    CurveMetric,
    StructuredBFGS,
    basis_matrix,
    basis_response,
)
from mjfim.records.design import Status
from tests.support.limits import barrier_problem
from tests.support.lq import random_system, random_weights
from tests.support.numerics import Array, cart_task, relative_error

N, NX, NU = 12, 3, 2


def random_expansion(rng: np.random.Generator) -> tuple[Expansion, Weights]:
    """A random expansion with all kinds of weights."""
    A, B = random_system(rng, N, NX, NU)
    expansion = Expansion(A=A, B=B, a=rng.normal(size=(N + 1, NX)), b=rng.normal(size=(N, NU)))
    return expansion, random_weights(rng, N, NX, NU, steps=True)


def basis_metric(expansion: Expansion, weights: Weights, basis: Array) -> BasisMetric:
    """Metric of a quadratic form on the coefficients of a basis."""
    return BasisMetric(H=basis_matrix(basis, basis_response(expansion, basis), weights))


def curve_metric(expansion: Expansion, weights: Weights, K: Array | float = 0.0) -> CurveMetric:
    """Metric of a quadratic form on the control, with feedback."""
    gains = np.zeros((N, NU, NX)) + K
    return CurveMetric(
        coordinates=CurveCoordinates(A=expansion.A, B=expansion.B, K=gains), weights=weights
    )


def dense(metric: CurveMetric) -> Array:
    """(N nu, N nu) matrix of a metric, from its product with every unit step."""
    units = np.eye(N * NU).reshape(-1, N, NU)
    return np.stack([metric.apply(e).reshape(-1) for e in units], axis=1)


def test_a_linearised_motion_that_explodes_has_no_direction() -> None:
    """The search ends this climb with its best control, as where a simulation diverges."""
    expansion, weights = random_expansion(np.random.default_rng(7))
    wild = replace(expansion, A=1e20 * expansion.A)
    with pytest.raises(np.linalg.LinAlgError, match="too unstable"):
        basis_metric(wild, weights, np.eye(N)[:, :4])


@pytest.mark.parametrize("feedback", [False, True])
def test_a_metric_is_symmetric_positive_and_its_solve_inverts_it(feedback: bool) -> None:
    rng = np.random.default_rng(1)
    expansion, weights = random_expansion(rng)
    K = feedback * 0.3 * rng.normal(size=(N, NU, NX))
    metric = curve_metric(expansion, weights, K)
    H = dense(metric)
    assert_allclose(H, H.T, rtol=0, atol=1e-9 * np.abs(H).max())
    assert np.linalg.eigvalsh(H)[0] > 0.0
    g = rng.normal(size=(N, NU))
    assert_allclose(
        metric.solve(g).reshape(-1), np.linalg.solve(H, g.reshape(-1)), rtol=1e-7, atol=1e-9
    )
    many = rng.normal(size=(3, N, NU))
    solved = [metric.solve(each) for each in many]
    assert_allclose(metric.solve(many), solved, rtol=1e-9, atol=1e-12)

    # its own form on the curve that a step makes
    s = rng.normal(size=(N, NU))
    zeta = expansion.lift(K, s)
    a, b = weights.half_gradient(zeta)
    assert np.vdot(s, metric.apply(s)) == pytest.approx(
        np.sum(a * zeta.z) + np.sum(b * zeta.v), rel=1e-10
    )


def test_both_metrics_agree_on_an_identity_basis() -> None:
    rng = np.random.default_rng(2)
    expansion, weights = random_expansion(rng)
    free = curve_metric(expansion, weights)
    based = basis_metric(expansion, weights, np.eye(N))
    for _ in range(3):
        s = rng.normal(size=(N, NU))
        assert relative_error(based.apply(s), free.apply(s)) < 1e-8
        assert relative_error(based.solve(s), free.solve(s)) < 1e-8
    assert relative_error(based.H, dense(free)) < 1e-10


def test_the_metric_of_a_basis_is_the_projected_metric() -> None:
    """Some weights may be zero, as long as every basis function has some weight."""
    rng = np.random.default_rng(3)
    expansion, weights = random_expansion(rng)
    weights.Q[4:9], weights.S[4:9], weights.W[::2] = 0.0, 0.0, 0.0
    basis = rng.normal(size=(N, 5))
    wide = np.einsum("km,uw->kumw", basis, np.eye(NU)).reshape(N * NU, -1)
    H = wide.T @ dense(curve_metric(expansion, weights)) @ wide
    based = basis_metric(expansion, weights, basis)
    assert relative_error(based.H, H) < 1e-9
    g = rng.normal(size=(5, NU))
    assert relative_error(based.solve(g).reshape(-1), np.linalg.solve(H, g.reshape(-1))) < 1e-7
    assert relative_error(based.apply(based.solve(g)), g) < 1e-7

    many = rng.normal(size=(3, 5, NU))
    for of_many, of_one in ((based.apply(many), based.apply), (based.solve(many), based.solve)):
        assert_allclose(of_many, [of_one(each) for each in many], rtol=1e-9)


@dataclass(frozen=True, eq=False)
class ToyPoint:
    """A control of the toy problem with its states."""

    u: Array
    x: Array


@dataclass(frozen=True, eq=False)
class Toy:
    """A linear plant with a convex quadratic cost, whose minimum lies outside the limits.

    The barrier limits the first state and the control.

    Attributes:
        mu: Weight of the barrier.
        steps: Whether the changes of the control are limited as well.
    """

    mu: float
    steps: bool = False

    @cached_property
    def plant(self) -> tuple[Array, Array]:
        """Matrices A of an oscillator with a third state, and B of two controls."""
        A = np.array([[1.0, 0.2, 0.0], [-0.3, 0.95, 0.0], [0.1, 0.0, 0.9]])
        return np.tile(A, (N, 1, 1)), np.tile(
            np.array([[0.0, 0.1], [0.5, 0.0], [0.0, 0.3]]), (N, 1, 1)
        )

    wanted = np.array([3.0, 0.0, -1.0])
    start = np.array([0.2, 0.0, 0.1])
    shown = Bounds.from_range(np.array([-1.0]), np.array([1.0]))
    control = Bounds.from_range(np.full(NU, -0.6), np.array([0.6, np.inf]))
    rate = Bounds.from_range(np.full(NU, -0.4), np.full(NU, 0.4))

    @property
    def delta(self) -> float:
        """Relative distance below which the barrier is relaxed; it becomes smaller with mu."""
        return 0.3 * self.mu

    def point(self, u: Array) -> ToyPoint:
        """The trajectory of a control."""
        A, B = self.plant
        return ToyPoint(u, LinearRecursion(A).forward(self.start, np.einsum("kij,kj->ki", B, u)))

    def value(self, point: ToyPoint) -> float:
        """Sum of cost and barrier."""
        cost = 0.01 * np.sum((point.x[1:] - self.wanted) ** 2) + 1e-4 * np.sum(point.u**2)
        cost += 2e-3 * np.sum(
            point.x[1:, 2] ** 2 * point.u[:, 1] ** 2
        )  # a small term that is not quadratic
        if not self.mu:
            return float(cost)
        barriers = (
            self.shown.barrier(point.x[1:, :1], self.delta, 1.0).value
            + self.control.barrier(point.u, self.delta, 1.0).value
        )
        if self.steps:
            barriers += self.rate.barrier(
                np.diff(point.u, axis=0, prepend=0.0, append=0.0), self.delta, 1.0
            ).value
        return float(cost + self.mu * barriers)

    def size(self, point: ToyPoint) -> float:
        """Scale of a change of the cost."""
        return max(1.0, abs(self.value(point)))

    def expand(self, point: ToyPoint) -> Expansion:
        """Derivatives of cost and barrier, and the curvature of the barrier only."""
        (A, B), x, u = self.plant, point.x, point.u
        a, b = np.zeros((N + 1, NX)), 2e-4 * u
        a[1:] = 0.02 * (x[1:] - self.wanted)
        a[1:, 2] += 4e-3 * x[1:, 2] * u[:, 1] ** 2
        b[:, 1] += 4e-3 * x[1:, 2] ** 2 * u[:, 1]
        if not self.mu:
            return Expansion(A=A, B=B, a=a, b=b)
        shown, held = (
            self.shown.barrier(x[1:, :1], self.delta, self.mu),
            self.control.barrier(u, self.delta, self.mu),
        )
        Q, R, W = np.zeros((N + 1, NX, NX)), np.zeros((N, NU, NU)), np.zeros((N + 1, NU))
        Q[1:, 0, 0], R[:, range(NU), range(NU)] = shown.curvature[:, 0], held.curvature
        barrier_a, barrier_b = np.zeros_like(a), held.slope.copy()
        barrier_a[1:, 0] = shown.slope[:, 0]
        if self.steps:
            derivatives = self.rate.barrier(
                np.diff(u, axis=0, prepend=0.0, append=0.0), self.delta, self.mu
            )
            barrier_b += derivatives.slope[:-1] - derivatives.slope[1:]
            W = derivatives.curvature
        observations = np.zeros((N, 1, 1, NX + NU))
        observations[:, 0, 0, :NX], observations[:, 0, 0, NX:] = A[:, 0], B[:, 0]
        barrier = BarrierExpansion(
            a=barrier_a,
            b=barrier_b,
            weights=Weights(Q=Q, S=np.zeros((N, NU, NX)), R=R, W=W),
            observations=observations,
            control_scale=self.control.scale,
            control_step_scale=self.rate.scale,
        )
        return Expansion(A=A, B=B, a=a + barrier_a, b=b + barrier_b, extended=None, barrier=barrier)

    def project(self, point: ToyPoint, zeta: TangentCurve, gamma: float, K: Array) -> ToyPoint:
        """Move the control along a tangent curve, which is exact for this linear plant."""
        return self.point(point.u + gamma * zeta.v)

    def difference(self, new: ToyPoint, old: ToyPoint) -> TangentCurve:
        """Difference of states and controls, which is a tangent curve of this linear plant."""
        return TangentCurve(z=new.x - old.x, v=new.u - old.u)

    def refine(self, point: ToyPoint) -> ToyPoint | None:
        """None, because derivatives are exact."""
        return None


OPEN_LOOP = np.zeros((N, NU, NX))
CALM = Regulator(Q=np.eye(NX), R=np.eye(NU), terminal=np.eye(NX), feedback_threshold=np.inf)
WITH_FEEDBACK = Regulator(Q=np.eye(NX), R=np.eye(NU), terminal=np.eye(NX))


def optimised(
    toy: Toy, direction: StructuredBFGS, regulate: Regulator = CALM, tolerance: float = 1e-9
) -> list[Iterate[ToyPoint]]:
    """All iterates from a control of zeros."""
    begin = toy.point(np.zeros((N, NU)))
    steps = optimize(
        toy, begin, direction, regulate, Armijo(), tolerance=tolerance, max_iterations=150
    )
    return list(steps)


@pytest.mark.parametrize("mu", [1e-1, 1e-3])
@pytest.mark.parametrize("kind", ["free", "with feedback", "with steps", "on a basis"])
def test_the_optimum_of_the_toy_problem_agrees_with_scipy(kind: str, mu: float) -> None:
    toy, basis = Toy(mu, steps=kind == "with steps"), None
    if kind == "on a basis":
        t = np.linspace(-1.0, 1.0, N)
        basis = t[:, None] ** np.arange(5)
    curves = np.eye(N) if basis is None else basis

    def cost(c: Array) -> float:
        return toy.value(toy.point(curves @ c.reshape(-1, NU)))

    def slope(c: Array) -> Array:
        gradient = toy.expand(toy.point(curves @ c.reshape(-1, NU))).gradient(OPEN_LOOP)
        return (curves.T @ gradient).reshape(-1)

    best = minimize(
        cost,
        np.zeros(curves.shape[1] * NU),
        jac=slope,
        method="BFGS",
        options={"gtol": 1e-9, "maxiter": 5000},
    )
    direction = StructuredBFGS(np.full(NU, 1e-3), basis)
    regulate = WITH_FEEDBACK if kind == "with feedback" else CALM
    iterates = optimised(toy, direction, regulate)
    values = [iterate.value for iterate in iterates]
    assert iterates[-1].status in (Status.CONVERGED, Status.STALLED)
    assert (np.diff(values) <= 0.0).all()
    assert values[-1] == pytest.approx(best.fun, abs=1e-6 * abs(best.fun))
    assert_allclose(iterates[-1].point.u, curves @ best.x.reshape(-1, NU), rtol=0, atol=2e-3)
    assert len(iterates) < 60
    if mu < 1e-2:  # the bound is reached, and kept
        assert 0.0 < toy.shown.margin(iterates[-1].point.x[:, :1]).min() < 0.05


def test_stored_pairs_do_not_contain_the_barrier() -> None:
    """They contain only the change of the cost's gradient.

    So they stay valid for a sharper barrier.
    """
    direction, blunt = StructuredBFGS(np.full(NU, 1e-3)), Toy(1e-1)
    point = optimised(blunt, direction, tolerance=1e-6)[-1].point
    pairs = direction._pairs
    assert len(pairs) > 2

    def gradient(u: Array) -> Array:
        return Toy(0.0).expand(Toy(0.0).point(u)).gradient(OPEN_LOOP)

    step, change = pairs[-1]
    wanted = gradient(point.u) - gradient(point.u - step)
    assert_allclose(change, wanted, rtol=0, atol=1e-9 * max(np.abs(wanted).max(), 1.0))
    assert direction.reset() is True
    assert direction.reset() is False


def test_no_step_changes_a_limited_quantity_by_more_than_the_reach() -> None:
    toy = Toy(1e-4)
    e = toy.expand(toy.point(np.zeros((N, NU))))
    K = OPEN_LOOP
    long = StructuredBFGS(np.full(NU, 1e-6), reach=1e9)(e, K)
    short = StructuredBFGS(np.full(NU, 1e-6), reach=0.25)(e, K)
    assert e.barrier.largest_relative_move(long) > 1.0
    assert 0.05 < e.barrier.largest_relative_move(short) <= 0.25 * (1.0 + 1e-12)
    assert e.slope(short) < 0.0
    tiny = replace(e, a=1e-9 * e.a, b=1e-9 * e.b)
    assert (
        e.barrier.largest_relative_move(StructuredBFGS(np.full(NU, 1.0))(tiny, K)) < 1e-6
    )  # a short step stays as it is


def test_damping_keeps_the_step_back_inside_the_limits() -> None:
    """The point is outside a bound, and the cost pulls in another direction.

    The damped step returns further than the scaled one.
    """
    toy, outside = Toy(1e-4), np.zeros((N, NU))
    outside[3, 0] = toy.control.upper[0] + 0.2 * toy.control.scale[0]
    e = toy.expand(toy.point(outside))
    a = e.a + 50.0 * np.random.default_rng(2).normal(size=e.a.shape) * np.array([0.0, 1.0, 1.0])
    pulled, K = replace(e, a=a), OPEN_LOOP
    long = StructuredBFGS(np.full(NU, 1e-6), reach=1e9)(pulled, K)
    far = e.barrier.largest_relative_move(long) / 0.25
    assert far > 10.0
    direction = StructuredBFGS(np.full(NU, 1e-6), reach=0.25)
    damped = direction(pulled, K)
    assert direction.damping > 0.0
    assert e.barrier.largest_relative_move(damped) <= 0.25 + 1e-12
    assert pulled.slope(damped) < 0.0
    assert damped.v[3, 0] < 2.0 * long.v[3, 0] / far < 0.0


def test_damping_falls_where_steps_are_short() -> None:
    toy = Toy(1e-2)
    direction = StructuredBFGS(np.full(NU, 1e-3), damping=10.0)
    iterates = optimised(toy, direction)
    assert iterates[-1].status in (Status.CONVERGED, Status.STALLED)
    assert direction.damping < 1e-3


def test_an_expansion_without_limits_is_refused() -> None:
    rng = np.random.default_rng(5)
    expansion, _ = random_expansion(rng)
    with pytest.raises(ValueError, match="needs their expansion"):
        StructuredBFGS(np.ones(NU))(expansion, OPEN_LOOP)


@pytest.mark.parametrize("based", [False, True])
def test_the_direction_descends_on_a_simulated_design(based: bool, tmp_path: Path) -> None:
    """Its slope agrees with differences of simulated trials."""
    task = cart_task(
        tmp_path, limits={"control": {"force": (-5.0, 5.0)}, "position": {"slide": (-0.3, 0.5)}}
    ).relaxed()
    problem = barrier_problem(task, 0.03, mu=0.1, with_cost=True)
    point = problem.point(task.control)
    expansion = problem.expand(point)
    basis = spline_basis(task.t, 0.5, 8.0, False, False, False) if based else None
    zeta = StructuredBFGS(np.full(1, 1e-4), basis)(expansion, np.zeros((task.samples, 1, 4)))
    assert expansion.slope(zeta) < 0.0
    h = 1e-4
    up, down = (problem.value(problem.point(task.control + s * h * zeta.v)) for s in (1.0, -1.0))
    assert expansion.slope(zeta) == pytest.approx((up - down) / (2 * h), rel=1e-3)
    if basis is not None:
        left = zeta.v - basis @ np.linalg.lstsq(basis, zeta.v)[0]
        assert np.abs(left).max() < 1e-10 * np.abs(zeta.v).max()
