"""How much a search that ended at its budget was still improving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjfim.records.design import HistoryRow, Status, improvement_per_iteration
from tests.support.made_records import make_design, make_row


def rows(costs: list[float], rate: float = 100.0, **fields: float) -> list[HistoryRow]:
    """Iterates of these costs, with further fields that all have in common."""
    return [make_row(iteration=i, cost=cost, rate=rate, **fields) for i, cost in enumerate(costs)]


def test_it_is_the_share_of_the_last_ten_iterations() -> None:
    steady = [0.99**i for i in range(31)]
    assert improvement_per_iteration(rows(steady), steady[-1]) == pytest.approx(0.01)

    # What happened before them does not count, and neither does an iterate that cost more.
    at_last = [1e6, 1e5, *(100.0 * 0.5 ** (i / 10) for i in range(11)), 90.0]
    expected = 1.0 - (50.0 / 100.0 * 0.5**-0.1) ** 0.1
    assert improvement_per_iteration(rows(at_last), 50.0) == pytest.approx(expected)


def test_only_iterates_inside_the_limits_on_the_last_time_grid_count() -> None:
    coarse = rows([9.0, 8.0], rate=25.0)
    outside = rows([0.1, 0.2], margin=-0.1)
    inside = [replace(row, iteration=5 + i) for i, row in enumerate(rows([2.0, 1.0], margin=0.1))]
    assert improvement_per_iteration([*coarse, *outside, *inside], 1.0) == pytest.approx(0.5)

    # A new stage of the barrier repeats an iterate; one of them is not enough.
    repeated = [inside[0], inside[0]]
    for few in ([], inside[:1], repeated, outside):
        assert np.isnan(improvement_per_iteration(few, 1.0))


def test_it_stands_in_the_sentence_of_a_design_that_ended_at_its_budget() -> None:
    budget = replace(make_design(1, 2), status=Status.MAX_ITERATIONS)
    assert "before convergence" in budget.outcome
    improving = replace(budget, improvement=0.002)
    assert improving.outcome.startswith(
        "stopped at its budget (max_iterations or seconds), still improving by 0.2 % per iteration"
    )
    assert improving.summary()["message"] == improving.outcome
    assert "hardly improving any more" in replace(budget, improvement=1e-6).outcome

    # Other outcomes do not mention it.
    ended = replace(improving, status=Status.CONVERGED)
    assert ended.outcome == Status.CONVERGED.value
