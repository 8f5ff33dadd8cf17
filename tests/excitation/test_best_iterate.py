"""The best feasible iterate of a search is its result, not the last one, at every level.

A descent rarely goes up, so that here its iterates are reordered: the best one comes in the middle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.excitation import unconstrained
from mjfim.excitation.constrained import ConstrainedSearch
from mjfim.excitation.design import design_task
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierIterate, BarrierSchedule, InteriorPointMethod
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.run_result import consume
from mjfim.model.variants import RELAXED
from mjfim.optimize.projection_operator import Iterate
from mjfim.records.events import DesignEvent
from tests.support.limits import cart_inside
from tests.support.numerics import Array

T = TypeVar("T")


def best_in_the_middle(iterates: Iterable[T], cost: Callable[[T], float]) -> list[T]:
    """The iterates with the one of lowest cost in the middle."""
    best, *others = sorted(iterates, key=cost)
    half = len(others) // 2
    return [*others[half:], best, *others[:half]]


def barrier_cost(iterate: BarrierIterate) -> float:
    """J of an iterate of the interior-point method."""
    point = iterate.iterate.point.point
    return np.inf if point is None else point.cost


@pytest.mark.parametrize("factor", [1, 2])
def test_of_a_search_within_limits(
    factor: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also on a coarse level, whose controls hold for several samples."""
    task = cart_inside(tmp_path, horizon=0.4)
    descend = InteriorPointMethod.run
    yielded: list[BarrierIterate] = []

    def reordered(
        self: InteriorPointMethod, control: Array, budget: Budget
    ) -> Iterator[BarrierIterate]:
        # A repaired iterate is a result, but no row of the history.
        found = descend(self, control, budget)
        inside = [each for each in found if each.feasible and not each.repaired]
        yielded.extend(best_in_the_middle(inside, barrier_cost))
        yield from yielded

    monkeypatch.setattr(InteriorPointMethod, "run", reordered)
    search = ConstrainedSearch(
        experiment=task.experiment,
        start=InitialControl(name="x", control=0.2 * task.control),
        schedule=BarrierSchedule(last=0.01),
        max_iterations=8,
        variant=replace(RELAXED, sample_factor=factor),
        threads=1,
    )
    rows: list[DesignEvent] = []
    result = consume(search.run(), rows.append)

    costs = [event.row.cost for event in rows]
    assert len(costs) > 4 and min(costs) < 0.99 * costs[-1]
    assert result.cost == min(costs)

    best = yielded[int(np.argmin(costs))]
    expected = np.repeat(best.iterate.point.ctrl, factor, axis=0)
    np.testing.assert_array_equal(result.control, expected)


def test_of_a_search_without_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descend = unconstrained.optimize

    def reordered(*words: Any, **options: Any) -> list[Iterate[DesignPoint]]:
        iterates = list(descend(*words, **options))
        return best_in_the_middle(iterates, lambda iterate: iterate.point.cost)

    monkeypatch.setattr(unconstrained, "optimize", reordered)
    descent = {"max_iterations": 6, "coarse": 1}
    task = cart_inside(tmp_path, limits={}, cost={"control": 1e-3}, horizon=0.4, descent=descent)
    rows: list[DesignEvent] = []
    design = design_task(task, callback=rows.append)

    costs = [event.row.cost for event in rows]
    assert len(costs) > 4 and min(costs) < 0.99 * costs[-1]
    assert design.final.cost == pytest.approx(min(costs), rel=1e-6)
