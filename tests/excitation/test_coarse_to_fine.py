"""Designs under hard limits from coarse to fine levels."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.excitation.coarse_comparison import (
    CoarseComparison,
    point_without_limits,
    without_jumps,
)
from mjfim.excitation.coarse_to_fine import CoarseToFine
from mjfim.excitation.coarser_levels import coarser_levels
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.design import design_task
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel, has_similar_cost
from mjfim.excitation.limited_searches import LimitedSearches, SearchTerms
from mjfim.excitation.objective import DIVERGED
from mjfim.excitation.rounds import Entry
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.running_rounds import EndedSearch, RunningRounds
from mjfim.excitation.task import DesignTask
from mjfim.excitation.tightened_runs import run_within_tighter_limits
from mjfim.excitation.winner_repair import ViolatingWinner, WinnerRepair
from mjfim.experiment.schema import Experiment
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent
from tests.support.made_records import make_row
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
    starts = list(initial_controls_of(fine.task, None))
    searches = LimitedSearches(stated=fine, executor=None, budget=budget)
    return CoarseToFine(searches=searches, starts=starts, levels=coarser_levels(fine)[:2])


@pytest.fixture(scope="module")
def cost(fine: DescentLevel) -> LimitedCost:
    """Cost of controls that keep all limits."""
    return LimitedCost(level=fine)


@pytest.fixture(scope="module")
def comparison(search: CoarseToFine) -> CoarseComparison:
    """Comparison of the results of the coarsest level."""
    return search.comparison(search.levels[0])


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
    results = consume(search.run(), events.append)
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
    (result,) = consume(search_of(fine, Budget()).run(), None)
    assert [row.rate for row in result.history] == [12.5, 12.5, 100.0, 100.0]


@pytest.mark.slow
def test_a_short_time_is_for_few_starts_and_for_coarse_levels(fine: DescentLevel) -> None:
    assert len(search_of(fine, Budget()).affordable()) == 5
    assert len(search_of(fine, Budget(seconds=1e-3)).affordable()) == 1

    # The stated level is left out where its iterations would take too long.
    results = consume(search_of(fine, Budget(seconds=1e-3)).run(), None)
    assert [result.name for result in results] == ["initial control"]
    assert {row.rate for row in results[0].history} == {12.5}
    assert np.isfinite(results[0].cost)


def test_a_better_control_of_an_earlier_round_remains(search: CoarseToFine) -> None:
    control = 0.5 * search.searches.stated.task.control
    before = RunResult(name="a", control=control, cost=1.0)
    worse = RunResult(name="a", control=2.0 * control, cost=2.0, status=Status.CONVERGED)
    kept = search.merged(before, worse)
    assert kept.control is control and kept.cost == 1.0 and kept.status is Status.BEST_SEEN
    lost = replace(worse, cost=np.inf, status=Status.INFEASIBLE)
    assert search.merged(before, lost).status is Status.MAX_ITERATIONS
    better = search.merged(before, replace(worse, cost=0.5))
    assert better.cost == 0.5 and better.earlier[-1] is control

    # The control outside the limits is kept too, for a last attempt to shrink it.
    outside = replace(before, cost=np.inf)
    assert search.merged(outside, replace(lost, control=None)).control is control


def test_the_result_of_a_coarse_level_is_neither_converged_nor_infeasible(
    comparison: CoarseComparison, cost: LimitedCost
) -> None:
    control = 0.1 * cost.level.task.control
    found = RunResult(name="a", control=control, status=Status.INFEASIBLE)
    inside = comparison.on_stated_plant(cost, found, is_tried=True)
    assert np.isfinite(inside.cost) and inside.status is Status.MAX_ITERATIONS

    useless = RunResult(name="a", status=Status.CONVERGED)
    assert comparison.on_stated_plant(cost, useless, is_tried=True).status is Status.INFEASIBLE
    late = comparison.on_stated_plant(cost, replace(found, cost=1.0), is_tried=False)
    assert late.control is found.control and np.isinf(late.cost)


def test_a_misleading_level_does_not_lose_the_start(
    search: CoarseToFine, comparison: CoarseComparison, cost: LimitedCost
) -> None:
    task, start = cost.level.task, search.starts[0]
    misled = RunResult(name=start.name, control=np.tile(task.centre, (task.samples, 1)), cost=1e-3)
    found = comparison.candidate(cost, misled, start)
    assert found.following is not None and found.following.control is start.control
    assert not found.is_new and found.cost > 1e-3

    # The barrier weight remains where the next round begins with the control before, also after a
    # round without any usable control.
    useless = comparison.candidate(cost, RunResult(name=start.name), start)
    for judgement in (found, useless):
        rounds = RunningRounds(replace(search, starts=[start]), [start])
        entry = rounds.next_entry()
        assert entry is not None
        ended = EndedSearch(entry=entry, result=misled, seconds=1.0)
        rounds.settle(ended, judgement)
        following = rounds.next_entry()
        assert following is not None and following.start.control is start.control
        assert (following.round, following.mu) == (1, BarrierSchedule().first)


def test_a_misleading_cost_does_not_win(
    search: CoarseToFine, comparison: CoarseComparison, cost: LimitedCost
) -> None:
    task, start = cost.level.task, search.starts[0]
    centre = np.tile(task.centre, (task.samples, 1))
    useless = replace(start, name="b", control=centre)
    stated = point_without_limits(cost.level, start.control)
    assert stated is not None

    rounds = RunningRounds(search, [useless, start])
    for start_cost in (0.5 * stated.cost, stated.cost):
        entry = rounds.next_entry()
        assert entry is not None
        result = RunResult(name=entry.start.name, control=entry.start.control, cost=start_cost)
        judgement = comparison.candidate(cost, result, entry.start)
        rounds.settle(EndedSearch(entry=entry, result=result, seconds=1.0), judgement)
    following = rounds.next_entry()
    assert following is not None and rounds.next_entry() is None
    assert (following.start.name, following.mu) == (start.name, 0.03)


def test_no_coarse_level_begins_after_the_end_of_the_time(fine: DescentLevel) -> None:
    search = search_of(fine, Budget(seconds=0.0))
    start = search.starts[0]
    coarse, stated = (Entry(number=0, index=0, round=r, start=start) for r in (1, 2))
    assert not search.may_begin(coarse, has_feasible=False)
    assert search.may_begin(stated, has_feasible=False)


@pytest.mark.parametrize(
    ("begun", "iterations", "weights"),
    [
        (1e-3, 11.0, (1e-3, 1e-5, 5)),
        (1e-3, 9.0, (3e-4, 1e-4, 2)),
        (0.1, 9.0, (0.1, 1e-4, 7)),
    ],
)
def test_few_iterations_are_not_spent_on_many_stages(
    begun: float, iterations: float, weights: tuple[float, float, int], search: CoarseToFine
) -> None:
    """Two stages let both of them step; a control that was not optimised yet needs more."""
    start = search.starts[0]
    entry = Entry(number=0, index=0, round=2, start=start, mu=begun, done=5, seconds_per_step=1e-3)
    seconds = iterations * 1e-3 * search.searches.stated.task.samples
    found = search.terms(entry, seconds).schedule.barrier_weights()
    assert (found[0], found[-1], len(found)) == pytest.approx(weights)

    # Without a limit of time, all stages have time for steps.
    assert search.terms(entry, np.inf).schedule.barrier_weights()[-1] == pytest.approx(1e-5)


@pytest.mark.parametrize(("reached", "last"), [(3e-5, 1e-5), (1e-4, 1e-4)])
def test_runs_within_tighter_limits_are_as_sharp_as_the_result_before(
    reached: float, last: float, search: CoarseToFine, monkeypatch: pytest.MonkeyPatch
) -> None:
    control = search.searches.stated.task.control
    row = make_row(iteration=7, slope=0.1, seconds=1.0, steps=100, mu=reached)
    result = RunResult(name="a", control=control, cost=1.0, history=(row,))

    def first_one(*args: object) -> ViolatingWinner:
        """The first result violates a limit."""
        return ViolatingWinner(index=0, margins={"position": -0.1})

    asked: list[SearchTerms] = []

    def run(*args: Any) -> Generator[DesignEvent, None, None]:
        """Keep the terms; the search finds nothing."""
        asked.append(args[-1])
        yield from ()

    monkeypatch.setattr(WinnerRepair, "violating", first_one)
    monkeypatch.setattr(LimitedSearches, "run", run)
    consume(
        run_within_tighter_limits(search.searches, search.repair, [result], search.sharpest), None
    )
    schedule = asked[0].schedule
    assert (schedule.first, schedule.last) == (1e-3, last)
    assert schedule.follows_curvature is (last < 1e-4)


def test_only_staircases_are_smoothed() -> None:
    limited = LIMITS.replace(limits={"control_rate": 5.0})
    fine = DescentLevel(DesignTask.resolve(limited, threads=1).relaxed(), None)
    cost = LimitedCost(level=fine)
    assert cost.constraints.rate is not None

    curve = np.sin(np.arange(fine.task.samples) / 9.0)[:, None]
    assert without_jumps(cost, curve, 8) is curve
    stairs = np.repeat(curve[::8], 8, axis=0)
    smooth = without_jumps(cost, stairs, 8)
    assert np.abs(np.diff(smooth, axis=0)).max() < 0.3 * np.abs(np.diff(stairs, axis=0)).max()


def test_no_level_resembles_one_on_which_the_initial_control_diverges(fine: DescentLevel) -> None:
    assert not has_similar_cost(fine, DIVERGED, np.inf, 0.5)


@pytest.mark.slow
def test_the_cart_pendulum_gets_near_its_best_optimum_with_few_engine_steps() -> None:
    # One level took 2 million steps from each start, and several levels with steps that ended at
    # the bounds of the control came to 403.26 in 1.1 million. The best known value is 403.4.
    task = DesignTask.resolve(LIMITS.replace(descent={"starts": 5}), threads=1)
    design = design_task(task)
    assert design.final.eigenvalues[0] > 403.3
    assert min(design.limits.values()) >= 0.0
    assert design.steps < 1_000_000
