"""Independent orders on workers or in this process: what is lost is done again."""

from __future__ import annotations

import time
import uuid
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, wait
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any, Generic, TypeVar

from mjfim.errors import ExperimentError
from mjfim.parallel.budget import Budget, StopToken, hurried
from mjfim.parallel.pool import one_blas_thread, pool_stop_token
from mjfim.parallel.shared_value import KeptPerThread, SentValue, attempt, owned_value
from mjfim.parallel.workers import ExecutorLike, Workers, is_loss, is_refused_by_pickle

T = TypeVar("T")
Object = TypeVar("Object")
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


# Number of an order, and its result; this is empty where the worker was lost each time.
Outcome = tuple[int, tuple[T, ...]]


class _Dispatch(Generic[Order, T]):
    """Orders under way on workers. An order whose worker was killed is carried out again."""

    def __init__(
        self,
        workers: Workers,
        function: Callable[[Order], T],
        orders: Iterable[Order],
        budget: Budget,
    ) -> None:
        self._workers = workers
        self._function = function
        self._budget = budget
        # Orders that are not carried out yet, by their numbers; they may be large.
        self._orders = dict(enumerate(orders))
        self._waiting = deque(self._orders)
        self._losses = [0] * len(self._orders)
        # Values that the worker of an order lacked, by the number of the order.
        self._values: dict[int, dict[str, SentValue]] = defaultdict(dict)
        self._running: dict[Future[Any], int] = {}
        self._ended: SimpleQueue[Future[Any]] = SimpleQueue()

    def withdraw(self) -> None:
        """Forget the orders that have not begun."""
        self._waiting.clear()

        # A Dask cluster would cancel tasks that run, too. Those that were submitted first do.
        kept = self._workers.count if self._workers.is_cluster else 0
        for future in list(self._running)[kept:]:
            if future.cancel():
                del self._running[future]

    def arrivals(self) -> Iterator[Outcome[T]]:
        """Carry out all orders, and yield outcomes in the order in which they arrive.

        After a request to stop, what the running tasks have found by then follows. The same holds
        long after the end of the budget's time, where a task may hang.
        """
        try:
            while not self._budget.stop.requested and not self._is_overdue():
                while self._waiting and len(self._running) < self._workers.window:
                    self._submit(self._waiting.popleft())
                if not self._running:
                    return

                outcome = self._next_outcome()
                if outcome is not None:
                    self._workers.has_answered = True
                    yield outcome
            yield from self._collected()
        finally:
            # If the caller ended the iteration or an order failed, the others are stopped.
            if self._running:
                self._collected()

    def _submit(self, index: int) -> None:
        """Submit the order of a number with the values that a worker did not have."""
        future: Future[Any]
        try:
            task = partial(attempt, self._function, self._values[index])
            future = self._workers.submit(task, self._orders[index])
        except Exception as error:
            # Some executors, such as Dask, pickle a task while it is submitted; in one whose
            # processes have ended, it is lost at once.
            if not is_loss(error) and not is_refused_by_pickle(error):
                raise
            future = Future()
            future.set_exception(error)
        self._running[future] = index
        future.add_done_callback(self._ended.put)

    def _next_outcome(self) -> Outcome[T] | None:
        """Wait for a task for a while; None where none has ended, or where it is done again."""
        try:
            future = self._ended.get(timeout=POLL_INTERVAL)
        except Empty:
            return None

        # A task that was withdrawn has no outcome.
        index = self._running.pop(future, None)
        if index is None:
            return None

        error = None if future.cancelled() else future.exception()
        if future.cancelled() or is_loss(error):
            self._losses[index] += 1
            if self._losses[index] == MAX_LOSSES:
                return index, ()
        elif is_refused_by_pickle(error):
            raise ExperimentError(
                f"executor: the work cannot be sent to other processes ({error}). Functions, such "
                "as parameters that are Python functions, must be stated at the top of a module "
                "that the workers can import; lambdas and functions inside functions can be used "
                "without an executor, or with threads"
            ) from error
        else:
            found, absent = future.result()
            if found:
                del self._values[index]
                del self._orders[index]
                return index, found
            self._values[index].update({digest: owned_value(digest) for digest in absent})
        self._waiting.appendleft(index)
        return None

    def _is_overdue(self) -> bool:
        """Check whether the time has been over for so long that nobody waits for what runs."""
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

    def _collected(self) -> list[Outcome[T]]:
        """Stop all tasks, and collect what has ended within `GRACE`, or was offered until then."""
        self.withdraw()
        pool = self._workers.pool
        if pool is not None and self._running:
            pool.stop()

        deadline = time.monotonic() + GRACE
        _, left = wait(self._running, timeout=0.0)
        while left and time.monotonic() < deadline and not hurried():
            _, left = wait(self._running, timeout=min(POLL_INTERVAL, GRACE))

        found: list[Outcome[T]] = []
        for future, index in self._running.items():
            if future in left:
                # Nobody waits any longer for a task that does not look at the request.
                future.cancel()
                results = () if pool is None else pool.offered(future)
            elif future.cancelled() or future.exception() is not None:
                continue
            else:
                results, _ = future.result()
            found += [(index, (result,)) for result in results]

        if pool is not None:
            if left:
                pool.end_running()
            else:
                pool.resume()
        self._running.clear()
        return found


