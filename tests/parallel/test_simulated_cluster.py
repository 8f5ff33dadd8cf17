"""The scheduler on a simulated clock: no worker waits while there is work, whatever the number."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget, StopToken
from mjfim.parallel import carry_out
from scripts.benchmarks import arms, scale
from scripts.benchmarks.core_speed import at_speed
from scripts.benchmarks.simulated_cluster import MeasuredTasks, simulated
from scripts.benchmarks.simulated_design import Efficiency


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


class Slow:
    """An order that takes long to pickle."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[type, tuple[int]]:
        end = time.process_time() + 0.01
        while time.process_time() < end:
            pass
        return Slow, (self.number,)


def test_the_time_in_which_the_caller_pickles_counts_for_each_order() -> None:
    kept = {number: (number, 1000.0) for number in range(20)}
    tasks = MeasuredTasks(key_of=lambda args: args[0].number % 2, kept=kept)
    with simulated(20, tasks) as cluster:
        orders = [Slow(number) for number in range(20)]
        outcomes = carry_out(cluster.workers, never, orders, Budget(stop=StopToken()))
        assert len(list(outcomes)) == 20

    # It is measured for each of the two kinds of orders.
    assert set(tasks.pickling) == {0, 1}
    assert cluster.pickling >= 20 * 0.01
    assert cluster.caller >= cluster.pickling
    assert cluster.now >= 1000.0 + cluster.pickling / 20


def test_a_time_is_stated_at_another_speed_if_both_speeds_are_known() -> None:
    assert at_speed(6.0, speed=2.0, wanted=3.0) == 4.0
    assert at_speed(6.0, speed=np.nan, wanted=3.0) == 6.0
    assert at_speed(6.0, speed=2.0, wanted=np.nan) == 6.0


@pytest.mark.parametrize(
    ("value", "iterations", "verdict"),
    [(0.81, 102, (True, True)), (0.79, 100, (False, True)), (0.81, 104, (True, False))],
)
def test_both_curves_are_judged_at_the_largest_number_of_workers(
    value: float,
    iterations: int,
    verdict: tuple[bool, bool],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def curve(
        experiment: mjfim.Experiment, starts: int, counts: Sequence[int]
    ) -> Iterator[Efficiency]:
        """An efficiency of 1 and equal work but for the arm on the largest number of workers."""
        for count in counts:
            is_last = experiment.source == "arm" and count == counts[-1]
            yield Efficiency(
                workers=count,
                seconds=starts / count,
                efficiency=value if is_last else 1.0,
                of_searches=1.0,
                iterations=iterations if is_last else 100,
                caller=0.1,
                pickling=0.05,
                tasks=10,
                task_seconds=0.2,
            )

    cart = mjfim.Experiment.from_file(scale.MODELS / "cart_pendulum_limits.toml")
    arm = cart.model_copy(update={"source": "arm"})
    monkeypatch.setattr(arms, "MODELS", tmp_path)
    monkeypatch.setattr(arms, "experiment", lambda *arguments: arm)
    monkeypatch.setattr(scale, "efficiencies", curve)
    monkeypatch.setattr(scale, "verdicts", [])
    options = argparse.Namespace(
        simulated_starts=8192, arm_starts=1000, picture=tmp_path / "curves.png"
    )

    assert scale.simulations(scale.QUICK, options) is all(verdict)
    assert [each.good for each in scale.verdicts] == [True, True, *verdict]
    assert options.picture.is_file()
    assert "a design from 1000 starts" in capsys.readouterr().out

    # Without the model of the arm there is one curve.
    monkeypatch.setattr(arms, "MODELS", tmp_path / "absent")
    assert scale.simulations(scale.QUICK, options)
    assert "is left out" in capsys.readouterr().out
