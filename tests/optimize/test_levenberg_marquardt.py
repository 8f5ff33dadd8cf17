"""Bounded Levenberg-Marquardt on small analytic problems, compared with SciPy.

The status names the reason where the search fails.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

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
    minimise,
)
from mjfim.parallel.budget import Budget, StopToken
from tests.support.numerics import Array

Rows = Callable[[Array, Array], Array]
FREE = np.inf
SHARP = SearchSettings(max_iterations=200, tolerance=1e-9)
UNDAMPED = replace(SHARP, damped=False)


class Analytic:
    """Residuals of segments as functions of theta and of the private unknowns of the segment.

    Derivatives are computed by complex steps. All evaluated points, and all of a linearisation, are
    kept.
    """

    def __init__(
        self,
        *segments: Rows,
        lower: Any = -FREE,
        upper: Any = FREE,
        spoil: Callable[[Array], Array] = np.asarray,
        loss: RobustLoss | None = None,
        stop: float = FREE,
    ) -> None:
        """Residuals of every segment, with bounds of theta.

        `spoil` changes the (k, n + c) Jacobian of a segment. The evaluation with the number `stop`
        sets the stop token.
        """
        self.segments, self.lower, self.upper = segments, np.array(lower), np.array(upper)
        self.spoil, self.loss = spoil, loss or RobustLoss(kind="linear")
        self.stop, self.token = stop, StopToken()
        self.seen, self.linearised = [], []

    def residuals(self, at: UnknownValues) -> list[Array]:
        return [
            rows(at.theta, private) for rows, private in zip(self.segments, at.private, strict=True)
        ]

    def cost(self, at: UnknownValues) -> float:
        self.seen.append(at)
        if len(self.seen) >= self.stop:
            self.token.request()
        with np.errstate(all="ignore"):
            half = 0.5 * sum(self.loss.value(r) for r in self.residuals(at))
        return half if np.isfinite(half) else np.inf

    def condense(self, at: UnknownValues) -> Condensed | None:
        self.linearised.append(at)
        n, c = at.private.shape[1], len(at.theta)
        blocks = []
        for rows, private, r in zip(self.segments, at.private, self.residuals(at), strict=True):
            moved = np.concatenate([private, at.theta]) + 1e-30j * np.eye(n + c)
            J = np.stack([rows(z[n:], z[:n]).imag / 1e-30 for z in moved], axis=1)
            both = self.loss.weight(r)[:, None] * np.column_stack([self.spoil(J), r])
            padded = np.concatenate([both, np.zeros((n + c + 1,) * 2)])
            blocks.append(np.linalg.qr(padded, mode="r"))
        if not np.isfinite(blocks).all():
            return None
        return Condensed(
            blocks=np.array(blocks),
            segment_of_block=np.arange(len(blocks)),
            private_rows=np.zeros((len(blocks), 0, n + c + 1)),
            common_rows=np.zeros((0, c + 1)),
        )

    def bounds_at(self, at: UnknownValues) -> tuple[Array, Array]:
        return self.lower, self.upper

    def moved(self, at: UnknownValues, step: Step, length: float) -> UnknownValues:
        theta = np.clip(at.theta + length * step.common, self.lower, self.upper)
        return UnknownValues(theta=theta, private=at.private + length * step.private)

    def common_values(self, at: UnknownValues) -> Array:
        return at.theta


def reference(p: Analytic, start: UnknownValues) -> tuple[Array, Array, float]:
    """theta, private unknowns and half of the squares by SciPy, with all unknowns in one vector."""
    c, size = len(start.theta), start.private.size

    def unknowns(z: Array) -> UnknownValues:
        return UnknownValues(theta=z[:c], private=z[c:].reshape(start.private.shape))

    none = np.full(size, FREE)
    lower, upper = (np.broadcast_to(bound, c) for bound in (p.lower, p.upper))
    found = least_squares(
        lambda z: np.concatenate(p.residuals(unknowns(z))),
        np.concatenate([start.theta, start.private.ravel()]),
        "cs",
        (np.concatenate([lower, -none]), np.concatenate([upper, none])),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        x_scale="jac",
        max_nfev=5000,
    )
    best = unknowns(found.x)
    return best.theta, best.private, found.cost


def solved(
    p: Analytic, start: UnknownValues, search: SearchSettings = SHARP, **callback: Any
) -> Solution:
    """Solution of `minimise`."""
    found = minimise(p, start, search, Budget(stop=p.token), **callback)
    assert found is not None
    return found


def decays() -> tuple[Rows, ...]:
    """Exponential decays with a common rate and offset.

    The amplitude of each segment is its private unknown.
    """
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 2.0, 25)
    found = []
    for amplitude in (1.0, 0.4, -2.0):
        y = amplitude * np.exp(-1.7 * t) + 0.3 + 0.01 * rng.standard_normal(len(t))
        found.append(
            lambda theta, private, y=y: (private[0] * np.exp(-theta[0] * t) + theta[1] - y) / 0.01
        )
    return tuple(found)


def rosenbrock(theta: Array, private: Array) -> Array:
    """The function of Rosenbrock, a bent valley with its minimum at (1, 1)."""
    return np.array([100.0 * (theta[1] - theta[0] ** 2), 10.0 * (1.0 - theta[0])])


def powell(theta: Array, private: Array) -> Array:
    """Powell's badly scaled function: the minimum is near (1.1e-5, 9.1)."""
    return np.array([1e4 * theta[0] * theta[1] - 1.0, np.sum(np.exp(-theta)) - 1.0001])


