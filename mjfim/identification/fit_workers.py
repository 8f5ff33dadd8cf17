"""Workers of an executor that do parts of a fit: batches of segments, or whole searches.

A worker receives a problem once, and then orders that name a work on it. Works are done alike in
every process, so that a fit on workers finds the estimate of one process to the last digit.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from mjfim.experiment.system import System, SystemOrder, order_of
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.parallel import (
    ExecutorLike,
    Workers,
    carry_out,
    one_blas_thread,
    pool_stop_token,
    results,
)
from mjfim.parallel.budget import Budget, StopToken, hurried
from mjfim.parallel.shared_value import KeptPerThread, SharedValue, require_values

T = TypeVar("T")

# A `FitProblem`, which holds its workers.
Problem = Any

# A task on a whole problem, which ends early when the budget is exhausted.
ProblemWork = Callable[[Problem, Budget], T]

# Size of a recording above which workers of this computer share its arrays as files [bytes].
MIN_FILE_BYTES = 2**20

# Arrays of a recording, each of which is a file. Windows removes no file that is mapped.
ARRAYS = ("t", "y", "ctrl")
MAP_MODE: Literal["r"] | None = None if os.name == "nt" else "r"

# Number of problems that a worker keeps: a fit has variants with other noise or other segments.
KEPT_PROBLEMS = 8


# A recording, and the folder of its arrays where these are files.
_SharedRecording = tuple[AlignedRecording, Path | None]

# A problem of this process alone in parts, each of which is sent once: the rest, its system and its
# recordings.
_SharedProblem = tuple[Problem, SharedValue[SystemOrder], tuple[SharedValue[_SharedRecording], ...]]

# A problem and a work on it.
_Order = tuple[SharedValue[_SharedProblem], ProblemWork[T]]

# The latest systems and problems of a worker.
_systems: KeptPerThread[System] = KeptPerThread(KEPT_PROBLEMS)
_problems: KeptPerThread[Problem] = KeptPerThread(KEPT_PROBLEMS)


@one_blas_thread()
def _carry_out(order: _Order[T]) -> tuple[T, int]:
    """Do a work in a worker, and count its engine steps."""
    shared, work = order
    problem = _problems.get(shared.digest, lambda: _made(*shared.value))
    before = problem.system.plant.engine_steps
    result = work(problem, Budget(stop=pool_stop_token()))
    return result, problem.system.plant.engine_steps - before


def _made(
    problem: Problem,
    system: SharedValue[SystemOrder],
    recordings: tuple[SharedValue[_SharedRecording], ...],
) -> Problem:
    """The problem in a worker; arrays of recordings are read from files when they are used."""
    require_values([system, *recordings])
    found = []
    for recording, folder in (each.value for each in recordings):
        arrays: dict[str, Any] = {
            name: np.load(f"{folder}/{name}.npy", MAP_MODE, allow_pickle=False).view(np.ndarray)
            for name in (ARRAYS if folder else ())
        }
        found.append(replace(recording, **arrays) if arrays else recording)
    made = _systems.get(system.digest, lambda: system.value())
    return _with_parts(problem, made, tuple(found))


def _with_parts(
    problem: Problem, system: System | None, recordings: tuple[AlignedRecording, ...]
) -> Problem:
    """A problem of this process alone, with another system and other recordings."""
    return replace(problem, system=system, recordings=recordings, workers=None)


class FitWorkers:
    """Workers that do parts of a fit.

    Args:
        executor: Executor that carries out the tasks.
    """

    def __init__(self, executor: ExecutorLike) -> None:
        self._executor = Workers.of(executor)

        # Values of problems, systems and recordings by the number of threads. Variants of a problem
        # share systems and recordings.
        self._known: weakref.WeakKeyDictionary[Any, dict[int, SharedValue[Any]]]
        self._known = weakref.WeakKeyDictionary()

    @property
    def count(self) -> int:
        """Number of workers."""
        return self._executor.count

    def of_batches(self, problem: Problem, works: Sequence[ProblemWork[T]]) -> Sequence[T]:
        """Do works that are one pass over the data.

        A request to stop takes effect after the pass. A second Ctrl-C ends what runs on workers,
        and this process does the rest, as it does the works of lost workers.
        """
        if len(works) < 2:
            return [work(problem, Budget()) for work in works]
        orders = self._orders(problem, works)
        budget = Budget(stop=StopToken(also=hurried))
        found = {
            index: self._counted(problem, result)
            for index, results in carry_out(self._executor, _carry_out, orders, budget)
            for result in results
        }
        alone = replace(problem, workers=None)
        return [
            found[index] if index in found else work(alone, Budget())
            for index, work in enumerate(works)
        ]

    def of_whole(
        self, problem: Problem, works: Sequence[ProblemWork[T]], budget: Budget
    ) -> Iterator[T]:
        """Do independent works, each in one worker.

        Returns:
            The results in their order; those that a request to stop has prevented are missing.
        """
        alone = replace(problem, workers=None)

        def here(order: _Order[T]) -> tuple[T, int]:
            """Do the work of a lost worker; the simulator counts its steps."""
            return order[1](alone, budget), 0

        orders = self._orders(problem, works)
        for found in results(_carry_out, orders, self._executor, budget, here):
            yield self._counted(problem, found)

    def _orders(self, problem: Problem, works: Sequence[ProblemWork[T]]) -> list[_Order[T]]:
        """Orders for works on a problem."""
        shared = self._shared(problem, self._executor.threads_for(len(works)))
        return [(shared, work) for work in works]

    def _counted(self, problem: Problem, found: tuple[T, int]) -> T:
        """A result of a worker, whose engine steps are added to those of the problem."""
        result, steps = found
        problem.system.plant.simulator.add_steps(steps)
        return result

    def _shared(self, problem: Problem, threads: int) -> SharedValue[_SharedProblem]:
        """A problem as workers with some number of threads receive it."""

        def parts() -> tuple[_SharedProblem, int]:
            """The problem in parts, and the size of what only this variant has."""
            made = problem.system
            system = self._once(made, threads, lambda: (order_of(made, threads), 0))
            recordings = tuple(
                self._once(each, 0, partial(self._sent, each)) for each in problem.recordings
            )
            size = sum(mask.nbytes for mask in problem.masks)
            return (_with_parts(problem, None, ()), system, recordings), size

        return self._once(problem, threads, parts)

    def _once(self, key: Any, threads: int, make: Callable[[], tuple[T, int]]) -> SharedValue[T]:
        """The value of an object for workers with some number of threads, which is sent once.

        Args:
            key: The object.
            threads: The number of threads.
            make: Returns the value and its size [bytes].
        """
        known = self._known.setdefault(key, {})
        if threads not in known:
            known[threads] = SharedValue(uuid.uuid4().hex, *make())
        return known[threads]

    def _sent(self, recording: AlignedRecording) -> tuple[_SharedRecording, int]:
        """The part of a recording that is sent, and its size; a large one is a file here.

        The files are removed with this object.
        """
        is_file = self._executor.is_local and not self._executor.shares_memory
        if is_file and recording.size > MIN_FILE_BYTES:
            # Without room on the disk, the recording is sent.
            with suppress(OSError):
                folder = Path(tempfile.mkdtemp(prefix="mjfim-recordings-"))
                weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
                for name in ARRAYS:
                    array = getattr(recording, name)
                    np.save(folder / f"{name}.npy", array, allow_pickle=False)
                nothing = np.zeros(0)
                return (replace(recording, t=nothing, y=nothing, ctrl=nothing), folder), 0
        return (recording, None), recording.size
