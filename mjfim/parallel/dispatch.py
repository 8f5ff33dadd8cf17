"""Orders under way on workers: lost ones are done again, and a request to stop takes effect."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, wait
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

from mjfim.budget import Budget
from mjfim.errors import ExperimentError, MjfimError
from mjfim.interruption import hurried
from mjfim.parallel.losses import is_loss, is_refused_by_pickle, is_shared_loss
from mjfim.parallel.shared_value import AbsentValue, SentValue, attempt, owned_value
from mjfim.parallel.workers import Workers

T = TypeVar("T")
Order = TypeVar("Order")

# Time for which running tasks are waited for after a request to stop [s]. The tasks of a pool check
# the request after each iterate; those of other executors end after their slice. A second Ctrl-C
# ends the waiting.
GRACE = 4.0

# Time after the end of the budget at which running tasks are given up [s], and the same as a share
# of the budget's time; the longer one counts. A task may end long after the time, because a single
# iterate may take long, so that this is for tasks that hang.
LONGEST_OVERTIME = 30.0
OVERTIME_SHARE = 0.5

# Period at which the stop token is checked while tasks run [s].
POLL_INTERVAL = 0.2

# An order whose worker was lost this many times is given up.
MAX_LOSSES = 3


class LostWorkError(MjfimError):
    """An order has no result, because its worker was lost each time that it was begun."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome(Generic[T]):
    """Result or loss of an order.

    Attributes:
        index: Number of the order.
        found: The result; empty where the order is lost.
        loss: Why there is no result, as a sentence; empty where there is one.
    """

    index: int
    found: tuple[T, ...] = ()
    loss: str = ""

    @property
    def is_lost(self) -> bool:
        """True where there is no result."""
        return not self.found

    @property
    def result(self) -> T:
        """The result.

        Raises:
            LostWorkError: The order is lost.
        """
        if self.is_lost:
            raise LostWorkError(self.loss)
        return self.found[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class NumberedOrder(Generic[Order]):
    """An order with its number.

    Attributes:
        index: Number under which its outcome is reported.
        order: The order.
    """

    index: int
    order: Order


@dataclass(kw_only=True, eq=False)
class _Work(Generic[Order]):
    """An order that has no result yet.

    Attributes:
        index: Number of the order.
        order: The order.
        losses: How often its worker was lost.
        needs_isolation: True where it may be the cause of the losses, and where others are lost
            together with it.
        values: Shared values that a worker did not have, by their hash.
    """

    index: int
    order: Order
    losses: int = 0
    needs_isolation: bool = False
    values: dict[str, SentValue] = field(default_factory=dict)


class Dispatch(Generic[Order, T]):
    """Orders under way on workers; an order can be added at any time.

    A task whose worker is killed is submitted again. Where all tasks of an executor are lost
    together, it is not known which of them was the cause: an order that is lost for the second time
    is therefore done while nothing else runs.

    Args:
        workers: The workers.
        function: Carries out an order; both can be pickled, and the result depends on the order
            alone.
        budget: Its token ends the work early; see `arrivals` for its time.
        source: Asked for a further order whenever there is a worker for it and none waits. It
            returns None where there is none at present.
    """

    def __init__(
        self,
        workers: Workers,
        function: Callable[[Order], T],
        budget: Budget,
        source: Callable[[], NumberedOrder[Order] | None] | None = None,
    ) -> None:
        self._source = source
        self._workers = workers
        self._function = function
        self._budget = budget
        self._waiting: deque[_Work[Order]] = deque()
        self._running: dict[Future[T | AbsentValue], _Work[Order]] = {}
        self._ended: SimpleQueue[Future[T | AbsentValue]] = SimpleQueue()

    def add(self, index: int, order: Order, *, next_one: bool = False) -> None:
        """Add an order.

        Args:
            index: Number under which its outcome is reported.
            order: The order.
            next_one: Do it before all others that are not begun.
        """
        work = _Work(index=index, order=order)
        if next_one:
            self._waiting.appendleft(work)
        else:
            self._waiting.append(work)

    def withdraw(self) -> None:
        """Forget the orders that have not begun."""
        self._waiting.clear()
        for future in [each for each in self._running if self._may_cancel(each)]:
            if future.cancel():
                del self._running[future]

    def arrivals(self) -> Iterator[Outcome[T]]:
        """Carry out all orders, also those that are added meanwhile.

        After a request to stop nothing more is begun, and what has ended within `GRACE` seconds is
        reported. If the caller ends the iteration, what runs is stopped. So is what still runs long
        after the time of the budget is over, as a task that hangs or a cluster that has gone, if
        the workers have ended any task before, of this or of earlier work.

        Yields:
            The outcome of every order, in the order of arrival.

        Raises:
            Exception: The error of an order that failed; the others are stopped.
            ExperimentError: An order or its function cannot be sent to the workers, or a cluster
                had no workers until its time was over.
        """
        try:
            while not self._budget.stop.requested:
                self._fill()
                if not self._running:
                    return

                outcome = self._next_outcome()
                if outcome is not None:
                    self._workers.has_answered = True
                    yield outcome
                elif self._is_overdue():
                    self._abandon()
                    return

            yield from self._collected()
        finally:
            # If the caller ended the iteration or an order failed, the others are stopped.
            if self._running:
                self._collected()

    def _fill(self) -> None:
        """Submit orders while there are workers for them."""
        while len(self._running) < self._workers.window and self._has_waiting():
            if self._running and (self._waiting[0].needs_isolation or self._is_isolated):
                return

            self._submit(self._waiting.popleft())

    @property
    def _is_isolated(self) -> bool:
        """True where an order runs that has to run alone."""
        return len(self._running) == 1 and next(iter(self._running.values())).needs_isolation

    def _has_waiting(self) -> bool:
        """Check whether an order waits, and ask the source for one where none does."""
        if not self._waiting and self._source is not None:
            further = self._source()
            if further is not None:
                self.add(further.index, further.order)
        return bool(self._waiting)

    def _submit(self, work: _Work[Order]) -> None:
        """Submit an order; in an executor whose processes have ended, it is lost at once."""
        try:
            future = self._submitted(work)
        except BrokenExecutor as error:
            future = Future()
            future.set_exception(error)
        except Exception as error:
            # Some executors, such as Dask, pickle a task while it is submitted.
            if not is_refused_by_pickle(error):
                raise
            future = Future()
            future.set_exception(error)

        self._running[future] = work
        future.add_done_callback(self._ended.put)

    def _submitted(self, work: _Work[Order]) -> Future[T | AbsentValue]:
        """Submit an order, together with the values that a worker did not have."""
        carry_out = partial(attempt, self._function, work.values)
        return self._workers.submit(carry_out, work.order)

    def _next_outcome(self) -> Outcome[T] | None:
        """Wait for a task for a while; None where none has ended, or where it is done again."""
        try:
            future = self._ended.get(timeout=POLL_INTERVAL)
        except Empty:
            return None

        # A task that was withdrawn has no outcome.
        work = self._running.pop(future, None)
        if work is None:
            return None
        if _is_lost(future):
            return self._done_again(work, is_shared=_is_shared(future))

        # An order that needs values is submitted again with them.
        result = _result_of(future)
        self._workers.has_begun = True
        if isinstance(result, AbsentValue):
            work.values.update({digest: owned_value(digest) for digest in result.digests})
            self._waiting.appendleft(work)
            return None
        return Outcome(index=work.index, found=(result,))

    def _done_again(self, work: _Work[Order], *, is_shared: bool) -> Outcome[T] | None:
        """Put an order that was lost among the waiting ones, or report it after the last loss."""
        work.losses += 1
        work.needs_isolation = is_shared and work.losses == MAX_LOSSES - 1
        if work.losses < MAX_LOSSES:
            self._waiting.appendleft(work)
            return None

        sentence = (
            f"the worker was lost {work.losses} times while it did this work "
            f"({self._workers.probable_fault}), so this work is left out"
        )
        return Outcome(index=work.index, loss=sentence)

    # ---- the end before all orders are carried out

    def _is_overdue(self) -> bool:
        """Check whether the time has been over for so long that nobody waits for what runs.

        Raises:
            ExperimentError: A cluster had no workers until the time was over.
        """
        budget = self._budget
        limit = budget.deadline - budget.begun
        if budget.seconds_used - limit <= max(LONGEST_OVERTIME, OVERTIME_SHARE * limit):
            return False
        if not self._workers.has_answered and self._workers.is_empty:
            raise ExperimentError(
                "executor: the cluster had no workers until the time was over; start workers, and "
                "wait for them before, as with client.wait_for_workers(1)"
            )
        return self._workers.has_answered

    def _abandon(self) -> None:
        """End all tasks at once; what they have found is lost."""
        self.withdraw()
        for future in self._running:
            future.cancel()
        if self._running and self._workers.pool is not None:
            self._workers.pool.end_running()
        self._running.clear()

    def _collected(self) -> list[Outcome[T]]:
        """Stop all tasks, and collect what has ended within `GRACE`, or was offered until then."""
        self.withdraw()
        pool = self._workers.pool
        if pool is not None and self._running:
            pool.stop()
        left = _wait_for_all(list(self._running))

        found: list[Outcome[T]] = []
        for future, work in self._running.items():
            if future in left:
                offered = [] if pool is None else pool.offered(future)
                found += _outcomes(work.index, offered)
            elif not future.cancelled() and future.exception() is None:
                found += _outcomes(work.index, [future.result()])

        # Nobody waits any longer for a task that does not look at the request.
        for future in left:
            future.cancel()
        if pool is not None and left:
            pool.end_running()
        elif pool is not None:
            pool.resume()

        self._running.clear()
        return found

    def _may_cancel(self, future: Future[T | AbsentValue]) -> bool:
        """Check whether a task can be cancelled without the loss of work that is done already.

        Dask does not say which tasks are running: they are those that were submitted first.
        """
        if not self._workers.is_cluster:
            return True
        first = list(self._running)[: self._workers.count]
        return future not in first


def _outcomes(index: int, results: Sequence[T | AbsentValue]) -> list[Outcome[T]]:
    """Outcome of an order; none where its worker did not have a value that it needs."""
    return [
        Outcome(index=index, found=(result,))
        for result in results
        if not isinstance(result, AbsentValue)
    ]


def _is_lost(future: Future[T]) -> bool:
    """Return whether a task that has ended was lost with its worker."""
    return future.cancelled() or is_loss(future.exception())


def _is_shared(future: Future[T]) -> bool:
    """Return whether a lost task was lost together with all others of its executor."""
    return not future.cancelled() and is_shared_loss(future.exception())


def _result_of(future: Future[T]) -> T:
    """Result of a task that has ended.

    Raises:
        Exception: The error of the task.
        ExperimentError: The task could not be sent to a worker.
    """
    error = future.exception()
    if is_refused_by_pickle(error):
        raise ExperimentError(
            f"executor: the work cannot be sent to other processes ({error}). Functions, such as "
            "parameters that are Python functions, must be stated at the top of a module that the "
            "workers can import; lambdas and functions inside functions can be used without an "
            "executor, or with threads"
        ) from error

    return future.result()


def _wait_for_all(futures: list[Future[T]]) -> set[Future[T]]:
    """Wait for tasks until `GRACE` is over, or until the user presses Ctrl-C a second time.

    Returns:
        The tasks that have not ended.
    """
    deadline = time.monotonic() + GRACE
    _, left = wait(futures, timeout=0.0)
    while left and time.monotonic() < deadline and not hurried():
        _, left = wait(futures, timeout=min(POLL_INTERVAL, GRACE))

    return left
