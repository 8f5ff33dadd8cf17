"""The anytime search: its result at any moment, its moves, and what happens when work is lost."""

from __future__ import annotations

import itertools
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.design import design_task
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.search import search as search_module
from mjfim.excitation.search.climb import Candidate, Move, tightened, without_jumps
from mjfim.excitation.search.descent import Ground
from mjfim.excitation.search.inside import InsideSearch, largest_share
from mjfim.excitation.search.levels import DescentLevel, easier_level
from mjfim.excitation.task import DesignTask
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent
from tests.support.limits import cart_inside
from tests.support.stiff_servos import stiff_arm_task


def level_of(task: DesignTask) -> DescentLevel:
    """The stated level of a task within its limits."""
    return DescentLevel(task.relaxed(), None)


# ---- the result at any moment


@pytest.mark.parametrize("count", [0, 1, 3])
@pytest.mark.parametrize("tables", [{}, {"limits": {}, "cost": {"control": 1e-3}}])
def test_a_stop_at_any_iterate_leaves_the_best_that_was_seen(
    count: int, tables: Any, tmp_path: Path
) -> None:
    task, stop, seen = cart_inside(tmp_path, **tables), StopToken(), 0

    def watch(event: object) -> None:
        """Stop after some iterates."""
        nonlocal seen
        seen += isinstance(event, DesignEvent)
        if seen > count:
            stop.request()

    design = design_task(task, callback=watch, budget=Budget(stop=stop))
    assert design.status is Status.INTERRUPTED
    assert design.final.cost <= design.initial.cost
    assert verify(task, design.trajectory).is_feasible


@pytest.mark.parametrize("workers", [0, 1])
def test_a_stop_before_the_first_iterate_leaves_the_start(workers: int, tmp_path: Path) -> None:
    task, stop = cart_inside(tmp_path), StopToken()
    stop.request()
    with ThreadPoolExecutor(1) as executor:
        design = design_task(task, executor=executor if workers else None, budget=Budget(stop=stop))
    assert design.status is Status.INTERRUPTED
    assert design.final.cost <= design.initial.cost
    if not workers:
        assert_allclose(design.trajectory.ctrl, task.control, atol=1e-12)


@pytest.mark.slow
def test_a_start_outside_the_limits_is_scaled_and_improved(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path, descent={"max_iterations": 2})
    assert not level_of(task).keeps(task.control)
    design = design_task(task)
    assert 0.0 < design.scaled_start.share < 1.0
    assert design.final.cost <= design.scaled_start.cost
    assert verify(task, design.trajectory).is_feasible


# ---- moves


def test_the_largest_share_is_found_and_a_stop_ends_the_search_for_a_larger_one() -> None:
    def keeps(share: float) -> bool:
        """A limit at a share of 0.123."""
        return share <= 0.123

    assert 0.123 / 1.05 <= largest_share(keeps, Budget()) <= 0.123
    assert largest_share(lambda share: False, Budget()) is None
    stopped = Budget()
    stopped.stop.request()
    assert 0.0 < largest_share(keeps, stopped) <= 0.123


@pytest.mark.parametrize("bandwidth", [None, 8.0])
def test_random_changes_lower_the_cost_within_limits(
    bandwidth: float | None, tmp_path: Path
) -> None:
    limits = {"control": {"force": [-5.0, 5.0]}, "position": {"slide": [-0.5, 0.5]}}
    task = cart_inside(tmp_path, limits={**limits, "bandwidth": bandwidth})
    level = level_of(task)
    first = InsideSearch(level, 0).scaled(task.control, Budget())
    better = InsideSearch(level, 0).improvements(first, Budget(), patience=12)
    found = list(itertools.islice(better, 3))
    costs = [first.cost, *(each.cost for each in found)]
    assert len(costs) > 1
    assert costs == sorted(costs, reverse=True)
    basis = task.bandwidth_basis(task.t)
    for each in found:
        assert level.keeps(each.control)
        if basis is not None:
            fitted = basis @ np.linalg.lstsq(basis, each.deviation)[0]
            assert_allclose(fitted, each.deviation, atol=1e-9)


def test_the_barrier_alone_steers_a_control_inside(tmp_path: Path) -> None:
    """No share of the deviation helps where the centre itself violates a limit."""
    limits = {"control": {"force": [-5.0, 5.0]}, "velocity": {"slide": [0.05, 3.0]}}
    initial = {"qvel": (0.2, 0.0), "control": {"kind": "sine", "amplitude": 0.1, "frequency": 1.0}}
    task = cart_inside(tmp_path, limits=limits, initial=initial, horizon=0.5).relaxed()
    ground = Ground.of(DescentLevel(task, None))
    outside = np.full_like(task.control, -0.8)
    assert not ground.level.constraints.is_feasible(ground.level.values(outside))
    for strictly, least in ((False, -1.0), (True, 0.0)):
        inside = ground.begin(outside, Budget(), strictly=strictly)
        margins = ground.level.constraints.relative_margins(ground.level.values(inside))
        assert min(margins.values()) > least


