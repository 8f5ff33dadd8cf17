"""Slices of an optimisation from one initial control, which an executor runs one after the other.

A worker runs a part of an optimisation and returns its state; the next part may run on another
worker. So its progress is seen while it runs, and a request to stop or a worker that is killed
costs at most one part.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from mjfim.budget import Budget, StopToken
from mjfim.excitation.run_result import RunResult
from mjfim.parallel import pool_stop_token
from mjfim.parallel.sealed import opened, sealed
from mjfim.records.design import Status

# State from which a search goes on.
S = TypeVar("S")

# Length of a slice [s]. A slice ends after the iterate that is then running, well before the time
# is over for which a request to stop waits, and is long enough that its state costs little.
SLICE_SECONDS = 1.5

# Largest number of slices that the caller takes and sends on per second. Each of them costs it some
# milliseconds, so that with many workers the slices have to be longer: 5 s for 256 workers.
MOST_SLICES_PER_SECOND = 50.0


def slice_seconds(searches: int) -> float:
    """Length of a slice, such that the caller keeps up with all workers [s].

    Args:
        searches: Number of searches that run side by side.
    """
    return max(SLICE_SECONDS, searches / MOST_SLICES_PER_SECOND)


@dataclass(frozen=True, kw_only=True)
class SliceLength:
    """When a slice ends: at the first iterate with a state after any of these limits.

    Attributes:
        seconds: Time of the slice [s].
        iterations: Number of its iterates.
        begun: Time at which it begins, as `time.monotonic` counts [s].
    """

    seconds: float = math.inf
    iterations: float = math.inf
    begun: float = field(default_factory=time.monotonic)

    def is_over(self, iterations: int) -> bool:
        """Check whether the slice is over after a number of iterates."""
        return iterations >= self.iterations or time.monotonic() - self.begun >= self.seconds


@dataclass(frozen=True, kw_only=True, eq=False)
class SealedState(Generic[S]):
    """State of a search as bytes.

    The caller sends it from one worker to the next without reading it, which would take much of
    its time where there are many workers. Whoever opens it gets a copy of its own, so that an order
    that is lost on a thread can be done again from the same state.

    Attributes:
        data: The pickled state.
    """

    data: bytes

    @classmethod
    def of(cls, state: S) -> SealedState[S]:
        """Seal a state.

        Args:
            state: The state, which can be pickled.
        """
        return cls(data=sealed(state))

    def opened(self) -> S:
        """Make a copy of the state, which a search may change."""
        state: S = opened(self.data)
        return state


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchSlice(Generic[S]):
    """Result and state of a search at the end of a slice.

    Attributes:
        result: The result so far. That of a search that has not ended counts where nothing
            follows, such as after a request to stop.
        state: State from which the search goes on; None where it has ended.
        late_status: How the search ends where the time is over before it has ended.
        seconds: Time that the search has taken so far [s].
    """

    result: RunResult
    state: SealedState[S] | None = None
    late_status: Status = Status.MAX_ITERATIONS
    seconds: float = 0.0

    @property
    def late_result(self) -> RunResult:
        """The result, if the search does not go on because its time is over."""
        if self.state is None:
            return self.result
        return replace(self.result, status=self.late_status)


def worker_budget(budget: Budget) -> Budget:
    """Budget of an order on a worker, which a request to stop by the worker's pool ends as well.

    Args:
        budget: Budget of the whole design, as the order states it.
    """
    order_stop, pool_stop = budget.stop, pool_stop_token()
    return budget.with_stop(StopToken(also=lambda: order_stop.requested or pool_stop.requested))


@dataclass(frozen=True, kw_only=True, eq=False)
class SliceOrder(ABC, Generic[S]):
    """Order for a slice of a search, for a worker. It can be pickled.

    Attributes:
        task_key: Text that is equal for searches on the same task, which a worker resolves once.
        seconds: Time of the slice [s].
        iterations: Number of new iterates after which it ends, except where the search begins or
            passes to another level; there it may be a little longer.
        before: The slice before; None for the first one.
    """

    task_key: str
    seconds: float = SLICE_SECONDS
    iterations: float = math.inf
    before: SearchSlice[S] | None = None

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the initial control."""

    @property
    def length(self) -> SliceLength:
        """When the slice ends, if it begins now."""
        return SliceLength(seconds=self.seconds, iterations=self.iterations)
