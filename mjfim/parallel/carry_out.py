"""Carries out orders that do not depend on each other, and reports them in their order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from mjfim.budget import Budget
from mjfim.parallel.dispatch import Dispatch, Outcome
from mjfim.parallel.workers import ExecutorLike, Workers

T = TypeVar("T")
Order = TypeVar("Order")


def carry_out(
    executor: ExecutorLike,
    function: Callable[[Order], T],
    orders: Sequence[Order],
    budget: Budget,
    callback: Callable[[Outcome[T]], None] | None = None,
) -> Iterator[Outcome[T]]:
    """Carry out independent orders on the workers of an executor.

    The outcomes do not depend on the number of workers, nor on which of them are killed meanwhile.
    A lost order is done again until it has been lost `dispatch.MAX_LOSSES` times, and a broken pool
    of processes is made anew. An order must not depend on the others, nor on anything that changes.

    A request to stop takes effect within `dispatch.GRACE` seconds on every executor. The tasks of a
    `Pool` see the request (`pool_stop_token`). They return what they have found so far; if they do
    not return in time, what they have offered counts (`offer_result`). The tasks of other executors
    do not see the request. So an order should be small enough to end within that time.

    Args:
        executor: `Workers`, or an executor that they can wrap.
        function: Carries out an order; it stands at the top of a module.
        orders: The orders; they and the results can be pickled.
        budget: When it is exhausted, orders that have not begun are left out, except the first
            one. Its token ends the work early.
        callback: Called with each outcome as soon as it is there, to show progress.

    Yields:
        The outcome of every order that was carried out, in the given order: without gaps, except
        after a request to stop or the end of the budget. That of a lost one has a sentence in place
        of a result; the caller decides whether that is an error.

    Raises:
        Exception: The error of an order that failed.
        ExperimentError: The orders or the function cannot be sent to the workers.
    """
    dispatch = Dispatch[Order, T](Workers.of(executor), function, budget)
    for index, order in enumerate(orders):
        dispatch.add(index, order)

    early: dict[int, Outcome[T]] = {}
    following = 0
    for outcome in dispatch.arrivals():
        early[outcome.index] = outcome
        if callback is not None:
            callback(outcome)

        while following in early:
            yield early.pop(following)
            following += 1

        # Without the first order there might be no result at all.
        if following and budget.exhausted is not None:
            dispatch.withdraw()

    # What was stopped or left out before them has no outcome.
    yield from (early[index] for index in sorted(early))


def results_or_here(
    executor: ExecutorLike,
    function: Callable[[Order], T],
    orders: Sequence[Order],
    budget: Budget,
    here: Callable[[Order], T],
) -> Iterator[T]:
    """Carry out orders as `carry_out` does, and lost ones in this process.

    Args:
        executor: As for `carry_out`.
        function: As for `carry_out`.
        orders: As for `carry_out`.
        budget: As for `carry_out`.
        here: Carries out an order in this process, and stops at the request of the budget's token.

    Yields:
        The result of every order that was not left out, in the given order.

    Raises:
        Exception: The error of an order that failed.
    """
    for outcome in carry_out(executor, function, orders, budget):
        yield here(orders[outcome.index]) if outcome.is_lost else outcome.result
