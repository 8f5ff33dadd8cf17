"""Slices of an optimisation under hard limits, which an executor runs one after the other.

A worker runs a part of an optimisation and returns its state; the next part may run on another
worker. So its progress is seen while it runs, and a request to stop or a worker that is killed
costs at most one part.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

from mjfim.arrays import Array
from mjfim.excitation.barrier_state import BarrierState
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.short_steps import ShortSteps
from mjfim.records.design import Status

# Length of a slice [s]. A slice ends after the iterate that is then running, well before the time
# is over for which a request to stop waits, and is long enough that its state costs little.
SLICE_SECONDS = 1.5


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
class SearchState:
    """State of a search at an iterate. It can be pickled.

    Attributes:
        barrier: State of the interior-point method.
        best_of_stages: (N, nu) best feasible control of each barrier weight mu so far.
        short_steps: Recognises a descent that is held up.
    """

    barrier: BarrierState
    best_of_stages: dict[float, Array]
    short_steps: ShortSteps


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchSlice:
    """What a slice of a search returns.

    Attributes:
        result: The result so far. That of a search that has not ended counts where nothing
            follows, such as after a request to stop.
        state: State from which the search goes on; None where it has ended.
    """

    result: RunResult
    state: SearchState | None = None

    @classmethod
    def unfinished(cls, result: RunResult, state: SearchState) -> SearchSlice:
        """Describe a search that goes on later.

        Args:
            result: The result so far.
            state: State from which it goes on.
        """
        earlier = tuple(state.best_of_stages.values())[:-1]
        so_far = replace(result, status=Status.INTERRUPTED, earlier=earlier)
        return cls(result=so_far, state=state)
