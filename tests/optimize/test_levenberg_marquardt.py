"""Bounded Levenberg-Marquardt on small analytic problems, compared with SciPy.

The status names the reason where the search fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import least_squares

from mjfim.optimize.condensed_least_squares import Condensed, RobustLoss, Step
from mjfim.optimize.levenberg_marquardt import (
    ABSOLUTE_STAGNATION,
    SearchSettings,
    Solution,
    UnknownValues,
    _Search,
    minimise,
)
from mjfim.parallel.budget import Budget, StopToken
from tests.support.numerics import Array

Rows = Callable[[Array, Array], Array]
FREE = np.inf
SHARP = SearchSettings(max_iterations=200, tolerance=1e-9)


@dataclass(eq=False)
class Analytic:
    """Residuals of segments as functions of theta and of the private unknowns of the segment.

    Derivatives are computed by complex steps.

    Attributes:
        segments: Residuals of every segment.
        lower: (c,) lower bounds of theta.
        upper: (c,) upper bounds of theta.
        spoil: Changes the (k, n + c) Jacobian of a segment.
        stop: Number of the evaluation that sets the stop token.
        token: The stop token.
        seen: All evaluated points.
    """

    segments: tuple[Rows, ...]
    lower: Array
    upper: Array
    spoil: Callable[[Array], Array] = np.asarray
    stop: int | None = None
    token: StopToken = field(default_factory=StopToken)
    seen: list[UnknownValues] = field(default_factory=list)

    def residuals(self, at: UnknownValues) -> list[Array]:
        return [
            rows(at.theta, private) for rows, private in zip(self.segments, at.private, strict=True)
        ]

    def cost(self, at: UnknownValues) -> float:
        self.seen.append(at)
        if self.stop is not None and len(self.seen) >= self.stop:
            self.token.request()
        with np.errstate(all="ignore"):
            half = 0.5 * sum(float(r @ r) for r in self.residuals(at))
        return half if np.isfinite(half) else np.inf

    def condense(self, at: UnknownValues) -> Condensed | None:
        n, c = at.private.shape[1], len(at.theta)
        blocks = np.zeros((len(self.segments), n + c + 1, n + c + 1))
        for i, (rows, r) in enumerate(zip(self.segments, self.residuals(at), strict=True)):
            both = np.concatenate([at.private[i], at.theta]).astype(complex)
            J = np.stack(
                [rows(*_split(both + 1e-30j * e, n)).imag / 1e-30 for e in np.eye(n + c)], axis=1
            )
            R = np.linalg.qr(np.column_stack([self.spoil(J), r]), mode="r")
            blocks[i, : len(R)] = R
        if not np.isfinite(blocks).all():
            return None
        owners = np.arange(len(self.segments))
        return Condensed(
            blocks=blocks,
            segment_of_block=owners,
            private_rows=np.zeros((len(owners), 0, n + c + 1)),
            common_rows=np.zeros((0, c + 1)),
        )

    def bounds_at(self, at: UnknownValues) -> tuple[Array, Array]:
        return self.lower, self.upper

    def moved(self, at: UnknownValues, step: Step, length: float) -> UnknownValues:
        theta = np.clip(at.theta + length * step.common, self.lower, self.upper)
        return UnknownValues(theta=theta, private=at.private + length * step.private)

    def common_values(self, at: UnknownValues) -> Array:
        return at.theta


def _split(both: Array, n: int) -> tuple[Array, Array]:
    return both[n:], both[:n]


def problem(
    *segments: Rows, lower: list[float], upper: list[float] | None = None, **more: object
) -> Analytic:
    """A problem with bounds of the common unknowns; without upper bounds where none are given."""
    top = np.full(len(lower), FREE) if upper is None else np.array(upper)
    return Analytic(segments, np.array(lower), top, **more)  # type: ignore[arg-type]


def reference(p: Analytic, start: UnknownValues) -> tuple[Array, Array, float]:
    """theta, private unknowns and half of the squares by SciPy, with all unknowns in one vector."""
    c, shape = len(start.theta), start.private.shape

    def f(z: Array) -> Array:
        return np.concatenate(p.residuals(UnknownValues(theta=z[:c], private=z[c:].reshape(shape))))

    none = np.full(start.private.size, FREE)
    bounds = (np.concatenate([p.lower, -none]), np.concatenate([p.upper, none]))
    z0 = np.concatenate([start.theta, start.private.ravel()])
    found = least_squares(
        f, z0, "cs", bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac", max_nfev=5000
    )
    return found.x[:c], found.x[c:].reshape(shape), float(found.cost)


def solved(p: Analytic, start: UnknownValues, search: SearchSettings = SHARP) -> Solution:
    """Solution of `minimise`."""
    found = minimise(p, start, search, Budget(stop=p.token))
    assert found is not None
    return found


def decays(sigma: float = 0.01) -> tuple[Rows, ...]:
    """Exponential decays with a common rate and offset.

    The amplitude of each segment is its private unknown.
    """
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 2.0, 25)
    found = []
    for amplitude in (1.0, 0.4, -2.0):
        y = amplitude * np.exp(-1.7 * t) + 0.3 + sigma * rng.standard_normal(len(t))
        found.append(
            lambda theta, private, y=y: (private[0] * np.exp(-theta[0] * t) + theta[1] - y) / sigma
        )
    return tuple(found)


def rosenbrock(theta: Array, private: Array) -> Array:
    """The function of Rosenbrock, a bent valley with its minimum at (1, 1)."""
    return np.array([100.0 * (theta[1] - theta[0] ** 2), 10.0 * (1.0 - theta[0])])


def powell(theta: Array, private: Array) -> Array:
    """Powell's badly scaled function: the minimum is near (1.1e-5, 9.1)."""
    return np.array(
        [1e4 * theta[0] * theta[1] - 1.0, np.exp(-theta[0]) + np.exp(-theta[1]) - 1.0001]
    )


