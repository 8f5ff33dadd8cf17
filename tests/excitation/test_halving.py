"""Successive halving: its decisions do not depend on who ends first, and nobody waits for it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.excitation.design import design_task
from mjfim.excitation.halving import HALVING_RATE, HalvingRound, Settled
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.left_starts import starts_without_time
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_searches import LimitedSearches
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.round_times import LEAST_SHARE, RoundTimes
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.running_rounds import RunningRounds
from mjfim.excitation.task import DesignTask
from mjfim.records.design import Design
from tests.support.executors import LosingExecutor, processes
from tests.support.limits import cart_inside
from tests.support.numerics import CART_PARAMETERS


def promoted(costs: Sequence[float], arrivals: Sequence[int]) -> list[int]:
    """Starts that go on, in the order of the decisions, for a given order of arrival."""
    halving = HalvingRound()
    for number in range(len(costs)):
        halving.enter(number)
    halving.close()

    found: list[int] = []
    for number in arrivals:
        halving.settle(number, Settled(cost=costs[number]))
        found += halving.decide()
    assert halving.is_over
    return found


@pytest.mark.parametrize("count", [1, 3, 4, 7, 8, 9, 30])
def test_the_same_starts_go_on_whoever_ends_first(count: int) -> None:
    rng = np.random.default_rng(count)
    costs = rng.permutation(count).astype(float).tolist()
    found = promoted(costs, range(count))
    for _ in range(20):
        assert promoted(costs, rng.permutation(count).tolist()) == found

    # The best quarter always goes on; with fewer than eight starts nobody else does.
    best = set(np.argsort(costs)[: max(1, count // HALVING_RATE)].tolist())
    assert best <= set(found)
    assert len(found) == len(set(found)) <= max(1, count // HALVING_RATE) + count // 8


def test_a_decision_does_not_wait_for_starts_behind_it() -> None:
    halving = HalvingRound()
    for number in range(8):
        halving.enter(number)
    for number in (3, 0, 2):
        halving.settle(number, Settled(cost=float(number)))
        assert halving.decide() == []
    halving.settle(1, Settled(cost=-1.0))
    assert halving.decide() == [1]
    assert halving.discarded == {0, 2, 3}

    # The last decision waits until no further start can enter.
    for number in range(4, 8):
        halving.settle(number, Settled(cost=-2.0, may_go_on=number != 4, is_usable=number < 6))
    assert halving.decide() == [] and not halving.is_over
    halving.close()
    assert halving.decide() == [5] and halving.is_over


# ---- the rounds of a design, with invented results


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    """A short experiment of the cart-pendulum within limits."""
    return cart_inside(tmp_path_factory.mktemp("halving"), horizon=0.3)


def multistart_of(task: DesignTask, count: int, executor: Executor) -> Multistart:
    """Several starts in two rounds, whose results are judged."""
    level = DescentLevel(task.relaxed(), None)
    searches = LimitedSearches(stated=level, executor=executor, budget=Budget())
    starts = [InitialControl(name=f"{i}", control=task.control) for i in range(count)]
    return Multistart(searches=searches, starts=starts, coarse=level)


# ---- the time of a search


def test_searches_that_wait_on_workers_share_the_time_of_their_round(task: DesignTask) -> None:
    """Two workers take all four searches at once, each of which does two of them."""
    with ThreadPoolExecutor(2) as threads:
        plan = multistart_of(task, 4, threads)
        timed = replace(plan, searches=replace(plan.searches, budget=Budget(seconds=3600.0)))
        rounds = RunningRounds(timed, timed.starts)
        seconds = []
        while (entry := rounds.next_entry()) is not None:
            seconds.append(rounds.terms(entry).seconds)
    assert seconds == pytest.approx([seconds[0]] * 4, rel=1e-3)


def test_a_worker_keeps_plants_with_different_threads_apart(task: DesignTask) -> None:
    with ThreadPoolExecutor(4) as threads:
        plan = multistart_of(task, 4, threads)
        searches = plan.searches
        rounds = RunningRounds(plan, plan.starts)
        entry = rounds.next_entry()
        assert entry is not None
        search = searches.search(searches.stated, entry.start, rounds.terms(entry))
        many, few = (searches.order(threads, search, count) for count in (1, 4))
    assert (many.search.threads, few.search.threads) == (4, 1)
    assert many.task_key != few.task_key


def test_what_a_search_leaves_of_its_time_is_for_those_after_it() -> None:
    now = [0.0]
    budget = Budget(seconds=110.0)
    budget._now = lambda: now[0]
    budget.begun, budget.deadline = 0.0, 110.0
    times = RoundTimes(budget, 10.0, lambda count: -(-count // 2))

    # Six searches on two workers have 60 s together; the first two end early.
    assert times.seconds(0, 0.6, 6) == times.seconds(0, 0.6, 5) == pytest.approx(20.0)
    now[0] = 5.0
    assert times.seconds(0, 0.6, 4) == pytest.approx(27.5)
    now[0] = 32.0
    assert times.seconds(0, 0.6, 2) == pytest.approx(28.0)

    # Where the others took too long there is a least time; the next round has what is left.
    now[0] = 59.0
    assert times.seconds(0, 0.6, 1) == pytest.approx(LEAST_SHARE * 20.0)
    assert times.seconds(1, 1.0, 1) == pytest.approx(41.0)


def test_starts_for_which_there_was_no_time_are_named(task: DesignTask) -> None:
    limited = replace(
        task,
        system=replace(task.system, experiment=task.experiment.replace(descent={"seconds": 3})),
    )
    starts = [InitialControl(name=name, control=task.control) for name in ("a", "b", "c")]
    (said,) = starts_without_time(limited, starts, [RunResult(name="a")])
    assert said.startswith(
        "2 of 3 initial controls were left out (b, c), because 3 s are too short"
    )
    assert starts_without_time(limited, starts, [RunResult(name=s.name) for s in starts]) == ()


# ---- real searches


def digits(design: Design) -> tuple[Any, ...]:
    """Numbers of a design that have to be equal to the last digit."""
    rows = [replace(row, seconds=0.0, motion=None, steps=0, margins={}) for row in design.history]
    return design.final.cost, design.trajectory.ctrl.tobytes(), design.starts, rows


@pytest.mark.slow
@pytest.mark.parametrize("repeats", [(), (2,)], ids=["levels", "repeated"])
def test_starts_give_the_same_design_on_any_executor(
    repeats: tuple[int, ...], tmp_path: Path
) -> None:
    """Nine starts on two levels, or with a repeated one; two decisions are made."""
    descent = {"starts": 9, "max_iterations": 4, "seed": 3, "repeats": repeats}
    task = cart_inside(tmp_path, horizon=0.6, descent=descent)
    serial = digits(design_task(task))
    for count in (1, 2, 3):
        with ThreadPoolExecutor(count) as threads:
            assert digits(design_task(task, executor=threads)) == serial
    losing = LosingExecutor(lambda order, count: count % 5 == 0)
    assert digits(design_task(task, executor=losing)) == serial
    with processes("pool") as pool:
        assert digits(design_task(task, executor=pool)) == serial


@pytest.mark.slow
def test_threads_design_with_a_parameter_that_is_a_local_function(tmp_path: Path) -> None:
    """Results are judged on the stated plant, so that workers need the whole experiment."""

    def weigh(spec: Any, value: float) -> None:
        """Set the mass; this function cannot be pickled."""
        spec.body("bob").mass = value

    mass = {"function": weigh, "guess": 2.0, "unit": "kg"}
    task = cart_inside(
        tmp_path,
        horizon=0.3,
        parameters={**CART_PARAMETERS, "m": mass},
        descent={"starts": 2, "max_iterations": 3},
    )
    serial = digits(design_task(task))
    with ThreadPoolExecutor(2) as threads:
        assert digits(design_task(task, executor=threads)) == serial
