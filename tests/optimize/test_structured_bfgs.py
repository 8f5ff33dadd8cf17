"""Directions under hard limits.

Metrics are compared with dense matrices, and the optimum of a small problem with that of SciPy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from mjfim.optimize.cost_models import BarrierDerivatives, BarrierExpansion, Bounds
from mjfim.optimize.directions import (
    Metric,
    Product,
    StructuredBFGS,
    basis_matrix,
    basis_response,
    metric_of_curves,
    metric_of_matrix,
)
from mjfim.optimize.lq import CurveCoordinates, LinearRecursion, TangentCurve, Weights
from mjfim.optimize.projection_operator import (
    Expansion,
    Iterate,
    Regulator,
    optimize,
)
from mjfim.parallel.budget import Budget
from mjfim.records.design import Status
from tests.support.lq import random_system, random_weights
from tests.support.numerics import Array, relative_error

N, NX, NU = 12, 3, 2


def random_expansion(rng: np.random.Generator) -> tuple[Expansion, Weights]:
    """A random expansion with all kinds of weights."""
    A, B = random_system(rng, N, NX, NU)
    expansion = Expansion(A=A, B=B, a=rng.normal(size=(N + 1, NX)), b=rng.normal(size=(N, NU)))
    return expansion, random_weights(rng, N, NX, NU, steps=True)


def basis_metric(expansion: Expansion, weights: Weights, basis: Array) -> Metric:
    """Metric of a quadratic form on the coefficients of a basis."""
    return metric_of_matrix(basis_matrix(basis, basis_response(expansion, basis), weights))


def curve_metric(expansion: Expansion, weights: Weights, K: Array | float = 0.0) -> Metric:
    """Metric of a quadratic form on the control, with feedback."""
    gains = np.zeros((N, NU, NX)) + K
    return metric_of_curves(CurveCoordinates(A=expansion.A, B=expansion.B, K=gains), weights)


def dense(product: Product) -> Array:
    """(N nu, N nu) matrix of a metric, from its product with every unit step."""
    units = np.eye(N * NU).reshape(-1, N, NU)
    return np.stack([product(e).reshape(-1) for e in units], axis=1)


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
    apply, solve = curve_metric(expansion, weights, K)
    H = dense(apply)
    assert_allclose(H, H.T, rtol=0, atol=1e-9 * np.abs(H).max())
    assert np.linalg.eigvalsh(H)[0] > 0.0
    g = rng.normal(size=(N, NU))
    assert_allclose(solve(g).reshape(-1), np.linalg.solve(H, g.reshape(-1)), rtol=1e-7, atol=1e-9)
    many = rng.normal(size=(3, N, NU))
    solved = [solve(each) for each in many]
    assert_allclose(solve(many), solved, rtol=1e-9, atol=1e-12)

    # its own form on the curve that a step makes
    s = rng.normal(size=(N, NU))
    zeta = expansion.lift(K, s)
    a, b = weights.half_gradient(zeta)
    assert np.vdot(s, apply(s)) == pytest.approx(np.sum(a * zeta.z) + np.sum(b * zeta.v), rel=1e-10)


@pytest.mark.parametrize("basis", [np.eye(N), np.random.default_rng(4).normal(size=(N, 5))])
def test_the_metric_of_a_basis_is_the_projected_metric(basis: Array) -> None:
    """Some weights may be zero, as long as every basis function has some weight."""
    rng = np.random.default_rng(3)
    expansion, weights = random_expansion(rng)
    weights.Q[4:9], weights.S[4:9], weights.W[::2] = 0.0, 0.0, 0.0
    wide = np.kron(basis, np.eye(NU))
    H = wide.T @ dense(curve_metric(expansion, weights)[0]) @ wide
    apply, solve = basis_metric(expansion, weights, basis)
    units = np.eye(len(H)).reshape(-1, basis.shape[1], NU)
    assert relative_error(apply(units).reshape(H.shape), H) < 1e-9
    many = rng.normal(size=(3, basis.shape[1], NU))
    solved = np.linalg.solve(H, many.reshape(3, -1, 1)).reshape(many.shape)
    for g, exact in ((many, solved), (many[0], solved[0])):
        assert relative_error(solve(g), exact) < 1e-7
        assert relative_error(apply(exact), g) < 1e-7


# A linear plant: an oscillator with a third state, and two controls.
A = np.tile([[1.0, 0.2, 0.0], [-0.3, 0.95, 0.0], [0.1, 0.0, 0.9]], (N, 1, 1))
B = np.tile([[0.0, 0.1], [0.5, 0.0], [0.0, 0.3]], (N, 1, 1))
START, WANTED = np.array([0.2, 0.0, 0.1]), np.array([3.0, 0.0, -1.0])

# Limits of the first state, of the control and of its changes.
SHOWN = Bounds.from_range(np.array([-1.0]), np.array([1.0]))
CONTROL = Bounds.from_range(np.full(NU, -0.6), np.array([0.6, np.inf]))
RATE = Bounds.from_range(np.full(NU, -0.4), np.full(NU, 0.4))


@dataclass(frozen=True, eq=False)
class Toy:
    """A linear plant with a quadratic cost, whose minimum lies outside the limits.

    Attributes:
        mu: Weight of the barrier, which is relaxed less with a smaller weight.
        steps: Whether the changes of the control are limited as well.
    """

    mu: float
    steps: bool = False

    def point(self, u: Array) -> SimpleNamespace:
        """The trajectory of a control."""
        x = LinearRecursion(A).forward(START, np.einsum("kij,kj->ki", B, u))
        return SimpleNamespace(u=u, x=x)

    def barriers(self, point: SimpleNamespace) -> list[BarrierDerivatives]:
        """Barriers of the first state, of the control and of its changes."""
        delta = max(0.3 * self.mu, 1e-6)
        rates = np.diff(point.u, axis=0, prepend=0.0, append=0.0)
        return [
            SHOWN.barrier(point.x[1:, :1], delta, self.mu),
            CONTROL.barrier(point.u, delta, self.mu),
            RATE.barrier(rates, delta, self.mu * self.steps),
        ]

    def value(self, point: SimpleNamespace) -> float:
        """Sum of cost and barrier."""
        cost = 0.01 * np.sum((point.x[1:] - WANTED) ** 2) + 1e-4 * np.sum(point.u**2)
        return cost + sum(value for value, _, _ in self.barriers(point))

    def size(self, point: SimpleNamespace) -> float:
        """Scale of a change of the cost."""
        return max(1.0, abs(self.value(point)))

    def expand(self, point: SimpleNamespace) -> Expansion:
        """Derivatives of cost and barrier, and the curvature of the barrier only."""
        a = np.zeros((N + 1, NX))
        a[1:] = 0.02 * (point.x[1:] - WANTED)
        (_, shown, bent), (_, held, held_bent), (_, rated, W) = self.barriers(point)
        Q, R = np.zeros((N + 1, NX, NX)), np.zeros((N, NU, NU))
        Q[1:, 0, 0], R[:, range(NU), range(NU)] = bent[:, 0], held_bent
        of_states = np.zeros_like(a)
        of_states[1:, 0] = shown[:, 0]
        barrier = BarrierExpansion(
            a=of_states,
            b=held + rated[:-1] - rated[1:],
            weights=Weights(Q=Q, S=np.zeros((N, NU, NX)), R=R, W=W),
            observations=np.concatenate([A, B], axis=2)[:, None, :1],
            control_scale=CONTROL.scale,
            control_step_scale=RATE.scale,
        )
        return Expansion(A=A, B=B, a=a + barrier.a, b=2e-4 * point.u + barrier.b, barrier=barrier)

    def project(
        self, point: SimpleNamespace, zeta: TangentCurve, gamma: float, K: Array
    ) -> SimpleNamespace:
        """Move the control along a tangent curve, which is exact for this linear plant."""
        return self.point(point.u + gamma * zeta.v)

    def difference(self, new: SimpleNamespace, old: SimpleNamespace) -> TangentCurve:
        """Difference of states and controls, which is a tangent curve of this linear plant."""
        return TangentCurve(z=new.x - old.x, v=new.u - old.u)

    def refine(self, point: SimpleNamespace) -> SimpleNamespace | None:
        """None, because derivatives are exact."""
        return None


OPEN_LOOP = np.zeros((N, NU, NX))
CALM = Regulator(Q=np.eye(NX), R=np.eye(NU), terminal=np.eye(NX), feedback_threshold=np.inf)
WITH_FEEDBACK = Regulator(Q=np.eye(NX), R=np.eye(NU), terminal=np.eye(NX))


def optimised(
    toy: Toy, direction: StructuredBFGS, regulate: Regulator = CALM, tolerance: float = 1e-9
) -> list[Iterate[SimpleNamespace]]:
    """All iterates from a control of zeros."""
    begin = toy.point(np.zeros((N, NU)))
    steps = optimize(
        toy,
        begin,
        direction,
        regulate,
        budget=Budget(),
        tolerance=tolerance,
        max_iterations=150,
    )
    return list(steps)


@pytest.mark.parametrize("mu", [1e-1, 1e-3])
@pytest.mark.parametrize("kind", ["free", "with feedback", "with steps", "on a basis"])
def test_the_optimum_of_the_toy_problem_agrees_with_scipy(kind: str, mu: float) -> None:
    toy = Toy(mu, steps=kind == "with steps")
    basis = np.vander(np.linspace(-1.0, 1.0, N), 5) if kind == "on a basis" else None
    curves = np.eye(N) if basis is None else basis

    def cost(c: Array) -> float:
        return toy.value(toy.point(curves @ c.reshape(-1, NU)))

    def slope(c: Array) -> Array:
        gradient = toy.expand(toy.point(curves @ c.reshape(-1, NU))).gradient(OPEN_LOOP)
        return (curves.T @ gradient).reshape(-1)

    options = {"gtol": 1e-9, "maxiter": 5000}
    start = np.zeros(curves.shape[1] * NU)
    best = minimize(cost, start, jac=slope, method="BFGS", options=options)
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
        assert 0.0 < SHOWN.margin(iterates[-1].point.x[:, :1]).min() < 0.05


def test_stored_pairs_do_not_contain_the_barrier() -> None:
    """They contain only the change of the cost's gradient.

    So they stay valid for a sharper barrier.
    """
    direction, blunt = StructuredBFGS(np.full(NU, 1e-3), damping=10.0), Toy(1e-1)
    point = optimised(blunt, direction, tolerance=1e-6)[-1].point
    pairs = direction._pairs
    assert len(pairs) > 2

    def gradient(u: Array) -> Array:
        return Toy(0.0).expand(Toy(0.0).point(u)).gradient(OPEN_LOOP)

    step, change = pairs[-1]
    wanted = gradient(point.u) - gradient(point.u - step)
    assert_allclose(change, wanted, rtol=0, atol=1e-9 * max(np.abs(wanted).max(), 1.0))
    assert [direction.reset(), direction.reset()] == [True, False]

    # The damping has fallen, because the last steps are short.
    assert direction.damping < 1e-3


def test_damping_keeps_the_step_back_inside_the_limits() -> None:
    """The point is outside a bound, and the cost pulls in another direction.

    The damped step returns further than the scaled one.
    """
    toy, outside = Toy(1e-4), np.zeros((N, NU))
    outside[3, 0] = CONTROL.upper[0] + 0.2 * CONTROL.scale[0]
    e = toy.expand(toy.point(outside))
    pull = 50.0 * np.random.default_rng(2).normal(size=e.a.shape) * [0.0, 1.0, 1.0]
    pulled = replace(e, a=e.a + pull)
    long = StructuredBFGS(np.full(NU, 1e-6), reach=1e9)(pulled, OPEN_LOOP)
    far = e.barrier.largest_relative_move(long) / 0.25
    assert far > 10.0
    direction = StructuredBFGS(np.full(NU, 1e-6), reach=0.25)
    damped = direction(pulled, OPEN_LOOP)
    assert direction.damping > 0.0
    assert e.barrier.largest_relative_move(damped) <= 0.25 + 1e-12
    assert pulled.slope(damped) < 0.0
    assert damped.v[3, 0] < 2.0 * long.v[3, 0] / far < 0.0


def test_an_expansion_without_limits_is_refused() -> None:
    expansion, _ = random_expansion(np.random.default_rng(5))
    with pytest.raises(ValueError, match="needs their expansion"):
        StructuredBFGS(np.ones(NU))(expansion, OPEN_LOOP)
