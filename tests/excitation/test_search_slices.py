"""Searches in slices: the results of the whole search, whatever becomes of the workers."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget, StopToken
from mjfim.excitation import constrained, free_slices
from mjfim.excitation.constrained import ConstrainedSearch, ConstrainedSlice, run_in_worker
from mjfim.excitation.design import design_task
from mjfim.excitation.free_slices import FreeSlice
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_searches import LimitedSearches
from mjfim.excitation.run_result import RunResult, consume
from mjfim.excitation.search_slices import MOST_SLICES_PER_SECOND, SLICE_SECONDS, SearchSlice
from mjfim.excitation.sliced_searches import run_in_slices
from mjfim.excitation.task import DesignTask
from mjfim.parallel import Workers
from mjfim.records.design import Design, Status
from mjfim.records.events import DesignEvent
from tests.support.executors import LosingExecutor
from tests.support.limits import cart_inside

# Iterations of a search, which pass through several stages of the barrier.
ITERATIONS = 14


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    """A short experiment of the cart-pendulum within limits."""
    return cart_inside(tmp_path_factory.mktemp("slices"), horizon=0.3)


def search_of(task: DesignTask, factor: float = 1.0) -> ConstrainedSearch:
    """A search from the initial control times a factor."""
    return ConstrainedSearch(
        experiment=task.experiment,
        start=InitialControl(name=f"{factor:g} times", control=factor * task.control),
        schedule=BarrierSchedule(patience=5),
        max_iterations=ITERATIONS,
        threads=1,
    )


def sharp_search_of(task: DesignTask) -> ConstrainedSearch:
    """A search whose directions follow the curvature of the barrier after some of its steps."""
    schedule = BarrierSchedule(first=1e-3, last=1e-5, patience=5, follows_curvature=True)
    return replace(search_of(task), schedule=schedule)


@pytest.fixture(scope="module")
def searches(task: DesignTask) -> list[ConstrainedSearch]:
    return [search_of(task, factor) for factor in (1.0, 0.8, 0.6)]


@pytest.fixture(scope="module")
def wholes(searches: list[ConstrainedSearch], whole: RunResult) -> list[RunResult]:
    """Results of the searches as a whole."""
    return [whole, *(consume(search.run(), None) for search in searches[1:])]


@pytest.fixture(scope="module")
def whole(searches: list[ConstrainedSearch]) -> RunResult:
    """Result of the first search as a whole."""
    return consume(searches[0].run(), None)


def assert_same(found: RunResult, whole: RunResult) -> None:
    """Assert that two results are equal to the last digit, apart from the time."""
    assert (found.cost, found.status, found.slope) == (whole.cost, whole.status, whole.slope)
    assert np.array_equal(np.asarray(found.control), np.asarray(whole.control))
    assert found.steps == whole.steps
    pairs = zip(found.earlier, whole.earlier, strict=True)
    assert all(np.array_equal(one, other) for one, other in pairs)

    rows = [
        [replace(row, seconds=0.0, motion=None) for row in result.history]
        for result in (found, whole)
    ]
    assert rows[0] == rows[1]


def slices_of(order: ConstrainedSlice) -> list[SearchSlice[Any]]:
    """All slices of a search; each is pickled, as on its way to another process."""
    slices = [run_in_worker(pickle.loads(pickle.dumps(order)))]
    while slices[-1].state is not None:
        following = replace(order, before=slices[-1])
        slices.append(run_in_worker(pickle.loads(pickle.dumps(following))))
    return slices


@pytest.mark.parametrize("iterations", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_a_search_in_slices_equals_the_whole_one_to_the_last_digit(
    iterations: int,
    searches: list[ConstrainedSearch],
    whole: RunResult,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    offered: list[SearchSlice[Any]] = []
    monkeypatch.setattr(constrained, "offer_result", offered.append)
    order = ConstrainedSlice(search=searches[0], task_key="slices", iterations=iterations)
    slices = slices_of(order)

    assert len(slices) >= ITERATIONS // iterations
    assert_same(slices[-1].result, whole)

    # After Ctrl-C counts what a worker has offered last, with the controls of earlier stages.
    pairs = zip(offered[-1].result.earlier, whole.earlier, strict=True)
    assert whole.earlier and all(np.array_equal(one, other) for one, other in pairs)


@pytest.mark.slow
def test_directions_that_follow_the_curvature_of_the_barrier_do_so_in_the_next_slice(
    task: DesignTask,
) -> None:
    search = sharp_search_of(task)
    order = ConstrainedSlice(search=search, task_key="sharp", iterations=1)
    slices = slices_of(order)
    assert_same(slices[-1].result, consume(search.run(), None))

    # Some slices begin with such a direction, others without.
    states = [each.state.opened() for each in slices if each.state is not None]
    assert {state.barrier.begun.direction.is_bent for state in states} == {True, False}


def test_an_order_can_be_done_again(searches: list[ConstrainedSearch]) -> None:
    """Threads receive no copy of an order; the search must not change it."""
    order = ConstrainedSlice(search=searches[0], task_key="again", iterations=3)
    following = replace(order, before=run_in_worker(order))
    first, second = run_in_worker(following), run_in_worker(following)
    assert len(first.result.history) > 3
    assert_same(first.result, second.result)
    steps = [pickle.dumps(each.state.opened().short_steps) for each in (first, second)]
    assert steps[0] == steps[1]


def test_slices_find_out_once_that_parameters_are_not_lumped(task: DesignTask) -> None:
    """The combination that counts as without effect has one, as the first trajectory shows."""
    with_effect = np.array([[1.0], [1.0], [0.0]])
    basis = np.linalg.qr(with_effect, mode="complete")[0][:, 1:]
    search = replace(search_of(task), combinations=basis, max_iterations=4)

    order = ConstrainedSlice(search=search, task_key="lumped", iterations=2)
    slices = [run_in_worker(order)]
    while slices[-1].state is not None:
        slices.append(run_in_worker(pickle.loads(pickle.dumps(replace(order, before=slices[-1])))))
    assert len(slices) > 1
    assert_same(slices[-1].result, consume(search.run(), None))


def run_sliced(
    searches: list[ConstrainedSearch],
    executor: Executor,
    stop: StopToken | None = None,
    callback: Callable[[DesignEvent], None] | None = None,
) -> list[RunResult]:
    """Run searches in slices, each of which ends after every second iterate."""
    orders = [ConstrainedSlice(search=each, task_key="short", iterations=2) for each in searches]
    return consume(run_in_slices(executor, orders, run_in_worker, Budget(stop=stop)), callback)


@pytest.mark.slow
def test_slices_that_are_lost_are_done_again(
    searches: list[ConstrainedSearch], wholes: list[RunResult]
) -> None:
    rows: list[DesignEvent] = []
    executor = LosingExecutor(lambda order, count: count in (2, 3, 6, 10, 11, 17))
    found = run_sliced(searches, executor, callback=rows.append)
    for each, whole in zip(found, wholes, strict=True):
        assert_same(each, whole)

    # Each iterate is shown once, in the order of its search.
    for whole in wholes:
        shown = [event.row.iteration for event in rows if event.start == whole.name]
        assert shown == [row.iteration for row in whole.history]


@pytest.mark.slow
def test_a_start_that_is_lost_each_time_is_reported_with_its_result_so_far(
    searches: list[ConstrainedSearch], wholes: list[RunResult]
) -> None:
    executor = LosingExecutor(
        lambda order, count: order.search is searches[1] and order.before is not None
    )
    found = run_sliced(searches, executor)
    assert_same(found[0], wholes[0])
    assert_same(found[2], wholes[2])
    assert found[1].status is Status.LOST
    assert len(found[1].history) == 2
    assert found[1].control is not None


def test_a_request_to_stop_loses_at_most_one_slice_on_threads(
    searches: list[ConstrainedSearch],
) -> None:
    stop = StopToken()
    rows: list[DesignEvent] = []

    def stop_after_some(event: DesignEvent) -> None:
        rows.append(event)
        if len(rows) == 6:
            stop.request()

    threads_before = threading.active_count()
    with ThreadPoolExecutor(2) as executor:
        found = run_sliced(searches, executor, stop, stop_after_some)
    assert all(result.status is Status.INTERRUPTED for result in found)
    assert sum(len(result.history) for result in found) >= 6
    assert min(result.cost for result in found) < np.inf
    assert threading.active_count() <= threads_before


@pytest.mark.slow
def test_a_slice_says_when_its_search_has_ended(searches: list[ConstrainedSearch]) -> None:
    ended = run_in_worker(ConstrainedSlice(search=searches[0], task_key="ended", seconds=np.inf))
    assert isinstance(ended, SearchSlice)
    assert ended.state is None
    assert ended.result.status is not Status.INTERRUPTED


def assert_same_design(found: Design, serial: Design) -> None:
    """Assert that two designs are equal to the last digit, apart from the time."""
    assert (found.final.cost, found.status, found.steps) == (
        serial.final.cost,
        serial.status,
        serial.steps,
    )
    assert np.array_equal(found.trajectory.ctrl, serial.trajectory.ctrl)
    assert found.starts == serial.starts

    # Without limits there is no margin.
    found_rows, rows = (
        [replace(row, seconds=0.0, motion=None, margin=0.0) for row in design.history]
        for design in (found, serial)
    )
    assert found_rows == rows


@pytest.mark.parametrize("horizon", [0.4, pytest.param(1.2, marks=pytest.mark.slow)])
def test_free_starts_on_workers_give_the_design_of_one_process(
    horizon: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Slices of two iterates, some of which are lost; a long horizon has a coarse level."""
    descent = {"starts": 2, "max_iterations": 6, "coarse": 2}
    cost = {"control": 1e-3}
    task = cart_inside(tmp_path, horizon=horizon, limits={}, cost=cost, descent=descent)
    serial = design_task(task)
    levels = {row.rate for row in serial.history}

    def short_slice(**values: Any) -> FreeSlice:
        return FreeSlice(**{"iterations": 2, **values})

    monkeypatch.setattr(free_slices, "FreeSlice", short_slice)
    executor = LosingExecutor(lambda order, count: count in (2, 3, 6))
    found = design_task(task, executor=executor)
    assert executor.count > 6
    assert len(levels) == (2 if horizon > 1.0 else 1)
    assert_same_design(found, serial)


@pytest.mark.parametrize(("workers", "starts"), [(2, 1000), (256, 40), (256, 1000)])
def test_slices_are_longer_where_many_workers_would_outrun_the_caller(
    task: DesignTask, workers: int, starts: int
) -> None:
    executor = Workers(LosingExecutor(lambda *_: False), count=workers, threads=1)
    stated = DescentLevel(task, np.eye(len(task.system.parameters.names)))
    searches = LimitedSearches(stated=stated, executor=executor, budget=Budget())
    order = searches.order(executor, search_of(task), starts)

    # Searches end at about this rate, if all of them run.
    assert min(workers, starts) / order.seconds <= MOST_SLICES_PER_SECOND
    if workers * SLICE_SECONDS < MOST_SLICES_PER_SECOND or starts < workers:
        assert order.seconds == SLICE_SECONDS
