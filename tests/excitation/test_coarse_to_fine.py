"""Designs under hard limits from coarse to fine levels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.excitation.coarse_to_fine import CoarseToFine
from mjfim.excitation.coarser_levels import coarser_levels
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.design import design_task
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.design import HistoryRow, Status
from tests.support.paths import MODELS

LIMITS = Experiment.from_file(MODELS / "cart_pendulum_limits.toml")


@pytest.fixture(scope="module")
def fine() -> DescentLevel:
    """The stated level of the cart-pendulum under hard limits, with five starts."""
    return level_of(starts=5, max_iterations=8)


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
    rows: list[HistoryRow] = []
    search = search_of(fine, Budget())
    results = consume(search.run(starts), lambda event: rows.append(event.row))

    # All starts are optimised on the coarsest level, one of them on all levels.
    assert [result.name for result in results] == [start.name for start in starts]
    rates = [{row.rate for row in result.history} for result in results]
    assert sorted(map(len, rates)) == [1, 1, 1, 1, 3]
    assert [row.iteration for row in rows] == sorted(row.iteration for row in rows) or len(
        rates
    ) > 1
    assert max(row.mu for row in rows if row.rate == 100.0) < 0.01

    cost = LimitedCost(level=fine)
    for result in results:
        assert result.control is not None and result.control.shape == fine.task.control.shape
        assert cost(result.control) == pytest.approx(result.cost, rel=1e-4)
    refined = results[int(np.argmax([len(each) for each in rates]))]
    assert refined.cost == min(result.cost for result in results)


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


def test_a_better_control_of_an_earlier_round_remains(fine: DescentLevel) -> None:
    search = search_of(fine, Budget())
    control = 0.5 * fine.task.control
    before = RunResult(name="a", control=control, cost=1.0)
    worse = RunResult(name="a", control=2.0 * control, cost=2.0, status=Status.CONVERGED)
    kept = search._merged(before, worse, fine)
    assert kept.control is control and kept.cost == 1.0 and kept.status is Status.BEST_SEEN
    lost = replace(worse, cost=np.inf, status=Status.INFEASIBLE)
    assert search._merged(before, lost, fine).status is Status.MAX_ITERATIONS
    better = search._merged(before, replace(worse, cost=0.5), fine)
    assert better.cost == 0.5 and better.earlier[-1] is control


def test_a_misleading_level_does_not_lose_the_start(fine: DescentLevel) -> None:
    start = next(iter(initial_controls_of(fine.task, None)))
    search = search_of(fine, Budget())
    useless = replace(start, control=np.tile(fine.task.centre, (fine.task.samples, 1)))
    assert search._is_misled(useless, 1e-3) and not search._is_misled(start, np.inf)
    assert search._better(useless, start).control is start.control


@pytest.mark.slow
def test_the_cart_pendulum_gets_near_its_best_optimum_with_few_engine_steps() -> None:
    # One level took 2 million steps from each start.
    task = DesignTask.resolve(LIMITS.replace(descent={"starts": 2}), threads=1)
    design = design_task(task)
    assert design.final.eigenvalues[0] > 402.0
    assert min(design.limits.values()) >= 0.0
    assert design.steps < 2_000_000
