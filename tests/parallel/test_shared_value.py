"""Large values that tasks refer to: a worker process receives them when it needs them first."""

from __future__ import annotations

import gc
import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any
from weakref import WeakValueDictionary

import pytest

from mjfim.parallel import carry_out, shared_value
from mjfim.parallel.budget import Budget
from mjfim.parallel.shared_value import AbsentValueError, SharedValue
from mjfim.parallel.workers import TASKS_PER_WORKER

# A value that would be expensive to send with every task.
LARGE = b"x" * 100_000


class FakeProcesses(Executor):
    """Carries out tasks in turn as several processes would, which share nothing with the caller.

    Args:
        count: Number of processes.
    """

    def __init__(self, count: int) -> None:
        self._max_workers = count
        self._processes = [shared_value._ReceivedValues() for _ in range(count)]
        self.sizes = []

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        sent = pickle.dumps((fn, args, kwargs))
        process = self._processes[len(self.sizes) % len(self._processes)]
        self.sizes.append(len(sent))

        future = Future()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(shared_value, "_received", process)
            patch.setattr(shared_value, "_owned", WeakValueDictionary())
            function, arguments, named = pickle.loads(sent)
            try:
                result = function(*arguments, **named)
            except AbsentValueError as error:
                future.set_exception(pickle.loads(pickle.dumps(error)))
            else:
                future.set_result(result)
        return future


def length(order: tuple[int, SharedValue[bytes]]) -> int:
    """Number of the order plus the length of its value."""
    return order[0] + len(order[1].value)


def results(executor: Executor, value: SharedValue[bytes], count: int) -> list[int]:
    """Results of orders with a value."""
    orders = [(number, value) for number in range(count)]
    return [found[0] for _, found in carry_out(executor, length, orders, Budget())]


def test_a_value_is_sent_with_the_first_tasks_alone() -> None:
    processes = FakeProcesses(2)
    value = SharedValue("a", LARGE)

    found = results(processes, value, 50)

    # Several tasks are under way before the first of them says that the value is absent.
    large = sum(size > len(LARGE) for size in processes.sizes)
    assert found == [len(LARGE) + number for number in range(50)]
    assert large <= 2 * TASKS_PER_WORKER
    assert sum(size < 1000 for size in processes.sizes) == len(processes.sizes) - large


def test_a_forgotten_value_is_sent_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_value, "KEPT_BYTES", len(LARGE))
    processes = FakeProcesses(1)
    first, second = (SharedValue(name, LARGE, len(LARGE)) for name in ("first", "second"))

    for value in (first, second, first):
        processes.sizes.clear()
        assert results(processes, value, 2) == [len(LARGE), len(LARGE) + 1]
        assert max(processes.sizes) > len(LARGE)


def test_an_equal_value_that_is_deleted_does_not_take_the_first_one_with_it() -> None:
    first = SharedValue.of("twice", LARGE)
    second = SharedValue.of("twice", bytes(LARGE))
    del second
    gc.collect()

    assert results(FakeProcesses(1), first, 2) == [len(LARGE), len(LARGE) + 1]


def test_a_value_that_nobody_has_any_more_is_an_error() -> None:
    order = pickle.dumps((0, SharedValue("gone", LARGE)))

    with pytest.raises(AbsentValueError, match="gone"):
        list(carry_out(FakeProcesses(1), length, [pickle.loads(order)], Budget()))


def test_the_process_that_made_a_value_needs_no_copy() -> None:
    value = SharedValue("own", LARGE)

    assert pickle.loads(pickle.dumps(value)) is value
