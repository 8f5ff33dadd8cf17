"""Budgets: the clock by which they measure time."""

from __future__ import annotations

import pickle
import time

import pytest

from mjfim.parallel.budget import LONGEST_WAY, Budget, StopReason, StopToken, measured_by


def test_a_budget_keeps_the_clock_with_which_it_was_made() -> None:
    moment = [5.0]
    with measured_by(lambda: moment[0]):
        budget = Budget(seconds=10.0)
        part = budget.share(0.5)
    moment[0] = 11.0
    assert (budget.seconds_used, budget.seconds_left, part.exhausted) == (
        6.0,
        4.0,
        StopReason.SECONDS,
    )
    assert budget.exhausted is None and budget.share(0.5).exhausted is None

    # A copy with another token goes on counting by the same clock.
    token = StopToken()
    other = budget.with_stop(token)
    assert (other.seconds_used, other.seconds_left) == (6.0, 4.0)
    token.request()
    assert other.exhausted is StopReason.REQUESTED and budget.exhausted is None

    # The process of a worker has its own clock.
    restored = pickle.loads(pickle.dumps(Budget(seconds=1e6)))
    assert restored.exhausted is None and 0.0 <= restored.seconds_used < 1e3


@pytest.mark.parametrize("ahead", [-3600.0, 3600.0])
def test_the_time_left_is_kept_on_a_computer_whose_clock_differs(
    monkeypatch: pytest.MonkeyPatch, ahead: float
) -> None:
    sent = pickle.dumps(Budget(seconds=1000.0))
    there = time.time() + ahead
    monkeypatch.setattr("mjfim.parallel.budget.time.time", lambda: there)

    restored = pickle.loads(sent)
    assert 1000.0 - LONGEST_WAY - 10.0 <= restored.seconds_left <= 1000.0
