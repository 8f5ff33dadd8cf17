"""Baselines: their curves, their budgets, their limits by an independent simulation, and their
gradients.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.budget import StopToken
from mjfim.excitation.designable import designable
from mjfim.excitation.interior_problem import InteriorProblem
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.signals import (
    Chirp,
    ExcitationSettings,
    Multisine,
    RandomSteps,
    fourier_basis,
    schroeder_phases,
)
from mjfim.studies.baselines.evaluator import BaselineSearch, ControlEvaluator, SearchResult
from mjfim.studies.baselines.methods import (
    METHODS,
    ExcitationFitter,
    random_search,
    reflected,
    run_baseline,
)
from mjfim.studies.baselines.parametric import (
    ParametricRun,
    ScipyDescent,
    fourier_runs,
    optimise_many,
    optimise_with_scipy,
    spline_runs,
)
from mjfim.studies.compare import _MethodRun
from tests.support.baselines import pendulum, played
from tests.support.paths import MODELS

STEPS = 40_000

# One method of each kind that runs without `-m slow`: a sweep, random steps, a series, a series
# refined by mjfim.
FAST_METHODS = ("chirp", "steps", "fourier5", "fourier5-mjfim")

FRAME = ExcitationSettings(
    t=np.arange(500) * 0.01, horizon=5.0, nu=2, min_frequency=0.1, max_frequency=5.0, may_jump=True
)


def arm(**limits: Any) -> Experiment:
    """One second of the servo arm, from rest to rest, with slow references."""
    return Experiment.from_file(MODELS / "servo_arm.toml").replace(
        horizon=1.0,
        cost={"control": 0.0},
        limits={"velocity": 3.0, "control_rate": 4.0, **limits},
        boundary={"start": "rest", "end": "rest", "position": 0.02, "velocity": 0.05},
    )


def order(experiment: Experiment, method: str, **options: Any) -> BaselineSearch:
    """A search of a minute, unless stated otherwise."""
    return BaselineSearch(
        **{"experiment": experiment, "method": method, "seconds": 60.0, **options}
    )


def evaluator_of(search: BaselineSearch) -> ControlEvaluator:
    """The evaluator of a search."""
    return ControlEvaluator(search=search)


@cache
def found(method: str) -> SearchResult:
    """The result of a method on the cart-pendulum with a small budget of steps."""
    return run_baseline(order(pendulum(), method, steps=STEPS, seed=1))


# ---- shapes


def crest(wave: Array) -> float:
    return float(np.abs(wave).max() / np.sqrt(np.mean(wave**2)))


@pytest.mark.parametrize("count", [5, 12, 30])
def test_schroeder_phases_lower_the_peak(count: int) -> None:
    order, t = np.arange(1, count + 1), np.arange(2000) / 2000
    for power in (np.ones(count), order**-1.0):
        phases = schroeder_phases(power)
        low, high = (
            crest((np.sqrt(power) * np.cos(2 * np.pi * np.outer(t, order) + p)).sum(axis=1))
            for p in (phases, 0.0)
        )
        assert low < 0.75 * high
        assert low < 2.2


def test_schroeder_phases_of_equal_powers_are_the_known_ones() -> None:
    k = np.arange(1, 9)
    np.testing.assert_allclose(
        np.exp(1j * schroeder_phases(np.ones(8))), np.exp(-1j * np.pi * k * (k - 1) / 8), atol=1e-12
    )


@pytest.mark.parametrize("kind", [Chirp, Multisine, RandomSteps])
def test_waves_are_of_size_one_for_any_numbers(kind: Any) -> None:
    rng, made = np.random.default_rng(0), kind(FRAME)
    for z in (
        np.zeros(made.parameter_count),
        np.ones(made.parameter_count),
        *rng.random((20, made.parameter_count)),
    ):
        wave = made.curve(z)
        assert wave.shape == (500, 2)
        assert np.isfinite(wave).all()
        assert np.abs(wave).max() <= 1.5 + 1e-9
        np.testing.assert_array_equal(wave, made.curve(z))


def test_chirps_stay_within_their_band() -> None:
    z = np.repeat([1.0, 0.3, 0.8, 0.25, 0.5], 2)
    wave = Chirp(FRAME).curve(z)[:, 0]
    crossings = np.flatnonzero(np.diff(np.sign(wave)))
    assert 0.5 / 0.01 / np.diff(crossings).max() >= 0.9 * FRAME.frequency(np.array([0.3]))[0]
    assert 0.5 / 0.01 / np.diff(crossings).min() <= 1.3 * FRAME.frequency(np.array([0.8]))[0]


def test_steps_are_held_or_pass_smoothly() -> None:
    z = np.random.default_rng(3).random(RandomSteps(FRAME).parameter_count)
    z[:2] = 0.5, 1.0
    held = RandomSteps(FRAME).curve(z)
    smooth = RandomSteps(
        ExcitationSettings(
            t=FRAME.t, horizon=5.0, nu=2, min_frequency=0.1, max_frequency=5.0, may_jump=False
        )
    ).curve(z)
    assert np.mean(np.abs(np.diff(held, axis=0)) > 0.0) < 0.05
    assert np.abs(np.diff(held, axis=0)).max() > 10.0 * np.abs(np.diff(smooth, axis=0)).max()
    assert np.abs(smooth[0]).max() < 1e-3  # it begins at rest


def test_numbers_are_reflected_at_their_ends() -> None:
    np.testing.assert_allclose(
        reflected(np.array([-0.2, 0.3, 1.1, 2.3, -1.4])), [0.2, 0.3, 0.9, 0.3, 0.6]
    )


# ---- limits and budgets


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(name, marks=[] if name in FAST_METHODS else pytest.mark.slow)
        for name in METHODS
    ],
)
@pytest.mark.slow
def test_every_baseline_keeps_the_limits_and_its_budget(method: str) -> None:
    result = found(method)
    assert result.control is not None
    assert np.isfinite(result.cost)
    qpos, _, ctrl = played(pendulum(), result.control)
    assert np.abs(qpos[:, 0]).max() <= 0.5
    assert np.abs(ctrl).max() <= 5.0
    assert 0.5 * STEPS < result.steps < 1.2 * STEPS
    task = DesignTask.resolve(pendulum())
    point = task.problem.point(task.plant.simulate(task.theta, result.control))
    assert point.cost == pytest.approx(result.cost, rel=1e-3)
    assert (
        point.cost < 0.5 * task.problem.point(task.initial).cost
    )  # of a start that even leaves the limits


@pytest.mark.slow
def test_amplitudes_go_up_to_the_limits() -> None:
    for method in ("chirp", "multisine", "steps"):
        control = found(method).control
        assert control is not None
        qpos, _, ctrl = played(pendulum(), control)
        assert max(np.abs(qpos[:, 0]).max() / 0.5, np.abs(ctrl).max() / 5.0) > 0.9


def test_seconds_end_a_search() -> None:
    result = run_baseline(order(pendulum(), "steps", seconds=0.4))
    assert result.seconds < 2.0
    assert result.control is not None


def test_a_budget_of_steps_makes_it_repeatable() -> None:
    first, again, other = (
        run_baseline(order(pendulum(), "chirp", steps=8_000, seed=s)) for s in (4, 4, 5)
    )
    assert first.control is not None
    assert other.control is not None
    np.testing.assert_array_equal(first.control, again.control)
    assert not np.array_equal(first.control, other.control)


def test_workers_share_the_steps() -> None:
    search = order(pendulum(), "steps", steps=40_000)
    task = DesignTask.resolve(search.experiment)
    with ThreadPoolExecutor(2) as executor:
        run = _MethodRun(
            search=search,
            index=0,
            count=1,
            callback=None,
            executor=executor,
            stop=StopToken(),
            identifiability=designable(task),
        )
        result = run.divided_baseline(executor, System.resolve(search.experiment))
    assert result is not None
    assert result.control is not None
    assert result.steps < 1.2 * 40_000 + 2 * 8_000


@pytest.mark.parametrize(
    "method",
    ["steps", *(pytest.param(name, marks=pytest.mark.slow) for name in ("chirp", "fourier5"))],
)
def test_excitations_lead_from_rest_to_rest_without_jumps(method: str) -> None:
    experiment = arm(bandwidth=6.0)
    task = DesignTask.resolve(experiment)
    result = run_baseline(order(experiment, method, steps=100_000))
    assert result.control is not None
    assert np.isfinite(result.cost)
    padded = np.concatenate([task.initial_hold[None], result.control, task.initial_hold[None]])
    assert np.abs(np.diff(padded, axis=0)).max() <= 4.0 / 100.0 + 1e-12
    qpos, qvel, _ = played(experiment, result.control)
    assert np.abs(qvel).max() <= 3.0
    assert np.abs(qpos[-1] - qpos[0]).max() <= 0.02
    assert np.abs(qvel[-1]).max() <= 0.05
    spectrum = np.abs(np.fft.rfft(result.control - task.initial_hold, axis=0, n=1000)) ** 2
    assert spectrum[np.fft.rfftfreq(1000, 0.01) > 15.0].sum() < 1e-2 * spectrum.sum()


def test_limits_that_no_control_keeps_show_in_a_negative_margin() -> None:
    """A released pendulum does not return to its initial state under any chirp."""
    swinging = pendulum(
        initial={"keyframe": None, "qpos": (0.0, 1.0), "qvel": (0.0, 0.0)},
        boundary={"end": "periodic", "position": 1e-5, "velocity": 1e-5},
    )
    result = run_baseline(order(swinging, "chirp", steps=10_000))
    assert result.cost == np.inf
    assert result.margin < 0.0
    assert result.control is not None


@pytest.mark.slow
def test_weights_are_part_of_the_cost() -> None:
    """Without limits, J includes the effort, so that the largest excitation is not the best."""
    soft = Experiment.from_file(MODELS / "cart_pendulum.toml").replace(horizon=2.0)
    task = DesignTask.resolve(soft)
    assert not task.is_limited
    for method in ("multisine", "fourier5"):
        result = run_baseline(order(soft, method, steps=STEPS))
        assert result.control is not None
        point = task.problem.point(task.plant.simulate(task.theta, result.control))
        assert point.cost == pytest.approx(result.cost, rel=1e-3)
        assert point.criterion is not None
        assert point.cost < task.problem.point(task.initial).cost
        assert 0.1 < point.criterion.value / point.cost < 0.99  # both terms count
    assert ExcitationFitter(evaluator_of(order(soft, "chirp", seconds=1.0))).has_weights


# ---- series


def test_the_usual_frequencies_come_first_and_stay_within_the_bandwidth() -> None:
    evaluator = evaluator_of(order(pendulum(bandwidth=1.0), "fourier5"))
    runs = fourier_runs(evaluator, 5)
    first = [next(runs) for _ in range(7)]
    assert [s.name for s in first[:5]] == ["0.2 Hz", "0.1 Hz", "0.4 Hz", "0.8 Hz", "0.15 Hz"]
    t = evaluator.task.t
    for s, frequency, harmonics in zip(
        first, (0.2, 0.1, 0.4, 0.8, 0.15), (5, 5, 2, 1, 5), strict=False
    ):
        waves = fourier_basis(t, 2.0, frequency, harmonics, False, False)
        left = waves - s.basis @ np.linalg.lstsq(s.basis, waves)[0]
        assert np.abs(left).max() < 1e-3
    assert "at random" in first[5].name
    assert all(
        s.basis.shape[1] <= 7 for s in (next(spline_runs(evaluator)) for _ in range(2))
    )  # 1 Hz: four pieces


def test_slopes_for_scipy_are_the_derivatives() -> None:
    evaluator = evaluator_of(order(pendulum(), "fourier5"))
    run = next(run for run in fourier_runs(evaluator, 3) if run.name.startswith("0.8"))
    descent = ScipyDescent(evaluator=evaluator, run=run, base=evaluator.exact, limit=1.0)
    s = descent.coefficients(run.control) * 0.7
    problem = InteriorProblem(
        base=evaluator.exact, constraints=evaluator.constraints, mu=0.1, delta=0.03
    )

    def value(s: Array) -> float:
        return problem.value(problem.point(descent.control(s)))

    slope = descent.slope(problem, problem.point(descent.control(s)))
    assert slope is not None
    for i in range(s.size):
        move = np.zeros(s.size)
        move[i] = 1e-4
        forward, backward = (value(s + sign * move.reshape(s.shape)) for sign in (1.0, -1.0))
        assert (forward - backward) / 2e-4 == pytest.approx(
            slope[i], rel=5e-3, abs=2e-3 * np.abs(slope).max()
        )


@pytest.mark.slow
def test_many_runs_end_with_the_budget_and_the_best_one_reaches_the_smallest_barrier_weight() -> (
    None
):
    evaluator = evaluator_of(order(pendulum(), "fourier5", steps=200_000))
    seen: list[tuple[str, float]] = []

    def optimise(
        evaluator: ControlEvaluator, run: ParametricRun, last: float, limit: float
    ) -> None:
        seen.append((run.name, last))
        optimise_with_scipy(evaluator, run, last, limit)

    optimise_many(evaluator, fourier_runs(evaluator, 5), 5, optimise)
    assert [name for name, _ in seen[:2]] == [
        "0.2 Hz",
        "0.1 Hz",
    ]  # the budget does not bear all five
    assert seen[-1][1] < seen[0][1]
    assert 1.0 <= evaluator.used < 1.2
    assert evaluator.best.found_by in {name for name, _ in seen}


def test_the_best_control_of_a_search_never_becomes_worse() -> None:
    costs: list[float] = []
    evaluator = ControlEvaluator(
        search=order(pendulum(), "steps", steps=20_000),
        callback=lambda used, best: costs.append(best.cost),
    )
    random_search(evaluator, RandomSteps)
    assert len(costs) > 3
    assert all(b <= a for a, b in pairwise(costs))