def peak(theta: Array, private: Array) -> Array:
    """A Gaussian peak on noise."""
    x = np.linspace(-3.0, 3.0, 60)
    y = 2.0 * np.exp(-((x - 0.4) ** 2) / (2 * 0.7**2)) + 0.05 * np.random.default_rng(
        1
    ).standard_normal(60)
    return (theta[0] * np.exp(-((x - theta[1]) ** 2) / (2 * theta[2] ** 2)) - y) / 0.05


def alone(*theta: float, segments: int = 1) -> UnknownValues:
    """A start without private unknowns."""
    return UnknownValues(theta=np.array(theta), private=np.zeros((segments, 0)))


def together(*theta: float) -> UnknownValues:
    """A start of the decays, whose amplitudes are one."""
    return UnknownValues(theta=np.array(theta), private=np.ones((3, 1)))


def free_decays() -> Analytic:
    """The decays within bounds that are far away."""
    return problem(*decays(), lower=[0.0, -5.0])


def valley(**more: object) -> Analytic:
    """The valley of Rosenbrock within wide bounds."""
    return problem(rosenbrock, lower=[-5.0, -5.0], upper=[5.0, 5.0], **more)


def peaked(**more: object) -> Analytic:
    """The peak within wide bounds."""
    return problem(peak, lower=[0.0, -3.0, 0.1], upper=[10.0, 3.0, 5.0], **more)


