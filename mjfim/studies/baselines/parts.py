"""Parts of a baseline side by side on workers."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.budget import Budget, StopToken
from mjfim.parallel import Dispatch, Workers
from mjfim.studies.baselines.evaluator import BaselineSearch, SearchResult
from mjfim.studies.baselines.methods import BaselineSlice, SliceOfBaseline, run_slice

# Length of a slice on workers that do not see a request to stop [s]. It is shorter than the time
# for which such a request waits. A series loses the memory of its optimiser at the end of a slice,
# so that slices are not shorter.
SLICE_SECONDS = 3.0


class PartsOfBaseline:
    """Parts of a baseline, of which each has a slice under way.

    The workers of a pool see a request to stop, so that they search without slices. On others, such
    a request costs at most one slice.

    Args:
        workers: The workers.
        parts: The search of each part.
        stop: Ends the searches early.
    """

    def __init__(self, workers: Workers, parts: Sequence[BaselineSearch], stop: StopToken) -> None:
        seconds = np.inf if workers.pool is not None else SLICE_SECONDS
        key = uuid.uuid4().hex
        self._orders = [BaselineSlice(key=key, search=part, seconds=seconds) for part in parts]
        self._stop = stop
        self._dispatch = Dispatch[BaselineSlice, SliceOfBaseline](
            workers, run_slice, Budget(stop=stop)
        )
        self._latest: dict[int, SearchResult] = {}

    def results(self) -> list[SearchResult]:
        """Search all parts.

        Returns:
            The best control of every part that has any result.
        """
        for index, order in enumerate(self._orders):
            self._dispatch.add(index, order)

        for outcome in self._dispatch.arrivals():
            index = outcome.index

            # What was lost with its worker each time goes on in this process.
            lost = outcome.is_lost
            found = run_slice(self._orders[index], self._stop) if lost else outcome.result
            self._latest[index] = found.result
            if found.state is not None and not self._stop.requested:
                self._orders[index] = replace(self._orders[index], before=found.state)
                self._dispatch.add(index, self._orders[index], next_one=True)
        return [self._latest[index] for index in sorted(self._latest)]
