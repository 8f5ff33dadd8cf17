"""Orders on executors that lose tasks, fail, are slow, or do not say how large they are."""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
)
from typing import Any
from unittest.mock import Mock

import pytest

from mjfim.errors import ExperimentError
from mjfim.parallel import (
    Pool,
    Workers,
    carry_out,
    dispatch,
    results,
)
from mjfim.parallel.budget import Budget, StopToken


class FakeExecutor(Executor):
    """Does each task at once, except those that a test wants to lose.

    Args:
        lose: Given the order and how often it was submitted, the error with which it is lost.
        count: Number of workers that it states; None where it does not.
    """

    def __init__(
        self,
        lose: Callable[[int, int], BaseException | None] = lambda order, times: None,
        count: int | None = 2,
    ) -> None:
        self.lose = lose
        self.submitted = []
        if count is not None:
            self._max_workers = count

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        order = args[0]
        self.submitted.append(order)
        error = self.lose(order, self.submitted.count(order))
        future = Future()
        if error is not None:
            future.set_exception(error)
        else:
            future.set_result(fn(*args, **kwargs))
        return future


def square(number: int) -> int:
    return number * number


def squares(executor: Any, count: int = 5) -> list[tuple[int, tuple[int, ...]]]:
    return list(carry_out(executor, square, range(count), Budget()))


# An error of Dask counts as a loss, though Dask is not imported.
KilledWorker = type("KilledWorker", (Exception,), {"__module__": "distributed.scheduler"})


@pytest.mark.parametrize(
    "error", [BrokenExecutor("killed"), CancelledError(), KeyboardInterrupt(), KilledWorker()]
)
def test_lost_orders_are_done_again_and_the_results_are_the_same(error: BaseException) -> None:
    executor = FakeExecutor(lambda order, times: error if times <= order % 3 else None)
    assert squares(executor) == [(k, (k * k,)) for k in range(5)]
    assert executor.submitted.count(2) == 3


def test_an_order_that_is_lost_three_times_is_reported_and_the_others_go_on() -> None:
    executor = FakeExecutor(lambda order, times: BrokenExecutor() if order == 1 else None)
    found = squares(executor)
    assert found == [(0, (0,)), (1, ()), (2, (4,)), (3, (9,)), (4, (16,))]
    assert executor.submitted.count(1) == 3

    here = results(square, range(3), executor, Budget(), lambda order: -order)
    assert list(here) == [0, -1, 4]


def test_results_come_in_the_order_of_the_orders() -> None:
    is_last = threading.Event()

    def slow_first(order: int) -> int:
        """The first order ends after the last one has."""
        if order == 0:
            is_last.wait(20.0)
        if order == 3:
            is_last.set()
        return order

    with ThreadPoolExecutor(2) as executor:
        assert list(results(slow_first, range(4), executor, Budget())) == [0, 1, 2, 3]


def test_without_workers_each_order_is_asked_for_after_the_one_before_is_done() -> None:
    done = []
    orders = (len(done) for _ in range(3))
    assert list(results(lambda order: done.append(order), orders, None, Budget())) == [None] * 3
    assert done == [0, 1, 2]
    assert list(results(square, range(9), None, Budget(seconds=0.0))) == [0]


def test_ctrl_c_that_reaches_the_workers_as_well_keeps_the_results_so_far() -> None:
    stop = StopToken()

    def interrupted(order: int, times: int) -> BaseException | None:
        """A terminal sends Ctrl-C to the caller, which requests the token, and to the workers."""
        if order < 2:
            return None
        stop.request()
        return KeyboardInterrupt()

    found = carry_out(FakeExecutor(interrupted), square, range(9), Budget(stop=stop))
    assert list(found) == [(0, (0,)), (1, (1,))]


def test_a_request_to_stop_is_heeded_in_time_by_tasks_that_do_not_see_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "GRACE", 0.1)
    stop, go_on = StopToken(), threading.Event()

    def work(order: int) -> int:
        if order == 1:
            go_on.wait(20.0)
        if order == 2:
            stop.request()
        return order

    with ThreadPoolExecutor(2) as executor:
        found = list(carry_out(executor, work, range(9), Budget(stop=stop)))
        go_on.set()
    done = {index for index, _ in found}
    assert done >= {0, 2} and done.isdisjoint({1, 8})


