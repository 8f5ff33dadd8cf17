"""Random changes of controls where a descent is held up by contacts or dry friction."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjfim.budget import Budget
from mjfim.excitation import random_search
from mjfim.excitation.controls_within_limits import ControlsWithinLimits, LimitedCost
from mjfim.excitation.design import design_task
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_search import LimitedSearch
from mjfim.excitation.random_search import RandomSearch
from mjfim.excitation.run_result import RunResult, Runs, consume
from mjfim.excitation.short_steps import ShortSteps
from mjfim.excitation.task import DesignTask
from mjfim.records.events import DesignEvent
from tests.support.stiff_servos import dry_arm_experiment, stiff_arm_task


@pytest.mark.parametrize(
    ("steps", "held_up"),
    [
        ([1.0, 0.3, 1.0, 0.1, 0.1, 0.1, 0.1, 0.1, 1.0], False),
        ([0.01, 0.01, 1.0, 0.01, 1.0], False),
        ([1.0, 1e-9, 1.0, 0.0, 1.0], False),
        ([1.0, 0.01, 0.01, 0.01, 0.0099], True),
        ([1e-7, 1e-7], True),
        ([1.0, 1e-6, 0.0], True),
        ([*5 * [0.04, 1.0], 0.04], True),
    ],
)
def test_a_descent_of_short_steps_is_held_up(steps: list[float], held_up: bool) -> None:
    observed = ShortSteps(tolerance=1e-5)
    assert not observed.hold_up(0.0, 0.1, 0.1), "the first iterate was not reached by a step"
    found = [observed.hold_up(gamma, 0.1, slope=0.1) for gamma in steps]
    assert found[-1] is held_up
    assert not any(found[:-1])


@pytest.mark.parametrize(("slope", "held_up"), [(9e-4, False), (1.1e-3, True)])
def test_short_steps_near_an_optimum_do_not_count(slope: float, held_up: bool) -> None:
    """The sixth short step in twelve may be the last one before a descent converges."""
    observed = ShortSteps(tolerance=1e-5)
    observed.hold_up(0.0, 0.1, 0.1)
    for gamma in 5 * [0.04, 1.0]:
        assert not observed.hold_up(gamma, 0.1, slope=0.1)
    assert observed.hold_up(0.04, 0.1, slope) is held_up


def test_the_first_iterate_of_a_stage_is_no_step() -> None:
    observed = ShortSteps(tolerance=1e-5)
    stages = (0.1, 0.03, 0.01, 0.003)
    assert not any(observed.hold_up(gamma, mu, slope=0.1) for mu in stages for gamma in (0.0, 1.0))


def search_of(task: DesignTask) -> tuple[RandomSearch, ControlsWithinLimits]:
    """A random search for a task, and its trials."""
    cost = LimitedCost(level=DescentLevel(task.relaxed(), None))
    search = RandomSearch(cost, "initial control", Budget(), seed=0)
    return search, ControlsWithinLimits(cost=cost, budget=Budget())


@pytest.fixture(name="few")
def few_controls(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that tries the enlarged start and a single random control."""
    monkeypatch.setattr(random_search, "FIRST_BANDWIDTHS", (0.6,))
    monkeypatch.setattr(random_search, "CONTROLS_PER_BANDWIDTH", 1)


@pytest.mark.usefixtures("few")
def test_random_controls_keep_all_limits_and_are_the_same_every_time(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path, 0.0005, horizon=0.4)
    costs = []
    for _ in range(2):
        search, trials = search_of(task)
        centre = task.relaxed().centre
        start = trials.inside(centre, task.control - centre, 1.0)
        assert start is not None
        best, rows = consume(search.run(start, Budget(), patience=0), None)
        assert search.cost(best.control) == best.cost
        assert [row.cost for row in rows] == sorted((row.cost for row in rows), reverse=True)
        costs.append([start.cost, *(row.cost for row in rows)])

    assert costs[0] == costs[1]
    assert costs[0][-1] < 0.1 * costs[0][0]


@pytest.mark.usefixtures("few")
def test_a_motion_that_amplifies_disturbances_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = stiff_arm_task(tmp_path, 0.0005, horizon=0.4)
    search, trials = search_of(task)
    centre = task.relaxed().centre
    start = trials.inside(centre, task.control - centre, 1.0)
    assert start is not None

    monkeypatch.setattr(random_search, "UNSTABLE_GROWTH", 0.0)
    monkeypatch.setattr(RandomSearch, "largest_growth", 0.5)
    best, rows = consume(search.run(start, Budget(), patience=0), None)
    assert best is start
    assert not rows


@pytest.mark.slow
def test_a_design_with_dry_friction_is_far_better_than_its_start(tmp_path: Path) -> None:
    """The descent alone is held up at 180 times the information of the start."""
    design = design_task(DesignTask.resolve(dry_arm_experiment(tmp_path), threads=1))
    assert not design.initial_violations
    assert design.within_limits
    assert design.final.eigenvalues[0] > 500.0 * design.initial.eigenvalues[0]


def test_a_descent_that_did_not_begin_leaves_the_result_of_the_random_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Workers may return nothing, as after a request to stop."""
    better: Any = SimpleNamespace(cost=1.0, begin=None)
    changed = RunResult(name="changed", cost=1.0)

    def none(*args: Any, **kwargs: Any) -> Runs:
        yield from ()
        return []

    def change(*args: Any) -> Generator[DesignEvent, None, tuple[RunResult, Any]]:
        yield from ()
        return changed, better

    best = SimpleNamespace(cost=2.0)
    monkeypatch.setattr(LimitedSearch, "_best_inside", lambda *args: best)
    monkeypatch.setattr(LimitedSearch, "_changed", change)
    monkeypatch.setattr(LimitedSearch, "_descend", none)
    monkeypatch.setattr(LimitedSearch, "_max_iterations", 10)
    nothing: Any = None
    search = LimitedSearch(limited=nothing, is_rough=True, executor=None, budget=Budget())
    steps = search._helped_by_chance(nothing, RunResult(name="before"), None)
    assert consume(steps, None) is changed
