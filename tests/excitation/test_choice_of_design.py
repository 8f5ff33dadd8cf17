"""Choice of a design among its runs, where workers were stopped or lost."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.excitation import control_search
from mjfim.excitation.control_search import (
    EVALUATED_LIMITED,
    EVALUATED_STOPPED,
    ControlSearch,
    choose,
)
from mjfim.excitation.run_result import RunResult
from mjfim.parallel import LostWorkError
from mjfim.records.design import Status

SEARCH: Any = SimpleNamespace(stage=None, limited=None, executor=None)
INITIAL: Any = SimpleNamespace(cost=10.0)


def stopped(cost: float) -> RunResult:
    """A run that was stopped on the coarse level, where its control of this value has this cost."""
    row: Any = SimpleNamespace(cost=cost)
    return RunResult(
        name=f"{cost:g}", control=np.full((1, 1), cost), status=Status.INTERRUPTED, history=(row,)
    )


def test_the_best_of_several_runs_that_were_stopped_on_the_coarse_level_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evaluated = []

    def point(stage: object, control: Array) -> Any:
        """Evaluate a control at the stated rate, where it costs slightly more."""
        evaluated.append(control[0, 0])
        return SimpleNamespace(cost=control[0, 0] + 0.1)

    monkeypatch.setattr(control_search, "point_at_stated_rate", point)
    results = [stopped(cost) for cost in (7.0, 3.0, 9.0, 8.0, 6.0, 5.0)]

    choice = choose(SEARCH, [INITIAL], results, True)
    assert (choice.best.name, choice.best.cost, choice.point.cost) == ("3", 3.1, 3.1)
    assert evaluated == [3.0, 5.0, 6.0, 7.0][:EVALUATED_STOPPED]

    # The results that the caller holds are not changed.
    assert all(result.point is None for result in results)
    assert sum(result.point is not None for result in choice.results) == EVALUATED_STOPPED


def test_the_best_of_many_starts_is_evaluated_whatever_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of many starts under limits only some are evaluated before; one of them may cost more."""

    def point(stage: object, control: Array) -> Any:
        """Evaluate a control, which is as good as its search has said."""
        return SimpleNamespace(cost=control[0, 0])

    monkeypatch.setattr(control_search, "point_at_stated_rate", point)
    evaluated = replace(stopped(2.0), cost=6.0, point=SimpleNamespace(cost=6.0))
    others = [replace(stopped(cost), cost=cost) for cost in (4.0, 5.0)]
    choice = choose(SEARCH, [INITIAL], [evaluated, *others], False)
    assert choice.best.name == "4" and choice.point.cost == 4.0
    assert [result.point is None for result in choice.results] == [False, False, True]


def test_a_control_outside_the_limits_does_not_look_better_than_the_design(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A start that was discarded outside the limits is evaluated, but has no cost to compare."""

    def point(stage: object, control: Array) -> Any:
        """Evaluate a control."""
        return SimpleNamespace(cost=control[0, 0])

    monkeypatch.setattr(control_search, "point_at_stated_rate", point)
    inside = replace(stopped(4.0), cost=4.0)
    outside = replace(stopped(1.0), is_feasible=False, status=Status.LEFT)
    choice = choose(SEARCH, [INITIAL], [inside, outside], False)
    assert (choice.best.name, choice.point.cost) == ("4", 4.0)
    assert [result.cost for result in choice.results] == [4.0, np.inf]

    # Where nothing is inside, the costs tell which one was chosen.
    alone = choose(SEARCH, [INITIAL], [outside], True)
    assert [result.cost for result in alone.results] == [1.0]


def test_a_design_all_of_whose_workers_are_lost_says_so() -> None:
    results = [RunResult(name=name, status=Status.LOST) for name in ("first", "second")]
    with pytest.raises(LostWorkError, match="the worker of every start was lost"):
        choose(SEARCH, [INITIAL], results, False)


def test_a_control_within_limits_is_found_behind_many_others_after_a_request_to_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    evaluated: list[str] = []

    def on_stated_plant(result: RunResult) -> RunResult:
        """Evaluate a result; that of the start `10` alone keeps all limits."""
        evaluated.append(result.name)
        return replace(result, is_feasible=result.name == "10")

    stop = StopToken()
    search: Any = SimpleNamespace(budget=Budget(stop=stop), _on_stated_plant=on_stated_plant)
    results = [RunResult(name=f"{i}", cost=float(i)) for i in range(14)]
    ControlSearch._evaluated(search, results)
    assert evaluated == [f"{i}" for i in range(EVALUATED_LIMITED)]

    evaluated.clear()
    stop.request()
    found = ControlSearch._evaluated(search, results)
    assert evaluated == [f"{i}" for i in range(11)]
    assert [result.name for result in found if result.is_feasible] == ["10"]
    assert ControlSearch._evaluated(search, []) == []

    evaluated.clear()
    monkeypatch.setattr(control_search, "EVALUATED_SECONDS", -1.0)
    ControlSearch._evaluated(search, results)
    assert evaluated == [f"{i}" for i in range(EVALUATED_LIMITED)]