def test_a_task_that_hangs_is_given_up_long_after_the_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before, the whole design waited for it, whatever its limit of time."""
    monkeypatch.setattr(dispatch, "LONGEST_OVERTIME", 0.05)
    monkeypatch.setattr(dispatch, "POLL_INTERVAL", 0.02)
    go_on = threading.Event()

    def work(order: int) -> int:
        if order == 1:
            go_on.wait(20.0)
        return order

    with ThreadPoolExecutor(2) as executor:
        found = list(carry_out(executor, work, range(2), Budget(seconds=0.0)))
        go_on.set()
    assert found == [(0, (0,))]


def test_a_cluster_without_workers_is_an_error_when_the_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dispatch, "GRACE", 0.05)
    monkeypatch.setattr(dispatch, "LONGEST_OVERTIME", 0.05)
    monkeypatch.setattr(dispatch, "POLL_INTERVAL", 0.02)
    monkeypatch.setattr(FakeClient, "nthreads", lambda self: {})

    # Nothing begins on this cluster.
    idle = FakeDaskExecutor(FakeClient())
    idle.submit = lambda *_, **__: Future()
    with pytest.raises(ExperimentError, match="had no workers"):
        list(carry_out(idle, square, range(2), Budget(seconds=0.0)))


def test_without_time_the_first_order_is_carried_out_and_the_rest_is_left_out() -> None:
    executor = FakeExecutor()
    found = list(carry_out(executor, square, range(9), Budget(seconds=0.0)))
    assert found[0] == (0, (0,))
    assert len(found) <= Workers(executor).window


def test_the_error_of_an_order_is_raised() -> None:
    executor = FakeExecutor(lambda order, times: ValueError("wrong") if order == 2 else None)
    with pytest.raises(ValueError, match="wrong"):
        squares(executor)


@pytest.mark.slow
def test_a_function_that_cannot_be_sent_is_explained() -> None:
    with Pool(1) as pool, pytest.raises(ExperimentError, match="at the top of a module"):
        list(carry_out(pool, lambda order: order, [1], Budget()))


def test_a_task_that_is_refused_while_it_is_submitted_is_explained_as_well() -> None:
    """Dask pickles a task while it is submitted."""
    refusing = FakeExecutor()
    refusing.submit = Mock(side_effect=TypeError("cannot pickle '_thread.lock' object"))
    with pytest.raises(ExperimentError, match="at the top of a module"):
        squares(refusing)


def test_the_number_of_workers_is_stated_or_found() -> None:
    assert Workers(ThreadPoolExecutor(3)).count == 3
    assert Workers(ThreadPoolExecutor(3), count=5).count == 5
    assert Workers(ThreadPoolExecutor(4)).threads_for(2) == 2
    assert Workers(ThreadPoolExecutor(4), threads=3).threads_for(2) == 3

    # Only workers that are known to be on this computer share its cores.
    far = FakeExecutor(count=128)
    assert Workers(far).threads_for(8) == 1

    # Where it is not known, all tasks are submitted, so that no worker is idle.
    unknown = FakeExecutor(count=None)
    assert Workers(unknown).count == 1
    assert math.isinf(Workers(unknown).window)

    workers = Workers(unknown)
    assert Workers.of(workers) is Workers.of_any(workers) is workers
    assert Workers.of_any(None) is None
    with pytest.raises(ExperimentError, match="wrapped already"):
        Workers(workers, threads=2)


class FakeClient:
    """As a Dask client: it has an executor, and a number of threads per worker that changes."""

    def __init__(self, *further: OSError) -> None:
        self.sizes = itertools.chain([{}], further, itertools.repeat({"a": 2, "b": 3}))

    def submit(self) -> None:
        """Only its executor is used."""

    def nthreads(self) -> dict[str, int]:
        size = next(self.sizes)
        if isinstance(size, OSError):
            raise size
        return size

    def get_executor(self) -> FakeExecutor:
        return FakeDaskExecutor(self)


class FakeDaskExecutor(FakeExecutor):
    """As the executor of a Dask client, which has no option `cancel_futures`."""

    def __init__(self, client: FakeClient) -> None:
        super().__init__(count=None)
        self._client = client
        self.waited = []

    def shutdown(self, wait: bool = True) -> None:  # type: ignore[override]
        self.waited.append(wait)


def test_a_cluster_has_as_many_workers_as_threads_and_may_grow() -> None:
    """A scheduler that does not answer leaves the number as it was."""
    cluster = Workers(FakeClient(OSError("the scheduler is gone")))
    assert [cluster.count for _ in range(3)] == [1, 1, 5]
    assert cluster.is_cluster
    assert cluster.threads_for(1) == 1


def test_a_cluster_is_ended_without_an_option_that_dask_does_not_have() -> None:
    executor = FakeDaskExecutor(FakeClient())
    Workers(executor).shutdown(wait=False, cancel_futures=True)
    assert executor.waited == [False]


@pytest.mark.parametrize("numbers", [{"count": 0}, {"threads": -1}])
def test_impossible_numbers_of_workers_are_refused(numbers: dict[str, int]) -> None:
    with pytest.raises(ExperimentError, match="must be at least 1"):
        Workers(ThreadPoolExecutor(1), **numbers)


def test_something_else_than_an_executor_is_refused() -> None:
    with pytest.raises(ExperimentError, match="has no method `submit`"):
        Workers(3)
