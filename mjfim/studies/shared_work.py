"""Independent work on one object, which a worker makes once."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from mjfim.parallel import (
    ExecutorLike,
    Workers,
    one_blas_thread,
    pool_stop_token,
    results_or_here,
)
from mjfim.parallel.budget import Budget, StopToken
from mjfim.parallel.kept import KeptPerThread

T = TypeVar("T")
Object = TypeVar("Object")
Order = TypeVar("Order")

# Does one order on the object, with a token that may ask it to stop.
Work = Callable[[Object, Order, StopToken], T]

# The latest objects of a worker, by the key of their study.
_made: KeptPerThread[Any] = KeptPerThread(2)


@dataclass(frozen=True, kw_only=True)
class SharedWork(Generic[Object]):
    """An object on which orders are done, in this process or on workers.

    Attributes:
        own: The object of this process.
        make: Returns what makes the object in a worker, and can be pickled; it gets the number of
            threads of the worker.
        executor: The workers; None for this process.
        stop: Ends the work early.
    """

    own: Object
    make: Callable[[int], Callable[[], Object]]
    executor: ExecutorLike | None
    stop: StopToken

    def results(self, work: Work[Object, Order, T], orders: Sequence[Order]) -> Iterator[T]:
        """Yield the results in the order of the orders; after a request to stop, some may lack."""
        if self.executor is None:
            for order in orders:
                yield work(self.own, order, self.stop)
                if self.stop.requested:
                    return
            return

        workers = Workers.of(self.executor)
        make = self.make(workers.threads_for(len(orders)))
        there = partial(_in_worker, uuid.uuid4().hex, make, work)

        def here(order: Order) -> T:
            """Do the order of a lost worker."""
            return work(self.own, order, self.stop)

        yield from results_or_here(workers, there, orders, Budget(stop=self.stop), here)


@one_blas_thread()
def _in_worker(
    key: str, make: Callable[[], Object], work: Work[Object, Order, T], order: Order
) -> T:
    """Do one order in a worker."""
    return work(_made.get(key, make), order, pool_stop_token())
