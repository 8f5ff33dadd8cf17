"""The trials of one trajectory in chunks, in this process or on the workers of an executor.

A chunk is an order: its number of trials, and where its part of the random numbers begins. A worker
makes the system once, and sends back the estimates. They do not depend on the division into chunks.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.experiment.system_order import SystemOrder
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread, pool_stop_token, results_or_here
from mjfim.parallel.kept import KeptPerThread
from mjfim.studies.trials import SharedFit, Trials, estimated, fit_without_noise

# Called with the share of the trials that is done.
Report = Callable[[float], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class TrialSet:
    """Repetitions of one control.

    Attributes:
        system: System whose parameters are estimated.
        ctrl: (N, nu) control [unit of the actuator].
        exact: (n,) whitened measurements without noise.
        jacobian: (n, p) their derivative [1 / theta-unit].
    """

    system: System
    ctrl: Array
    exact: Array
    jacobian: Array

    @classmethod
    def of(cls, system: System, ctrl: Array) -> TrialSet:
        """Simulate the control at the true values.

        Raises:
            SimulationDivergedError: The simulation diverges.
        """
        y, G = exact_outputs(system, ctrl)
        whitened = system.noise.whitened_rows
        return cls(system=system, ctrl=ctrl, exact=whitened(y), jacobian=whitened(G))

    def estimates(
        self, count: int, rng: np.random.Generator, report: Report, budget: Budget
    ) -> Array | None:
        """Estimate the parameters of trials that are stepped together.

        Args:
            count: Number m of trials.
            rng: Random numbers of the noise.
            report: Called with the share that is done.
            budget: Ends the work early.

        Returns:
            (m, p) estimates, NaN where a trial failed; None after a request to stop.
        """
        measured = self.exact + rng.standard_normal((count, len(self.exact)))
        trials = Trials(system=self.system, ctrl=self.ctrl, measured=measured)
        return estimated(trials, self.shared, report, budget)

    @cached_property
    def shared(self) -> SharedFit:
        """Fit of the measurement without noise, made once for all chunks."""
        exact = Trials(system=self.system, ctrl=self.ctrl, measured=self.exact[None])
        return fit_without_noise(exact)


def exact_outputs(system: System, ctrl: Array) -> tuple[Array, Array]:
    """Outputs at the true values without noise.

    Args:
        system: The system.
        ctrl: (N, nu) control [unit of the actuator].

    Returns:
        (N+1, ny) outputs [y-unit], and (N+1, ny, p) their derivative [y-unit / theta-unit].

    Raises:
        SimulationDivergedError: The simulation diverges.
    """
    true = system.parameters.true
    exact = system.plant.derivatives.predict(true, ctrl)
    if exact is None:
        why = system.plant.why_diverged(true, ctrl)
        raise SimulationDivergedError(
            f"the simulation diverges at the true parameters under this control: {why}"
        )
    return exact


# ---- chunks in this process


def estimates_here(
    trials: TrialSet,
    counts: Sequence[int],
    rng: np.random.Generator,
    report: Report,
    budget: Budget,
) -> Iterator[Array]:
    """Estimate the parameters of all trials in this process.

    Args:
        trials: The trials.
        counts: Number of trials of each chunk.
        rng: Random numbers of the noise.
        report: Called with the share of all trials that is done.
        budget: Ends the work early.

    Yields:
        (m, p) estimates of each finished chunk.
    """
    for number, count in enumerate(counts):

        def report_chunk(share: float, number: int = number) -> None:
            """Report the share of all trials."""
            report((number + share) / len(counts))

        found = trials.estimates(count, rng, report_chunk, budget)
        if found is None:
            return
        yield found


# ---- chunks on workers


@dataclass(frozen=True, eq=False, kw_only=True)
class _TrialStudy:
    """Study that all chunks of a trajectory belong to. It can be pickled.

    Attributes:
        key: Unique text by which a worker recognises the study.
        system: The system.
        ctrl: (N, nu) control [unit of the actuator].
    """

    key: str
    system: SystemOrder
    ctrl: Array

    def trials(self) -> TrialSet:
        """Make the trials."""
        return TrialSet.of(self.system.system(), self.ctrl)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Chunk:
    """Order for the trials of one chunk.

    Attributes:
        count: Number of trials.
        noise: State of the generator of random numbers where the noise of the chunk begins.
    """

    count: int
    noise: Any

    def estimates(self, trials: TrialSet, stop: StopToken) -> Array | None:
        """(m, p) estimates; None after a request to stop."""
        source = np.random.PCG64()
        source.state = self.noise
        rng = np.random.Generator(source)
        return trials.estimates(self.count, rng, lambda share: None, Budget(stop=stop))


# The latest trials of a worker, by the key of their study.
_worker_trials: KeptPerThread[TrialSet] = KeptPerThread(2)


@one_blas_thread()
def _estimate_in_worker(study: _TrialStudy, chunk: _Chunk) -> Array | None:
    """Estimate the parameters of the trials of a chunk in a worker process."""
    trials = _worker_trials.get(study.key, study.trials)
    return chunk.estimates(trials, pool_stop_token())


def estimates_on_workers(
    executor: ExecutorLike,
    trials: TrialSet,
    counts: Sequence[int],
    rng: np.random.Generator,
    report: Report,
    budget: Budget,
) -> Iterator[Array]:
    """Estimate the parameters of all trials on the workers of an executor.

    The estimates are those of `estimates_here`, to the last digit.

    Args:
        executor: Executor of the workers.
        trials: The trials.
        counts: Number of trials of each chunk.
        rng: Random numbers of the noise.
        report: Called with the share of all trials that is done.
        budget: Ends the work early.

    Yields:
        (m, p) estimates of each finished chunk.
    """
    chunks = [_chunk(count, len(trials.exact), rng) for count in counts]
    threads = Workers.of(executor).threads_for(len(chunks))
    study = _TrialStudy(
        key=uuid.uuid4().hex,
        system=SystemOrder.of(trials.system, threads),
        ctrl=trials.ctrl,
    )

    def here(chunk: _Chunk) -> Array | None:
        """Estimate the trials of a chunk whose worker was lost."""
        return chunk.estimates(trials, budget.stop)

    results = results_or_here(executor, partial(_estimate_in_worker, study), chunks, budget, here)
    for number, found in enumerate(results):
        report((number + 1) / len(chunks))
        if found is not None:
            yield found


def _chunk(count: int, measurements: int, rng: np.random.Generator) -> _Chunk:
    """The order for the next trials, whose random numbers are skipped here."""
    chunk = _Chunk(count=count, noise=rng.bit_generator.state)
    rng.standard_normal((count, measurements))
    return chunk