def carry_out(
    executor: ExecutorLike,
    function: Callable[[Order], T],
    orders: Iterable[Order],
    budget: Budget,
) -> Iterator[Outcome[T]]:
    """Carry out independent orders on the workers of an executor.

    When the budget is used up, orders that are not begun are left out, except for the first one.
    After a request to stop, what the running tasks have found until then is yielded last.

    Yields:
        Number and result of each order, in their order; some after a request to stop may be
        missing. The result is in a tuple, which is empty where its worker was lost each time.

    Raises:
        ExperimentError: An order cannot be sent, or a cluster had no workers at all.
    """
    dispatch = _Dispatch(Workers.of(executor), function, orders, budget)
    early = {}
    following = 0
    for index, found in dispatch.arrivals():
        early[index] = found
        while following in early:
            yield following, early.pop(following)
            following += 1

        # Without the first order there might be no result at all.
        if following and budget.exhausted is not None:
            dispatch.withdraw()

    # What was stopped or left out before them has no outcome.
    yield from sorted(early.items(), key=lambda outcome: outcome[0])


def results(
    function: Callable[[Order], T],
    orders: Iterable[Order],
    workers: ExecutorLike | None,
    budget: Budget,
    here: Callable[[Order], T] | None = None,
) -> Iterator[T]:
    """Carry out independent orders on workers or, where there are none, in this process.

    Args:
        function: Carries out an order on a worker; both can be pickled.
        orders: The orders. In this process, each is asked for after the one before is done.
        workers: The workers, or their executor; None: this process.
        budget: When it is used up, orders that are not begun are left out, except for the first.
        here: Carries out an order in this process, also one whose worker was lost each time;
            default: `function`.

    Yields:
        Results in the order of the orders; after a request to stop, some may be missing.

    Raises:
        ExperimentError: An order cannot be sent, or a cluster had no workers at all.
    """
    here = here or function
    if workers is None:
        for order in orders:
            yield here(order)
            if budget.exhausted is not None:
                return
        return

    orders = list(orders)
    for index, found in carry_out(workers, function, orders, budget):
        yield found[0] if found else here(orders[index])


# The latest objects of a worker, by the key of their study.
_made: KeptPerThread[Any] = KeptPerThread(2)


def results_on(
    own: Object,
    make: Callable[[int], Callable[[], Object]],
    work: Callable[[Object, Order, StopToken], T],
    orders: Sequence[Order],
    executor: ExecutorLike | None,
    budget: Budget,
) -> Iterator[T]:
    """Do independent work on one object, which a worker makes once; see `results`.

    Args:
        own: The object of this process.
        make: Returns what makes the object in a worker, and can be pickled; it gets the number of
            threads of the worker.
        work: Does an order on the object, with a token that may ask it to stop.
        orders: The orders.
        executor: The workers; None for this process.
        budget: As for `results`; its token may ask the work of this process to stop.
    """

    def here(order: Order) -> T:
        """Do an order in this process."""
        return work(own, order, budget.stop)

    there = here
    workers = Workers.of_any(executor)
    if workers is not None:
        made = make(workers.threads_for(len(orders)))
        there = partial(_in_worker, uuid.uuid4().hex, made, work)
    return results(there, orders, workers, budget, here)


@one_blas_thread()
def _in_worker(
    key: str,
    make: Callable[[], Object],
    work: Callable[[Object, Order, StopToken], T],
    order: Order,
) -> T:
    """Do one order in a worker."""
    return work(_made.get(key, make), order, pool_stop_token())