X = np.linspace(-3.0, 3.0, 60)
NOISE = 0.05 * np.random.default_rng(1).standard_normal(60)


def peak(theta: Array, private: Array) -> Array:
    """A Gaussian peak on noise."""
    y = 2.0 * np.exp(-((X - 0.4) ** 2) / (2 * 0.7**2)) + NOISE
    return (theta[0] * np.exp(-((X - theta[1]) ** 2) / (2 * theta[2] ** 2)) - y) / 0.05


def alone(*theta: float, segments: int = 1) -> UnknownValues:
    """A start without private unknowns."""
    return UnknownValues(theta=np.array(theta), private=np.zeros((segments, 0)))


def together(*theta: float) -> UnknownValues:
    """A start of the decays, whose amplitudes are one."""
    return UnknownValues(theta=np.array(theta), private=np.ones((3, 1)))


def free_decays() -> Analytic:
    """The decays within bounds that are far away."""
    return Analytic(*decays(), lower=[0.0, -5.0])


def valley(lower: Any = -5.0, upper: Any = 5.0, **more: Any) -> Analytic:
    """The valley of Rosenbrock, by default within wide bounds."""
    return Analytic(rosenbrock, lower=lower, upper=upper, **more)


def peaked(**more: Any) -> Analytic:
    """The peak within wide bounds."""
    return Analytic(peak, **{"lower": [0.0, -3.0, 0.1], "upper": [10.0, 3.0, 5.0], **more})


BENT = alone(-1.2, 1.0)
HIGH = alone(1.0, -0.5, 1.5)

