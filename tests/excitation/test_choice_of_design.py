"""Choice of a design among its runs, where workers were stopped or lost."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.excitation import control_search
from mjfim.excitation.control_search import EVALUATED_STOPPED, choose
from mjfim.excitation.run_result import RunResult
from mjfim.parallel import LostWorkError
from mjfim.records.design import Status

SEARCH: Any = SimpleNamespace(stage=None, limited=None)
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

    best, chosen = choose(SEARCH, [INITIAL], results, True)
    assert (best.name, best.cost, chosen.cost) == ("3", 3.1, 3.1)
    assert evaluated == [3.0, 5.0, 6.0, 7.0][:EVALUATED_STOPPED]


def test_a_design_all_of_whose_workers_are_lost_says_so() -> None:
    results = [RunResult(name=name, status=Status.LOST) for name in ("first", "second")]
    with pytest.raises(LostWorkError, match="the workers of all starts were lost"):
        choose(SEARCH, [INITIAL], results, False)