CASES = {
    "decays": (
        lambda: free_decays(),
        together(0.3, 0.0),
    ),
    "bounded decays": (
        lambda: problem(*decays(), lower=[0.0, 0.35], upper=[1.2, 2.0]),
        together(0.3, 1.0),
    ),
    "valley": (valley, alone(-1.2, 1.0)),
    "walled valley": (
        lambda: problem(rosenbrock, lower=[-2.0, -2.0], upper=[0.6, 5.0]),
        alone(-1.2, 1.0),
    ),
    "valley from the wall": (
        lambda: problem(rosenbrock, lower=[-2.0, 1.5], upper=[5.0, 3.0]),
        alone(-2.0, 1.5),
    ),
    "badly scaled": (lambda: problem(powell, lower=[0.0, 0.0], upper=[1.0, 20.0]), alone(0.0, 1.0)),
    "peak": (
        lambda: peaked(),
        alone(1.0, -0.5, 1.5),
    ),
    "held at a wall": (
        lambda: problem(peak, lower=[0.0, -3.0, 1.0], upper=[1.5, 3.0, 5.0]),
        alone(1.0, 1.0, 2.0),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_minimum_agrees_with_scipy(name: str) -> None:
    """No evaluated point leaves the bounds, and the cost falls from iterate to iterate."""
    build, start = CASES[name]
    p = build()
    reports = []
    found = minimise(p, start, SHARP, callback=lambda *report: reports.append(report))
    theta, starts, cost = reference(build(), start)
    assert found.success, found.status
    assert found.cost <= cost * (1 + 1e-9) + 1e-12
    assert_allclose(found.unknowns.theta, theta, rtol=1e-6, atol=1e-8)
    assert_allclose(found.unknowns.private, starts, rtol=1e-6, atol=1e-8)
    assert len(p.seen) > 3
    for at in p.seen:
        assert (at.theta >= p.lower).all()
        assert (at.theta <= p.upper).all()
    costs = [cost for _, cost, _ in reports]
    assert costs == sorted(costs, reverse=True)
    assert [iteration for iteration, _, _ in reports] == list(range(1, len(reports) + 1))
    assert found.cost == costs[-1]
    assert found.cost == pytest.approx(p.cost(found.unknowns), rel=1e-12)


def test_the_residuals_of_the_linearisation_are_those_of_the_estimate() -> None:
    """Also where the last step was taken without a linearisation at its end."""
    p = problem(*decays(), lower=[0.0, -2.0])
    start = together(1.0, 0.4)
    found = solved(p, start, SearchSettings(tolerance=1e-2, relinearise_at_end=False))
    assert found.success
    free = np.full(2, FREE)
    last = found.condensed.step(0.0, found.condensed.column_norms, -free, free)
    assert last.common_length < 1e-6
    squares = float(np.sum(found.condensed.triangles[:, :, -1] ** 2))
    assert 0.5 * squares == pytest.approx(found.cost, rel=1e-4)


def test_gauss_newton_finds_the_minimum_and_ignores_bounds() -> None:
    """Steps that would raise the cost are halved."""
    p = problem(*decays(), lower=[0.0, 0.35], upper=[1.2, 2.0])
    start = together(1.0, 0.4)
    p.lower, p.upper = np.full(2, -FREE), np.full(2, FREE)
    found = solved(p, start, SearchSettings(max_iterations=50, tolerance=1e-9, damped=False))
    theta, starts, _ = reference(p, start)
    assert found.success
    assert_allclose(found.unknowns.theta, theta, rtol=1e-6)
    assert_allclose(found.unknowns.private, starts, rtol=1e-6)
    assert found.unknowns.theta[0] > 1.2
    curved = problem(rosenbrock, lower=[-FREE, -FREE])
    through = solved(
        curved, alone(-1.2, 1.0), SearchSettings(max_iterations=100, tolerance=1e-9, damped=False)
    )
    assert_allclose(through.unknowns.theta, 1.0, rtol=1e-6)
    lengths = {
        np.abs(a.theta - b.theta).max() for a, b in zip(curved.seen[1:], curved.seen, strict=False)
    }
    assert len(lengths) > 3


def cliff(theta: Array, private: Array) -> Array:
    """Residuals that diverge for theta below 0.2, close to the minimum.

    The first steps from the right overshoot into that region.
    """
    bad = np.real(theta[0]) < 0.2
    x = np.linspace(0.0, 1.0, 12)
    y = 1.0 / (0.25 + x)
    return np.where(bad, np.nan, 100.0 * (1.0 / (theta[0] + x) - y))


def test_diverging_trials_shorten_the_step() -> None:
    """A search that starts where the simulation diverges has no solution."""
    p = problem(cliff, lower=[-10.0])
    found = solved(p, alone(3.0))
    assert any(at.theta[0] < 0.2 for at in p.seen), "no step led off the cliff"
    assert found.success
    assert found.unknowns.theta[0] == pytest.approx(0.25, rel=1e-6)
    newton = problem(cliff, lower=[-10.0])
    undamped = solved(
        newton, alone(3.0), SearchSettings(max_iterations=60, tolerance=1e-9, damped=False)
    )
    assert any(at.theta[0] < 0.2 for at in newton.seen)
    assert undamped.unknowns.theta[0] == pytest.approx(0.25, rel=1e-6)
    assert minimise(p, alone(0.1), SHARP) is None


def test_a_minimum_at_a_cliff_is_not_called_converged() -> None:
    """The cost falls up to the border of the region that cannot be simulated."""

    def rows(theta: Array, private: Array) -> Array:
        bad = np.real(theta[0]) < 1.0
        return np.where(bad, np.nan, np.array([10.0 * theta[0], 3.0 * theta[0] + 1.0]))

    found = solved(problem(rows, lower=[-10.0]), alone(3.0))
    assert 1.0 <= found.unknowns.theta[0] < 1.1
    assert not found.success
    assert "converged" not in found.status.replace("not converged", "")


def test_a_diverging_neighbourhood_is_reported() -> None:
    """The linearisation fails after a step.

    The best point is returned with the previous linearisation.
    """

    class Once(Analytic):
        def condense(self, at: UnknownValues) -> Condensed | None:
            return super().condense(at) if at.theta[0] == -1.2 else None

    p = Once((rosenbrock,), np.full(2, -5.0), np.full(2, 5.0))
    found = solved(p, alone(-1.2, 1.0))
    assert not found.success
    assert "diverges" in found.status
    assert found.cost < p.cost(alone(-1.2, 1.0))
    assert minimise(p, alone(-1.0, 1.0), SHARP) is None


@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("fault", ["sign", "swapped", "noise"])
def test_a_wrong_jacobian_is_noticed(damped: bool, fault: str) -> None:
    """No step lowers the cost although the linearisation predicts it.

    The search has not converged, even where damped steps are short.
    """
    rng = np.random.default_rng(3)
    spoils = {
        "sign": lambda J: -J,
        "swapped": lambda J: J[:, ::-1],
        "noise": lambda J: rng.standard_normal(J.shape) * np.linalg.norm(J, axis=0),
    }
    p = peaked(spoil=spoils[fault])
    found = solved(p, alone(1.0, -0.5, 1.5), SearchSettings(damped=damped))
    assert found.cost > 1.05 * reference(p, alone(1.0, -0.5, 1.5))[2], (
        "it is at the minimum in spite of all"
    )
    assert not found.success
    assert found.status.startswith(("stopped", "not converged"))


def test_numerical_noise_does_not_prevent_convergence() -> None:
    """With round-off far above machine precision the search still succeeds close to the minimum."""
    for seed in range(10):

        def rough(theta: Array, private: Array, seed: int = seed) -> Array:
            ripple = np.sin(1e9 * (seed + 1) * np.sum(np.real(theta)) + np.arange(60.0))
            return peak(theta, private) * (1.0 + 1e-7 * ripple)

        found = solved(
            problem(rough, lower=[0.0, -3.0, 0.1]),
            alone(1.0, -0.5, 1.5),
            SearchSettings(tolerance=1e-6),
        )
        theta, _, cost = reference(peaked(), alone(2.0, 0.4, 0.7))
        assert found.success, found.status
        assert found.cost < cost + 1e-3
        assert_allclose(found.unknowns.theta, theta, rtol=1e-3)


def test_a_search_from_the_minimum_ends_at_once() -> None:
    """Residuals vanish at the minimum, or they do not."""
    exact = solved(valley(), alone(1.0, 1.0))
    assert exact.success
    assert exact.iterations == 1
    theta, _, _ = reference(peaked(), alone(1.0, -0.5, 1.5))
    again = solved(peaked(), alone(*theta), SearchSettings())
    assert again.success
    assert again.iterations <= 2
    assert_allclose(again.unknowns.theta, theta, rtol=1e-6)


def test_short_first_steps_in_a_flat_valley_are_not_convergence() -> None:
    """The first steps on the floor of a narrow valley are short.

    The minimum is ten standard deviations away.
    """
    for thin in (1e-2, 1e-3, 1e-4, 1e-5):

        def rows(theta: Array, private: Array, thin: float = thin) -> Array:
            total, apart = theta[0] + theta[1], theta[0] - theta[1]
            return np.array([total - 2.0, thin * apart - 10.0])

        found = solved(problem(rows, lower=[-FREE, -FREE]), alone(1.0, 1.0), SearchSettings())
        assert found.success, found.status
        assert_allclose(thin * (found.unknowns.theta @ [1.0, -1.0]), 10.0, rtol=0, atol=0.02)


@pytest.mark.parametrize("stop", [1, 2, 3, 7])
def test_a_requested_stop_returns_the_best_so_far(stop: int) -> None:
    """The token is set during the evaluation with this number; no further point is evaluated."""
    p = valley(stop=stop)
    found = solved(p, alone(-1.2, 1.0))
    assert found.interrupted
    assert not found.success
    assert "interrupted" in found.status
    assert len(p.seen) == stop
    costs = [p.cost(at) for at in list(p.seen)]
    assert found.cost == min(costs)
    assert p.cost(found.unknowns) == found.cost


def test_an_exhausted_time_is_not_an_interruption() -> None:
    """The first point is returned with the reason, and nothing is raised."""
    found = minimise(valley(), alone(-1.2, 1.0), SHARP, Budget(seconds=0.0))
    assert not found.interrupted
    assert not found.success
    assert found.iterations == 0
    assert "the time is used up" in found.status


def test_the_limit_of_iterations_is_kept_and_reported() -> None:
    """The returned cost belongs to the returned unknowns."""
    p = valley()
    found = solved(p, alone(-1.2, 1.0), SearchSettings(max_iterations=3))
    assert found.iterations == 3
    assert not found.success
    assert "not converged in 3 iterations" in found.status
    assert p.cost(found.unknowns) == found.cost < p.cost(alone(-1.2, 1.0))


def test_the_last_linearisation_is_at_the_solution() -> None:
    """Without `relinearise_at_end`, it is the previous one."""
    start = together(0.3, 0.0)
    p = free_decays()
    found = solved(p, start, SearchSettings())
    fresh = p.condense(found.unknowns)
    assert_array_equal(found.condensed.blocks, fresh.blocks)
    saved = solved(p, start, SearchSettings(relinearise_at_end=False))
    assert_allclose(saved.unknowns.theta, found.unknowns.theta, rtol=1e-5)
    assert saved.cost == p.cost(saved.unknowns)
    assert not np.array_equal(saved.condensed.blocks, fresh.blocks)
    assert_allclose(saved.condensed.information(), fresh.information(), rtol=1e-3)


def halving(theta: Array, private: Array) -> Array:
    """A residual beside a constant one; each Gauss-Newton step is half of the one before."""
    return np.array([theta[0] ** 2, np.sqrt(10.0) + 0.0 * theta[0]])


def test_a_first_step_is_the_last_one_only_where_it_is_short() -> None:
    """A step tells nothing about the one that follows, if there was none before it."""
    start = alone(0.5)
    p = problem(halving, lower=[-5.0])
    condensed = p.condense(start)
    settings = SearchSettings(tolerance=1e-2, relinearise_at_end=False, damped=True)
    free = np.array([FREE])
    first = condensed.step(0.0, condensed.column_norms, -free, free)
    assert 0.22 < first.common_length < 0.3
    assert solved(p, start, settings).iterations > 1

    # A much shorter one suffices.
    assert solved(p, alone(0.3), settings).iterations == 1


def test_a_rough_search_ends_where_a_step_hardly_lowers_the_cost() -> None:
    start = together(0.3, 0.0)
    p = free_decays()
    exact = solved(p, start, SearchSettings())
    rough = solved(p, start, SearchSettings(relinearise_at_end=False, rough_share=0.1))
    assert rough.success
    assert rough.iterations < exact.iterations

    # The last step is taken, and the one before it promised more.
    assert rough.cost == p.cost(rough.unknowns)
    assert exact.cost <= rough.cost < 1.1 * exact.cost

    # Where it costs too little for that, the search goes on.
    settings = SearchSettings(rough_share=0.1, rough_above=2.0 * rough.cost)
    assert solved(p, start, settings).cost == pytest.approx(exact.cost)


def curve(t: Array, y: Array) -> Rows:
    """Residuals of an exponential curve at times t."""

    def rows(theta: Array, private: Array) -> Array:
        return theta[0] * np.exp(-theta[1] * t) - y

    return rows


def drifting(seed: int) -> Analytic:
    """An exponential curve whose residuals drift slowly, in forty segments."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 4.0, 800)
    drift = np.cumsum(rng.standard_normal(800)) * 0.3
    y = 100.0 * np.exp(-0.7 * t) + drift
    parts = [curve(t[i : i + 20], y[i : i + 20]) for i in range(0, 800, 20)]
    return problem(*parts, lower=[-FREE, -FREE])


def test_lengths_in_true_deviations_end_a_search_earlier_where_residuals_drift() -> None:
    start = alone(60.0, 0.3, segments=40)
    formal = drifting(0)
    true = drifting(0)
    exact = minimise(formal, start, SearchSettings(tolerance=1e-3))
    found = minimise(true, start, SearchSettings(tolerance=1e-3, in_true_deviations=True))
    assert exact is not None and found is not None and exact.success and found.success
    assert len(true.seen) < len(formal.seen)

    # The difference is a small share of the formal standard deviations, and smaller of the true.
    H = exact.condensed.information()
    missed = found.unknowns.theta - exact.unknowns.theta
    assert np.sqrt(missed @ H @ missed) < 1e-3 * found.condensed.true_deviation
    assert found.condensed.true_deviation > 3.0


def test_a_search_ends_where_it_cannot_beat_a_cost() -> None:
    start = alone(60.0, 0.3, segments=40)
    whole = drifting(0)
    exact = minimise(whole, start, SHARP)

    # A cost that lies below the minimum cannot be beaten; one that lies above it is.
    ended = drifting(0)
    settings = SearchSettings(tolerance=1e-9, cost_to_beat=0.5 * exact.cost)
    found = minimise(ended, start, settings)
    assert found is not None and not found.success
    assert found.status == "stopped: another minimum costs less"
    assert len(ended.seen) < len(whole.seen)
    beaten = minimise(
        drifting(0), start, SearchSettings(tolerance=1e-9, cost_to_beat=2 * exact.cost)
    )
    assert beaten is not None and beaten.success
    assert beaten.cost == pytest.approx(exact.cost)


@dataclass(eq=False)
class Robust(Analytic):
    """Residuals under a robust loss, which is linearised by weights.

    Attributes:
        loss: The loss.
        linearisations: Number of linearisations.
    """

    loss: RobustLoss = field(default_factory=lambda: RobustLoss(kind="soft_l1", scale=1.0))
    linearisations: int = 0

    def cost(self, at: UnknownValues) -> float:
        self.seen.append(at)
        return 0.5 * sum(self.loss.value(r) for r in self.residuals(at))

    def condense(self, at: UnknownValues) -> Condensed | None:
        self.linearisations += 1
        weights = [self.loss.weight(r) for r in self.residuals(at)]
        weighted = tuple(
            lambda theta, private, rows=rows, w=w: w * rows(theta, private)
            for rows, w in zip(self.segments, weights, strict=True)
        )
        return Analytic(weighted, self.lower, self.upper).condense(at)


def outliers() -> Robust:
    """A parabola with noise of one standard deviation, a third of whose values are far too high."""
    rng = np.random.default_rng(3)
    t = np.linspace(-1.0, 1.0, 300)
    A = np.stack([np.ones(300), t, t**2], axis=1)
    y = A @ [5.0, -30.0, 20.0] + rng.standard_normal(300) + 25.0 * (rng.random(300) < 0.33)

    def rows(theta: Array, private: Array) -> Array:
        return A @ theta - y

    return Robust((rows,), np.full(3, -FREE), np.full(3, FREE))


def test_longer_steps_reach_the_minimum_of_a_robust_loss_sooner() -> None:
    start = alone(0.0, 0.0, 0.0)
    plain, longer = outliers(), outliers()
    found = minimise(plain, start, SearchSettings(tolerance=1e-6))
    sooner = minimise(longer, start, SearchSettings(tolerance=1e-6, lengthens=True))
    assert found is not None and sooner is not None and sooner.success
    assert longer.linearisations < 0.75 * plain.linearisations
    expected = least_squares(
        lambda theta: longer.segments[0](theta, np.zeros(0)),
        start.theta,
        loss="soft_l1",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    ).x
    assert_allclose(sooner.unknowns.theta, expected, rtol=0.0, atol=1e-4)
    assert sooner.cost == longer.cost(sooner.unknowns)

    # Reported costs are those of the points at which the search went on.
    costs = [longer.cost(start)]
    again = minimise(
        outliers(),
        start,
        SearchSettings(tolerance=1e-6, lengthens=True),
        callback=lambda iteration, cost, length: costs.append(cost),
    )
    assert again is not None and costs[-1] == again.cost
    assert (np.diff(costs) < 0.0).all()


def beside_a_cliff(theta: Array, private: Array) -> Array:
    """The sum of two unknowns is well determined; far along their difference is a cliff."""
    difference = theta[0] - theta[1]
    bad = np.real(difference) > 3.0
    return np.where(bad, np.nan, np.array([1e3 * (theta[0] + theta[1] - 4.0), difference - 100.0]))


def test_a_step_that_is_shorter_along_a_weak_direction_is_tried() -> None:
    """The length of a step in standard deviations is that of its strong direction."""
    p = problem(beside_a_cliff, lower=[-FREE, -FREE])
    settings = SearchSettings(tolerance=1e-9, begins_near=True, max_iterations=1)
    found = minimise(p, alone(0.0, 0.0), settings)
    sum_of_both, difference = found.unknowns.theta @ [[1.0, 1.0], [1.0, -1.0]]
    assert sum_of_both == pytest.approx(4.0, rel=1e-3)

    # The damping is raised by powers of two, so that much of what is possible is tried.
    assert 0.1 < difference <= 3.0


def test_one_stagnant_iteration_is_enough_where_no_more_is_predicted() -> None:
    start = alone(60.0, 0.3, segments=40)
    settings = SearchSettings(
        tolerance=1e-9, in_true_deviations=True, relinearise_at_end=False, begins_near=True
    )
    p = drifting(0)
    costs = [p.cost(start)]
    found = minimise(
        p, start, settings, callback=lambda iteration, cost, length: costs.append(cost)
    )
    exact = minimise(drifting(0), start, SHARP)
    assert found is not None and exact is not None and found.success
    assert found.status == "converged: the residual stopped falling"

    # Only the last decrease is below a hundredth of the square of a true standard deviation.
    negligible = ABSOLUTE_STAGNATION * 2.0 * found.condensed.true_deviation**2
    is_negligible = -np.diff([*costs, found.cost]) <= negligible
    assert is_negligible[-1]
    assert not is_negligible[:-1].any()

    # What is missed is far below the true accuracy.
    H = exact.condensed.information()
    missed = found.unknowns.theta - exact.unknowns.theta
    assert np.sqrt(missed @ H @ missed) < 0.15 * found.condensed.true_deviation


@pytest.mark.parametrize(
    ("unit", "promised", "ends"),
    [
        pytest.param(5.0, 0.3, True, id="no more is predicted"),
        pytest.param(5.0, 30.0, False, id="much more is predicted"),
        pytest.param(1.0, 0.003, False, id="formal deviations are the true ones"),
    ],
)
def test_one_stagnant_iteration_may_be_chance(unit: float, promised: float, ends: bool) -> None:
    settings = SearchSettings(relinearise_at_end=False)
    p, start = valley(), alone(-1.2, 1.0)
    search = _Search(p, settings, Budget(), None, start, 100.0, p.condense(start), unit=unit)
    trial = SimpleNamespace(cost=100.0 - 0.005 * unit)
    predicted = SimpleNamespace(predicted_decrease=promised)
    assert search._stagnates(trial, predicted) == ends
    assert search._stagnates(trial, predicted)


def test_a_search_that_leads_to_a_start_ends_where_its_cost_hardly_falls() -> None:
    start = together(0.3, 0.0)
    whole, ended = (free_decays() for _ in range(2))
    exact = solved(whole, start, SearchSettings())
    found = solved(ended, start, SearchSettings(stagnant_share=0.9))
    assert found.iterations < exact.iterations
    assert exact.cost <= found.cost < whole.cost(start)

    # It is no failure: such searches need not converge.
    assert found.success and found.rough and found.slow and not found.stuck
    assert found.status == "near the minimum"
    assert found.cost == ended.cost(found.unknowns)
