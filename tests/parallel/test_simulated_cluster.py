"""The scheduler on a simulated clock: no worker waits while there is work, whatever the number."""

from __future__ import annotations

import pytest

from mjfim.budget import Budget, StopToken
from mjfim.parallel import carry_out
from scripts.benchmarks.simulated_cluster import MeasuredTasks, simulated


def never(order: int) -> int:
    """A task whose result is kept already."""
    raise AssertionError(order)


@pytest.mark.parametrize(
    ("workers", "seconds"), [(1, 12_000.0), (2, 6000.0), (4, 3000.0), (12, 1000.0), (64, 1000.0)]
)
def test_tasks_fill_the_simulated_workers(workers: int, seconds: float) -> None:
    kept = {order: (order**2, 1000.0) for order in range(12)}
    tasks = MeasuredTasks(key_of=lambda args: args[0], kept=kept)
    with simulated(workers, tasks) as cluster:
        found = list(carry_out(cluster.workers, never, range(12), Budget(stop=StopToken())))

    assert [outcome.result for outcome in found] == [order**2 for order in range(12)]
    assert cluster.busy == 12_000.0
    # The caller's own time, some milliseconds, counts as well.
    assert seconds <= cluster.now < seconds + 100.0


def test_a_task_is_carried_out_once_and_takes_as_long_each_time() -> None:
    calls = []
    tasks = MeasuredTasks(key_of=lambda args: args[0] % 3)
    for workers in (1, 5):
        with simulated(workers, tasks, latency=100.0) as cluster:
            outcomes = carry_out(cluster.workers, calls.append, range(6), Budget(stop=StopToken()))
            assert len(list(outcomes)) == 6

        # Every task reaches its worker, and its result the caller, after the latency.
        assert cluster.searching >= 200.0
    assert calls == [0, 1, 2]