CASES = {
    "decays": (free_decays, together(0.3, 0.0)),
    "decays without damping": (lambda: Analytic(*decays()), together(1.0, 0.4), UNDAMPED),
    "bounded decays": (
        lambda: Analytic(*decays(), lower=[0.0, 0.35], upper=[1.2, 2.0]),
        together(0.3, 1.0),
    ),
    "valley": (valley, BENT),
    "valley without damping": (lambda: valley(-FREE, FREE), BENT, UNDAMPED),
    "walled valley": (lambda: valley(-2.0, [0.6, 5.0]), BENT),
    "valley from the wall": (lambda: valley([-2.0, 1.5], [5.0, 3.0]), alone(-2.0, 1.5)),
    "badly scaled": (lambda: Analytic(powell, lower=0.0, upper=[1.0, 20.0]), alone(0.0, 1.0)),
    "peak": (peaked, HIGH),
    "held at a wall": (
        lambda: peaked(lower=[0.0, -3.0, 1.0], upper=[1.5, 3.0, 5.0]),
        alone(1.0, 1.0, 2.0),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_minimum_agrees_with_scipy(name: str) -> None:
    """No evaluated point leaves the bounds, and the cost falls from iterate to iterate."""
    build, start, *settings = CASES[name]
    p, reports = build(), []
    found = solved(p, start, *settings, callback=lambda *report: reports.append(report))
    theta, starts, cost = reference(build(), start)
    assert found.success, found.status
    assert found.cost <= cost * (1 + 1e-9) + 1e-12
    assert_allclose(found.unknowns.theta, theta, rtol=1e-6, atol=1e-8)
    assert_allclose(found.unknowns.private, starts, rtol=1e-6, atol=1e-8)
    for at in p.seen:
        assert (at.theta >= p.lower).all() and (at.theta <= p.upper).all()
    iterations, costs, _ = zip(*reports, strict=True)
    assert list(costs) == sorted(costs, reverse=True)
    assert iterations == tuple(range(1, len(reports) + 1))
    assert found.cost == costs[-1] == pytest.approx(p.cost(found.unknowns), rel=1e-12)


def cliff(theta: Array, private: Array) -> Array:
    """Residuals that diverge for theta below 0.2, close to the minimum.

    The first steps from the right overshoot into that region.
    """
    x = np.linspace(0.0, 1.0, 12)
    rows = 100.0 * (1.0 / (theta[0] + x) - 1.0 / (0.25 + x))
    return np.where(np.real(theta[0]) < 0.2, np.nan, rows)


@pytest.mark.parametrize("settings", [SHARP, UNDAMPED])
def test_diverging_trials_shorten_the_step(settings: SearchSettings) -> None:
    """A search that starts where the simulation diverges has no solution."""
    p = Analytic(cliff, lower=[-10.0])
    found = solved(p, alone(3.0), settings)
    assert any(at.theta[0] < 0.2 for at in p.seen), "no step led off the cliff"
    assert found.success
    assert found.unknowns.theta[0] == pytest.approx(0.25, rel=1e-6)
    assert minimise(p, alone(0.1), settings) is None


def test_a_minimum_at_a_cliff_is_not_called_converged() -> None:
    """The cost falls up to the border of the region that cannot be simulated."""

    def rows(theta: Array, private: Array) -> Array:
        bad = np.real(theta[0]) < 1.0
        return np.where(bad, np.nan, np.array([10.0 * theta[0], 3.0 * theta[0] + 1.0]))

    found = solved(Analytic(rows, lower=[-10.0]), alone(3.0))
    assert 1.0 <= found.unknowns.theta[0] < 1.1
    assert not found.success
    assert "converged" not in found.status.replace("not converged", "")


def test_a_diverging_neighbourhood_is_reported() -> None:
    """The linearisation fails after a step.

    The best point is returned with the previous linearisation.
    """
    p = valley()
    p.spoil = lambda J: J if len(p.linearised) == 1 else np.nan * J
    found = solved(p, BENT)
    assert not found.success
    assert "diverges" in found.status
    assert found.cost < p.cost(BENT)
    assert minimise(p, BENT, SHARP) is None


SPOILS = {
    "sign": lambda J: -J,
    "swapped": lambda J: J[:, ::-1],
    "noise": lambda J: (
        np.random.default_rng(3).standard_normal(J.shape) * np.linalg.norm(J, axis=0)
    ),
}


@pytest.mark.parametrize("damped", [True, False])
@pytest.mark.parametrize("fault", SPOILS)
def test_a_wrong_jacobian_is_noticed(damped: bool, fault: str) -> None:
    """No step lowers the cost although the linearisation predicts it.

    The search has not converged, even where damped steps are short.
    """
    found = solved(peaked(spoil=SPOILS[fault]), HIGH, SearchSettings(damped=damped))
    assert found.cost > 1.05 * reference(peaked(), HIGH)[2], "it is at the minimum in spite of all"
    assert not found.success
    assert found.status.startswith(("stopped", "not converged"))


def test_numerical_noise_does_not_prevent_convergence() -> None:
    """With round-off far above machine precision the search still succeeds close to the minimum."""
    theta, _, cost = reference(peaked(), alone(2.0, 0.4, 0.7))
    for seed in range(10):

        def rough(theta: Array, private: Array, seed: int = seed) -> Array:
            ripple = np.sin(1e9 * (seed + 1) * np.sum(np.real(theta)) + np.arange(60.0))
            return peak(theta, private) * (1.0 + 1e-7 * ripple)

        found = solved(
            Analytic(rough, lower=[0.0, -3.0, 0.1]), HIGH, SearchSettings(tolerance=1e-6)
        )
        assert found.success, found.status
        assert found.cost < cost + 1e-3
        assert_allclose(found.unknowns.theta, theta, rtol=1e-3)


def test_a_search_from_the_minimum_ends_at_once() -> None:
    """Residuals vanish at the minimum, or they do not."""
    exact = solved(valley(), alone(1.0, 1.0))
    assert (exact.success, exact.iterations) == (True, 1)
    again = solved(peaked(), alone(*reference(peaked(), HIGH)[0]), SearchSettings())
    assert again.success and again.iterations <= 2


def test_a_search_follows_a_flat_valley_to_its_end() -> None:
    """The first steps on the floor of a narrow valley are short, which is no convergence.

    The minimum is ten standard deviations away. Kinks, of which the best costs 900, do not stop it.
    """

    def rows(theta: Array, private: Array, thin: float = 0.1) -> Array:
        return theta @ [[1.0, thin], [1.0, -thin]] - [2.0, 10.0]

    def kinked(theta: Array, private: Array) -> Array:
        r = rows(theta, private)
        return r * np.sign(np.real(r)) + 30.0

    for thin in (1e-2, 1e-3, 1e-4, 1e-5):
        found = solved(Analytic(partial(rows, thin=thin)), alone(1.0, 1.0), SearchSettings())
        assert found.success, found.status
        assert found.cost < 2e-4
    assert solved(Analytic(kinked), alone(0.0, 0.0)).cost < 1000.0


@pytest.mark.parametrize("stop", [1, 2, 3, 7])
def test_a_requested_stop_returns_the_best_so_far(stop: int) -> None:
    """The token is set during the evaluation with this number; no further point is evaluated."""
    p = valley(stop=stop)
    found = solved(p, BENT)
    assert found.interrupted and not found.success and "interrupted" in found.status
    assert len(p.seen) == stop
    assert found.cost == min(valley().cost(at) for at in p.seen) == p.cost(found.unknowns)


@pytest.mark.parametrize(
    ("settings", "seconds", "iterations", "said"),
    [
        (SHARP, 0.0, 0, "the time is used up"),
        (SearchSettings(max_iterations=3), np.inf, 3, "not converged in 3 iterations"),
    ],
)
def test_an_exhausted_budget_is_not_an_interruption(
    settings: SearchSettings, seconds: float, iterations: int, said: str
) -> None:
    """The best point is returned with the reason, and nothing is raised."""
    found = minimise(valley(), BENT, settings, Budget(seconds=seconds))
    assert not found.interrupted and not found.success
    assert found.iterations == iterations and said in found.status
    assert found.cost == valley().cost(found.unknowns) <= valley().cost(BENT)


def test_the_last_linearisation_is_at_the_solution() -> None:
    """Without `relinearise_at_end`, it is the previous one."""
    start, p = together(0.3, 0.0), free_decays()
    found = solved(p, start, SearchSettings())
    fresh = p.condense(found.unknowns)
    assert_array_equal(found.condensed.blocks, fresh.blocks)
    saved = solved(p, start, SearchSettings(relinearise_at_end=False))
    assert_allclose(saved.unknowns.theta, found.unknowns.theta, rtol=1e-5)
    assert saved.cost == p.cost(saved.unknowns)
    assert not np.array_equal(saved.condensed.blocks, fresh.blocks)
    assert_allclose(saved.condensed.information(), fresh.information(), rtol=1e-3)

    # Its residuals are those of the solution to first order.
    squares = np.sum(saved.condensed.triangles[:, :, -1] ** 2)
    assert 0.5 * squares == pytest.approx(saved.cost, rel=1e-6)


@pytest.mark.parametrize(("begin", "iterations"), [(0.5, 2), (0.3, 1)])
def test_a_first_step_is_the_last_one_only_where_it_is_short(begin: float, iterations: int) -> None:
    """A step tells nothing about the one that follows, if there was none before it.

    A residual stands beside a constant one; each Gauss-Newton step is half of the one before.
    """

    def halving(theta: Array, private: Array) -> Array:
        return np.array([theta[0] ** 2, np.sqrt(10.0) + 0.0 * theta[0]])

    settings = SearchSettings(tolerance=1e-2, relinearise_at_end=False)
    assert solved(Analytic(halving, lower=[-5.0]), alone(begin), settings).iterations == iterations


@pytest.mark.parametrize(
    "settings", [{"relinearise_at_end": False, "rough_share": 0.1}, {"stagnant_share": 0.9}]
)
def test_a_search_may_end_where_its_cost_hardly_falls(settings: Any) -> None:
    """A rough search, and one that leads to a start; it is no failure that it has not converged."""
    start, p = together(0.3, 0.0), free_decays()
    exact = solved(free_decays(), start, SearchSettings())
    found = solved(p, start, SearchSettings(**settings))
    assert found.success
    assert found.iterations < exact.iterations
    assert found.cost == p.cost(found.unknowns)
    if "rough_share" in settings:
        # The last step is taken, and the one before it promised more. Where it costs too little for
        # that, the search goes on.
        assert exact.cost <= found.cost < 1.1 * exact.cost
        whole = SearchSettings(rough_share=0.1, rough_above=2.0 * found.cost)
        assert solved(p, start, whole).cost == pytest.approx(exact.cost)
    else:
        assert exact.cost <= found.cost < p.cost(start)
        assert found.rough and found.slow and not found.stuck
        assert found.status == "near the minimum"


FAR = alone(60.0, 0.3, segments=40)


def drifting() -> Analytic:
    """An exponential curve whose residuals drift slowly, in forty segments."""
    t = np.linspace(0.0, 4.0, 800)
    drift = np.cumsum(np.random.default_rng(0).standard_normal(800)) * 0.3
    y = 100.0 * np.exp(-0.7 * t) + drift
    parts = [
        lambda theta, private, t=t[i : i + 20], y=y[i : i + 20]: (
            theta[0] * np.exp(-theta[1] * t) - y
        )
        for i in range(0, 800, 20)
    ]
    return Analytic(*parts)


def test_a_search_ends_where_it_cannot_beat_a_cost() -> None:
    """A cost that lies below the minimum cannot be beaten; one that lies above it is."""
    whole, ended = drifting(), drifting()
    exact = solved(whole, FAR)
    found = solved(ended, FAR, SearchSettings(tolerance=1e-9, cost_to_beat=0.5 * exact.cost))
    assert not found.success
    assert found.status == "stopped: another minimum costs less"
    assert len(ended.seen) < len(whole.seen)
    beaten = solved(drifting(), FAR, SearchSettings(tolerance=1e-9, cost_to_beat=2 * exact.cost))
    assert beaten.success
    assert beaten.cost == pytest.approx(exact.cost)


def test_longer_steps_reach_the_minimum_of_a_robust_loss_sooner() -> None:
    """A parabola with noise of one standard deviation; a third of the values is far too high."""
    rng, start = np.random.default_rng(3), alone(0.0, 0.0, 0.0)
    A = np.vander(np.linspace(-1.0, 1.0, 300), 3, increasing=True)
    y = A @ [5.0, -30.0, 20.0] + rng.standard_normal(300) + 25.0 * (rng.random(300) < 0.33)
    loss = RobustLoss(kind="soft_l1", scale=1.0)
    plain, longer = (Analytic(lambda theta, private: A @ theta - y, loss=loss) for _ in range(2))
    solved(plain, start, SearchSettings(tolerance=1e-6))

    # Reported costs are those of the points at which the search went on.
    costs = [longer.cost(start)]
    sooner = solved(
        longer,
        start,
        SearchSettings(tolerance=1e-6, lengthens=True),
        callback=lambda iteration, cost, length: costs.append(cost),
    )
    assert sooner.success
    assert len(longer.linearised) < 0.75 * len(plain.linearised)
    expected = least_squares(lambda theta: A @ theta - y, start.theta, loss="soft_l1").x
    assert_allclose(sooner.unknowns.theta, expected, rtol=0.0, atol=1e-4)
    assert sooner.cost == longer.cost(sooner.unknowns) == costs[-1]
    assert (np.diff(costs) < 0.0).all()


def test_a_step_that_is_shorter_along_a_weak_direction_is_tried() -> None:
    """The length of a step in standard deviations is that of its strong direction.

    The sum of two unknowns is well determined; far along their difference is a cliff.
    """

    def beside_a_cliff(theta: Array, private: Array) -> Array:
        difference = theta[0] - theta[1]
        rows = np.array([1e3 * (theta[0] + theta[1] - 4.0), difference - 100.0])
        return np.where(np.real(difference) > 3.0, np.nan, rows)

    settings = SearchSettings(tolerance=1e-9, begins_near=True, max_iterations=1)
    found = solved(Analytic(beside_a_cliff), alone(0.0, 0.0), settings)
    sum_of_both, difference = found.unknowns.theta @ [[1.0, 1.0], [1.0, -1.0]]
    assert sum_of_both == pytest.approx(4.0, rel=1e-3)

    # The damping is raised by powers of two, so that much of what is possible is tried.
    assert 0.1 < difference <= 3.0


def test_lengths_in_true_deviations_end_a_search_earlier_where_residuals_drift() -> None:
    """One stagnant iteration is enough where no more is predicted."""
    settings = SearchSettings(
        tolerance=1e-9, in_true_deviations=True, relinearise_at_end=False, begins_near=True
    )
    formal, p = drifting(), drifting()
    exact, costs = solved(formal, FAR), [p.cost(FAR)]
    found = solved(p, FAR, settings, callback=lambda number, cost, length: costs.append(cost))
    assert found.success
    assert found.status == "converged: the residual stopped falling"
    assert found.condensed.true_deviation > 3.0
    assert len(p.seen) < len(formal.seen)

    # Only the last decrease is below a hundredth of the square of a true standard deviation.
    negligible = ABSOLUTE_STAGNATION * 2.0 * found.condensed.true_deviation**2
    is_negligible = -np.diff([*costs, found.cost]) <= negligible
    assert is_negligible[-1] and not is_negligible[:-1].any()

    # What is missed is far below the true accuracy, and less with a linearisation at the end.
    whole = solved(drifting(), FAR, SearchSettings(tolerance=1e-3, in_true_deviations=True))
    H = exact.condensed.information()
    for each, share in ((found, 0.15), (whole, 1e-3)):
        missed = exact.unknowns.theta - each.unknowns.theta
        assert np.sqrt(missed @ H @ missed) < share * each.condensed.true_deviation
