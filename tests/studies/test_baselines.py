"""Baselines: their shapes, their budgets, the limits they keep by an independent simulation, their gradients."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.excitation.interior_point import InteriorProblem
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.signals import (
    Chirp,
    ExcitationSettings,
    Multisine,
    RandomSteps,
    fourier_basis,
    schroeder_phases,
)
from mjfim.studies.baselines.budget import Arena, Attempt, Job, Spent
from mjfim.studies.baselines.methods import METHODS, Shaper, perform, reflected, search
from mjfim.studies.baselines.parametric import (
    Descent,
    Series,
    fourier,
    scipy_own,
    splines,
    tournament,
)
from mjfim.studies.compare import _tried
from tests.support.baselines import pendulum, played
from tests.support.paths import MODELS

STEPS = 120_000

# One method of each kind that runs without `-m slow`: a sweep, random steps, a series, a series refined by mjfim.
FAST_METHODS = ("chirp", "steps", "fourier5", "fourier5-mjfim")

FRAME = ExcitationSettings(
    t=np.arange(500) * 0.01, horizon=5.0, nu=2, min_frequency=0.1, max_frequency=5.0, may_jump=True
)


def arm(**limits: Any) -> Experiment:
    """A second of the servo arm, from rest to rest, its references slow."""
    return Experiment.from_file(MODELS / "servo_arm.toml").replace(
        horizon=1.0,
        cost={"control": 0.0},
        limits={"velocity": 3.0, "control_rate": 4.0, **limits},
        boundary={"start": "rest", "end": "rest", "position": 0.02, "velocity": 0.05},
    )


@cache
def found(method: str) -> Attempt:
    """What a method finds on the cart-pendulum with a small budget of steps."""
    return perform(Job(pendulum(), method, 60.0, STEPS, seed=1))


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
def test_waves_are_of_size_one_whatever_the_numbers(kind: Any) -> None:
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
def test_every_baseline_keeps_the_limits_and_its_budget(method: str) -> None:
    attempt = found(method)
    assert attempt.control is not None
    assert np.isfinite(attempt.cost)
    qpos, _, ctrl = played(pendulum(), attempt.control)
    assert np.abs(qpos[:, 0]).max() <= 0.5
    assert np.abs(ctrl).max() <= 5.0
    assert 0.5 * STEPS < attempt.steps < 1.2 * STEPS
    task = DesignTask.resolve(pendulum())
    point = task.problem.point(task.plant.simulate(task.theta, attempt.control))
    assert point.cost == pytest.approx(attempt.cost, rel=1e-3)
    assert (
        point.cost < 0.5 * task.problem.point(task.initial).cost
    )  # of a start that even leaves the limits


def test_amplitudes_go_up_to_the_limits() -> None:
    for method in ("chirp", "multisine", "steps"):
        control = found(method).control
        assert control is not None
        qpos, _, ctrl = played(pendulum(), control)
        assert max(np.abs(qpos[:, 0]).max() / 0.5, np.abs(ctrl).max() / 5.0) > 0.9


def test_seconds_end_a_search() -> None:
    attempt = perform(Job(pendulum(), "steps", 0.4))
    assert attempt.seconds < 2.0
    assert attempt.control is not None


def test_a_budget_of_steps_makes_it_repeatable() -> None:
    first, again, other = (
        perform(Job(pendulum(), "chirp", 60.0, 30_000, seed=s)) for s in (4, 4, 5)
    )
    assert first.control is not None
    assert other.control is not None
    np.testing.assert_array_equal(first.control, again.control)
    assert not np.array_equal(first.control, other.control)


def test_workers_share_the_steps() -> None:
    with ThreadPoolExecutor(2) as executor:
        attempt = _tried(Job(pendulum(), "steps", 60.0, 40_000), executor, lambda used, cost: None)
    assert attempt.control is not None
    assert attempt.steps < 1.2 * 40_000 + 2 * 8_000


@pytest.mark.parametrize(
    "method",
    ["steps", *(pytest.param(name, marks=pytest.mark.slow) for name in ("chirp", "fourier5"))],
)
def test_from_rest_to_rest_without_jolts(method: str) -> None:
    experiment = arm(bandwidth=6.0)
    task = DesignTask.resolve(experiment)
    attempt = perform(Job(experiment, method, 60.0, 400_000))
    assert attempt.control is not None
    assert np.isfinite(attempt.cost)
    padded = np.concatenate([task.initial_hold[None], attempt.control, task.initial_hold[None]])
    assert np.abs(np.diff(padded, axis=0)).max() <= 4.0 / 100.0 + 1e-12
    qpos, qvel, _ = played(experiment, attempt.control)
    assert np.abs(qvel).max() <= 3.0
    assert np.abs(qpos[-1] - qpos[0]).max() <= 0.02
    assert np.abs(qvel[-1]).max() <= 0.05
    spectrum = np.abs(np.fft.rfft(attempt.control - task.initial_hold, axis=0, n=1000)) ** 2
    assert spectrum[np.fft.rfftfreq(1000, 0.01) > 15.0].sum() < 1e-2 * spectrum.sum()


def test_what_no_control_keeps_is_told_by_its_margin() -> None:
    """A pendulum that is let go does not come back to where it was, whatever a chirp does."""
    swinging = pendulum(
        initial={"keyframe": None, "qpos": (0.0, 1.0), "qvel": (0.0, 0.0)},
        boundary={"end": "periodic", "position": 1e-5, "velocity": 1e-5},
    )
    attempt = perform(Job(swinging, "chirp", 60.0, 40_000))
    assert attempt.cost == np.inf
    assert attempt.share < 0.0
    assert attempt.control is not None


@pytest.mark.slow
def test_weights_are_part_of_the_cost() -> None:
    """Without limits the same J is lowered, effort included: as large as possible is not the best."""
    soft = Experiment.from_file(MODELS / "cart_pendulum.toml").replace(horizon=2.0)
    task = DesignTask.resolve(soft)
    assert not task.is_limited
    for method in ("multisine", "fourier5"):
        attempt = perform(Job(soft, method, 60.0, STEPS))
        assert attempt.control is not None
        point = task.problem.point(task.plant.simulate(task.theta, attempt.control))
        assert point.cost == pytest.approx(attempt.cost, rel=1e-3)
        assert point.criterion is not None
        assert point.cost < task.problem.point(task.initial).cost
        assert 0.1 < point.criterion.value / point.cost < 0.99  # both terms count
    assert Shaper(Arena(Job(soft, "chirp", 1.0))).weighted


# ---- series


def test_the_usual_frequencies_come_first_and_stay_within_the_bandwidth() -> None:
    arena = Arena(Job(pendulum(bandwidth=1.0), "fourier5", 60.0))
    series = fourier(arena, 5)
    first = [next(series) for _ in range(7)]
    assert [s.name for s in first[:5]] == ["0.2 Hz", "0.1 Hz", "0.4 Hz", "0.8 Hz", "0.15 Hz"]
    t = arena.task.t
    for s, frequency, harmonics in zip(
        first, (0.2, 0.1, 0.4, 0.8, 0.15), (5, 5, 2, 1, 5), strict=False
    ):
        waves = fourier_basis(t, 2.0, frequency, harmonics, False, False)
        left = waves - s.basis @ np.linalg.lstsq(s.basis, waves)[0]
        assert np.abs(left).max() < 1e-3
    assert "at random" in first[5].name
    assert all(
        s.basis.shape[1] <= 7 for s in (next(splines(arena)) for _ in range(2))
    )  # 1 Hz: four pieces


def test_slopes_for_scipy_are_the_derivatives() -> None:
    arena = Arena(Job(pendulum(), "fourier5", 60.0))
    series = next(s for s in fourier(arena, 3) if s.name.startswith("0.8"))
    descent = Descent(arena, series, arena.exact, 1.0)
    s = descent._coefficients(series.control) * 0.7
    problem = InteriorProblem(arena.exact, arena.constraints, 0.1, 0.03)
    _, slope = descent._valued(problem, s)
    for i in range(s.size):
        move = np.zeros(s.size)
        move[i] = 1e-4
        sides = [
            descent._valued(problem, s + sign * move.reshape(s.shape))[0] for sign in (1.0, -1.0)
        ]
        assert (sides[0] - sides[1]) / 2e-4 == pytest.approx(
            slope[i], rel=5e-3, abs=2e-3 * np.abs(slope).max()
        )


def test_a_tournament_ends_with_its_budget_and_sharpens_the_best() -> None:
    arena = Arena(Job(pendulum(), "fourier5", 60.0, 200_000))
    seen: list[tuple[str, float]] = []

    def optimise(arena: Arena, series: Series, last: float, limit: float) -> None:
        seen.append((series.name, last))
        scipy_own(arena, series, last, limit)

    with pytest.raises(Spent):
        tournament(arena, fourier(arena, 5), 5, optimise)
    assert [name for name, _ in seen[:2]] == [
        "0.2 Hz",
        "0.1 Hz",
    ]  # the budget does not bear all five
    assert seen[-1][1] < seen[0][1]
    assert 1.0 <= arena.used < 1.2
    assert arena.attempt.found_by in {name for name, _ in seen}


def test_the_best_of_a_search_only_gets_better() -> None:
    costs: list[float] = []
    arena = Arena(
        Job(pendulum(), "steps", 60.0, 60_000), lambda used, attempt: costs.append(attempt.cost)
    )
    with pytest.raises(Spent):
        search(arena, RandomSteps)
    assert len(costs) > 3
    assert all(b <= a for a, b in pairwise(costs))
