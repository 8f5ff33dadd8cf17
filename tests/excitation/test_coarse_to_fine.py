"""Designs under hard limits from coarse to fine levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.excitation.coarse_to_fine import CoarseToFine, _State
from mjfim.excitation.coarser_levels import coarser_levels
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.design import design_task
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel, has_similar_cost
from mjfim.excitation.objective import DIVERGED
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent
from tests.support.paths import MODELS

LIMITS = Experiment.from_file(MODELS / "cart_pendulum_limits.toml")


@pytest.fixture(scope="module")
def fine() -> DescentLevel:
    """The stated level of the cart-pendulum under hard limits, with five starts."""
    return level_of(starts=5, max_iterations=8)


@pytest.fixture(scope="module")
def search(fine: DescentLevel) -> CoarseToFine:
    """A search without a limit of time."""
    return search_of(fine, Budget())


def level_of(**descent: object) -> DescentLevel:
    """The stated level of the cart-pendulum under hard limits, without clamps."""
    task = DesignTask.resolve(LIMITS.replace(descent=descent), threads=1)
    return DescentLevel(task.relaxed(), None)


def search_of(fine: DescentLevel, budget: Budget) -> CoarseToFine:
    """A search on two coarse levels and the stated one."""
    coarse = coarser_levels(fine)[:2]
    return CoarseToFine(fine=fine, coarse=None, levels=coarse, budget=budget)


def factors_of(fine: DescentLevel) -> list[int]:
    """Factors of the samples of the coarser levels."""
    return [level.task.system.variant.sample_factor for level in coarser_levels(fine)]


@pytest.mark.slow
def test_levels_divide_the_samples_and_cost_nearly_the_same(fine: DescentLevel) -> None:
    assert factors_of(fine) == [8, 4, 2]
    assert factors_of(replace(fine, task=fine.task.with_horizon(3.0))) == [4, 2]
    assert factors_of(replace(fine, task=fine.task.with_horizon(0.9))) == []
    assert factors_of(level_of(coarse=1)) == factors_of(level_of(coarse=2)) == []

    # With several engine steps in a sample, the timestep can be longer instead.
    arm = DesignTask.resolve(Experiment.from_file(MODELS / "quadrotor.toml"), threads=1)
    assert factors_of(DescentLevel(arm.relaxed(), None)) == []


@pytest.mark.slow
def test_every_round_leaves_controls_that_keep_all_limits(fine: DescentLevel) -> None:
    starts = list(initial_controls_of(fine.task, None))
    events: list[DesignEvent] = []
    search = search_of(fine, Budget())
    tasks = [level.task for level in (*search.levels, fine)]
    assert all(len(task.centres) for task in tasks)
    steps_before = sum(task.plant.engine_steps for task in tasks)
    results = consume(search.run(starts), events.append)
    taken = sum(task.plant.engine_steps for task in tasks) - steps_before
    assert sum(result.steps for result in results) == taken
    rows = [event.row for event in events]

    # All starts are optimised on the coarsest level, one of them on all levels.
    assert [result.name for result in results] == [start.name for start in starts]
    rates = [{row.rate for row in result.history} for result in results]
    assert sorted(map(len, rates)) == [1, 1, 1, 1, 3]
    for start in starts:
        numbers = [event.row.iteration for event in events if event.start == start.name]
        assert numbers == sorted(numbers)
    assert max(row.mu for row in rows if row.rate == 100.0) < 0.01

    cost = LimitedCost(level=fine)
    for result in results:
        assert result.control is not None and result.control.shape == fine.task.control.shape
        assert cost(result.control) == pytest.approx(result.cost, rel=1e-4)
    refined = results[int(np.argmax([len(each) for each in rates]))]
    assert refined.cost == min(result.cost for result in results)
    others = [result.status for result in results if result is not refined]
    assert others == 4 * [Status.LEFT] and refined.status is not Status.LEFT


@pytest.mark.slow
def test_a_single_iteration_is_not_spent_on_every_level() -> None:
    fine = level_of(starts=1, max_iterations=1)
    starts = list(initial_controls_of(fine.task, None))
    (result,) = consume(search_of(fine, Budget()).run(starts), None)
    assert [row.rate for row in result.history] == [12.5, 12.5, 100.0, 100.0]


@pytest.mark.slow
def test_a_short_time_is_for_few_starts_and_for_coarse_levels(fine: DescentLevel) -> None:
    starts = list(initial_controls_of(fine.task, None))
    assert len(search_of(fine, Budget())._affordable(starts)) == 5
    assert len(search_of(fine, Budget(seconds=1e-3))._affordable(starts)) == 1

    # The stated level is left out where its iterations would take too long.
    results = consume(search_of(fine, Budget(seconds=1e-3)).run(starts), None)
    assert [result.name for result in results] == ["initial control"]
    assert {row.rate for row in results[0].history} == {12.5}
    assert np.isfinite(results[0].cost)


def test_a_better_control_of_an_earlier_round_remains(search: CoarseToFine) -> None:
    control = 0.5 * search.fine.task.control
    before = RunResult(name="a", control=control, cost=1.0)
    worse = RunResult(name="a", control=2.0 * control, cost=2.0, status=Status.CONVERGED)
    kept = search._merged(before, worse)
    assert kept.control is control and kept.cost == 1.0 and kept.status is Status.BEST_SEEN
    lost = replace(worse, cost=np.inf, status=Status.INFEASIBLE)
    assert search._merged(before, lost).status is Status.MAX_ITERATIONS
    better = search._merged(before, replace(worse, cost=0.5))
    assert better.cost == 0.5 and better.earlier[-1] is control

    # The control outside the limits is kept too, for a last attempt to shrink it.
    outside = replace(before, cost=np.inf)
    assert search._merged(outside, replace(lost, control=None)).control is control


def test_the_result_of_a_coarse_level_is_neither_converged_nor_infeasible(
    search: CoarseToFine,
) -> None:
    coarse = search.levels[0]
    found = RunResult(name="a", control=0.1 * search.fine.task.control, status=Status.INFEASIBLE)
    inside = search._on_stated_plant(found, coarse, is_tried=True)
    assert np.isfinite(inside.cost) and inside.status is Status.MAX_ITERATIONS

    useless = RunResult(name="a", status=Status.CONVERGED)
    assert search._on_stated_plant(useless, coarse, is_tried=True).status is Status.INFEASIBLE
    late = search._on_stated_plant(replace(found, cost=1.0), coarse, is_tried=False)
    assert late.control is found.control and np.isinf(late.cost)


def test_a_misleading_level_does_not_lose_the_start(search: CoarseToFine) -> None:
    task, level = search.fine.task, search.levels[0]
    start = next(iter(initial_controls_of(task, None)))
    misled = RunResult(name=start.name, control=np.tile(task.centre, (task.samples, 1)), cost=1e-3)
    candidate = search._candidate(misled, start, level)
    assert candidate.start.control is start.control and not candidate.is_new
    assert candidate.cost > 1e-3

    # The barrier weight remains where the next round begins with the control before.
    state = _State(starts=[start])
    search._choose_starts([misled], level, state, 0.03)
    assert [each.control is start.control for each in state.starts] == [True]
    assert state.mu == BarrierSchedule().first

    # Neither is a round without any control useful.
    search._choose_starts([RunResult(name=start.name)], level, state, 0.03)
    assert len(state.starts) == 1 and state.mu == BarrierSchedule().first


def test_a_misleading_cost_does_not_win(search: CoarseToFine) -> None:
    task, level = search.fine.task, search.levels[0]
    start = next(iter(initial_controls_of(task, None)))
    useless = replace(start, name="b", control=np.tile(task.centre, (task.samples, 1)))
    stated = search._point_without_limits(start.control)
    assert stated is not None
    found = [
        RunResult(name="b", control=useless.control, cost=0.5 * stated.cost),
        RunResult(name=start.name, control=start.control, cost=stated.cost),
    ]
    state = _State(starts=[useless, start])
    search._choose_starts(found, level, state, 0.03)
    assert [each.name for each in state.starts] == [start.name] and state.mu == 0.03


def test_no_coarse_level_begins_after_the_end_of_the_time(fine: DescentLevel) -> None:
    search = CoarseToFine(fine=fine, coarse=None, levels=(fine,), budget=Budget(seconds=0.0))
    state = _State(starts=[], results={"a": RunResult(name="a")})
    assert search._is_over(replace(fine), state) and not search._is_over(fine, state)


def test_only_staircases_are_smoothed(search: CoarseToFine) -> None:
    coarse = search.levels[0]
    limited = LIMITS.replace(limits={"control_rate": 5.0})
    fine = DescentLevel(DesignTask.resolve(limited, threads=1).relaxed(), None)
    search = replace(search, fine=fine)
    assert search._limited_cost.constraints.rate is not None

    curve = np.sin(np.arange(fine.task.samples) / 9.0)[:, None]
    assert search._without_jumps(curve, coarse) is curve
    stairs = np.repeat(curve[::8], 8, axis=0)
    smooth = search._without_jumps(stairs, coarse)
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.3 * np.abs(np.diff(stairs, axis=0)).max()


def test_no_level_resembles_one_on_which_the_initial_control_diverges(fine: DescentLevel) -> None:
    assert not has_similar_cost(fine, DIVERGED, np.inf, 0.5)


@pytest.mark.slow
def test_the_cart_pendulum_gets_near_its_best_optimum_with_few_engine_steps() -> None:
    # One level took 2 million steps from each start.
    task = DesignTask.resolve(LIMITS.replace(descent={"starts": 2}), threads=1)
    design = design_task(task)
    assert design.final.eigenvalues[0] > 402.0
    assert min(design.limits.values()) >= 0.0
    assert design.steps < 2_000_000