def test_limits_are_tightened_where_violated_and_released_where_well_kept() -> None:
    after = tightened({"control": 0.2, "position": 0.0}, {"control": 0.1, "position": -0.05})
    assert after == {"control": pytest.approx(0.15), "position": pytest.approx(0.06)}
    assert tightened(after, {"control": 1.0, "position": 0.0})["control"] == 0.0


def test_a_control_of_long_samples_has_no_steps_where_its_rate_is_limited(tmp_path: Path) -> None:
    limits = {"control": {"force": [-5.0, 5.0]}, "control_rate": {"force": 100.0}}
    limited, free = level_of(cart_inside(tmp_path, limits=limits)), level_of(cart_inside(tmp_path))
    steps = np.repeat(np.arange(25.0)[:, None], 4, axis=0)
    smooth = without_jumps(limited, steps, 4)
    assert_allclose(np.diff(smooth[2:-2], axis=0), 0.25)
    assert np.array_equal(without_jumps(free, steps, 4), steps)
    assert np.array_equal(without_jumps(limited, smooth, 4), smooth)


# ---- time that is left


def test_series_follow_while_they_help(tmp_path: Path) -> None:
    """A stated time goes to series until three in turn did not help; the best one is the result."""
    timed = cart_inside(tmp_path, horizon=0.5, descent={"max_iterations": 3, "seconds": 60.0})
    design = design_task(timed)
    assert design.seconds < 45.0
    first, *further = (start.name for start in design.starts)
    assert first == "initial control" and len(further) >= 3
    assert all(name.startswith("Fourier series of ") for name in further)
    costs = [each.cost for each in design.starts]
    assert design.final.cost == pytest.approx(min(costs), rel=1e-6)
    assert min(costs[:-3]) == pytest.approx(min(costs), rel=0.01)


def weighted(folder: Path, criterion: str) -> DesignTask:
    """The cart with weights on its control, wide limits, and two engine steps in a sample."""
    return cart_inside(
        folder,
        rate=50.0,
        cost={"criterion": criterion, "control": 1e-3},
        limits={"control": {"force": [-20.0, 20.0]}, "position": {"slide": [-3.0, 3.0]}},
        descent={"max_iterations": 6},
    )


@pytest.mark.parametrize("criterion", ["E", "D"])
def test_weights_alone_may_bound_a_control(criterion: str, tmp_path: Path) -> None:
    """Without a barrier with E-optimality, inside a light barrier with D-optimality."""
    task = weighted(tmp_path, criterion)
    weights = [row.mu for row in design_task(task).history]
    assert max(weights) == (0.0 if criterion == "E" else pytest.approx(1e-3))


def test_a_coarse_level_has_longer_timesteps_where_a_sample_has_several(tmp_path: Path) -> None:
    """Its samples stay, and its cost is never that of the design."""
    task = weighted(tmp_path, "E")
    coarse = easier_level(DescentLevel(task, None), task.problem.point(task.initial)).task
    assert coarse.system.variant.is_coarse
    assert coarse.samples == task.samples
    assert coarse.system.grid.substeps < task.system.grid.substeps
    design = design_task(task)
    again = task.problem.point(task.plant.simulate(task.theta, design.trajectory.ctrl))
    assert design.final.cost == pytest.approx(again.cost, rel=1e-4)


# ---- several starts, here and on workers


def test_a_start_whose_worker_is_lost_is_optimised_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def losing(move: Move) -> Candidate:
        """Lose every start."""
        raise CancelledError

    tables = {"limits": {}, "cost": {"control": 1e-3}}
    task = cart_inside(tmp_path, descent={"max_iterations": 3, "starts": 2}, **tables)
    alone = design_task(task)
    monkeypatch.setattr(search_module, "move_in_worker", losing)
    with ThreadPoolExecutor(1) as executor:
        design = design_task(task, executor=executor)
    assert design.final.cost == alone.final.cost
    assert [start.cost for start in design.starts] == [start.cost for start in alone.starts]


def test_long_moves_on_workers_are_cut_and_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The iterates of a long descent are shown while it runs, and its iterations are counted."""
    monkeypatch.setattr(search_module, "MOVE_SECONDS", 0.05)
    monkeypatch.setattr(search_module, "MOVE_EVALUATIONS", 0.0)
    task = cart_inside(tmp_path, descent={"max_iterations": 12})
    moves = []
    monkeypatch.setattr(
        search_module,
        "move_in_worker",
        lambda move, run=search_module.move_in_worker: moves.append(move) or run(move),
    )
    with ThreadPoolExecutor(1) as executor:
        design = design_task(task, executor=executor)
    assert 2 < len(moves) < 60
    assert design.final.cost < design.initial.cost
    assert verify(task, design.trajectory).is_feasible


def test_starts_without_time_are_named(tmp_path: Path) -> None:
    descent = {"starts": 5, "seconds": 0.01, "max_iterations": 10**6}
    design = design_task(cart_inside(tmp_path, limits={}, cost={"control": 1e-3}, descent=descent))
    assert any("were left out (multisine" in warning for warning in design.warnings)
