"""Monte-Carlo studies that compare the estimator with the Cramér-Rao bound.

The trials are divided into chunks. The trials of a chunk are stepped together
(`mjfim/studies/trials.py`), in this process or by a worker; every chunk has its part of one
sequence of random numbers. The estimates depend on the seed alone, not on chunks and workers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import ExperimentError
from mjfim.experiment.labels import labels_of_system
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.information.identifiability import require_visible
from mjfim.parallel import ExecutorLike, Workers, one_blas_thread
from mjfim.records.events import Callback, StudyEvent, shown_progress
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.trajectory import Trajectory
from mjfim.studies.trial_chunks import (
    TrialSet,
    estimates_here,
    estimates_on_workers,
    exact_outputs,
)

# Largest size of the Jacobians of all trials that are stepped together [bytes].
CHUNK_BYTES = 1e8

# Bytes of one number.
NUMBER_BYTES = 8

# Smallest number of trials that are stepped together, where their memory and their time permit it.
# With fewer of them, sending and receiving them takes a considerable part of the time.
MIN_CHUNK = 250

# Largest number of engine steps for one Jacobian of all trials that are stepped together. With
# more, the first chunk would take minutes, which a stop would lose.
LARGEST_CHUNK_STEPS = 5e6

# Largest memory of all trials that are stepped together [bytes], for long trajectories and for
# models with large meshes, of which each trial has a copy.
LARGEST_CHUNK_BYTES = 1e9

# Number of chunks of many trials. A study that is stopped keeps the chunks that are finished.
CHUNKS = 10

# The same beyond the smallest chunk, so that there are enough chunks for many workers.
CHUNK_STEPS = 1e6


def monte_carlo(
    experiment: Experiment,
    trajectory: Trajectory | Mapping[str, Trajectory],
    *,
    trials: int = 1500,
    seed: int = 0,
    measure_rate: float | None = None,
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
) -> MonteCarloStudy:
    """Estimate the parameters from many noisy repetitions of one or several trajectories.

    Parameters are estimated without bounds and priors, so that the study shows the information of
    the data alone.

    Args:
        experiment: Experiment with the true values.
        trajectory: One trajectory, which gets the name "final", or several by name.
        trials: Number of repetitions per trajectory.
        seed: Seed of the noise.
        measure_rate: Measurement rate [Hz] instead of that of the experiment.
        callback: Called with a `StudyEvent` whenever all trials have made a step.
        threads: Threads of MuJoCo; None for all cores.
        stop: Ends the study early, as Ctrl-C does; the trials that are finished are returned.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            runs the trials side by side; the estimates do not depend on it.

    Raises:
        ExperimentError: Fewer than two trials.
        SimulationDivergedError: The model diverges at the true values.
        UnidentifiableError: A parameter has no effect on the data.
    """
    if measure_rate is not None:
        experiment = experiment.replace(measure_rate=measure_rate)
    system = System.resolve(experiment, threads=threads)

    with shown_progress("repeating the experiment", callback, progress) as show:
        return monte_carlo_system(
            system,
            trajectory,
            trials=trials,
            seed=seed,
            callback=show,
            stop=stop,
            executor=executor,
        )


@one_blas_thread()
def monte_carlo_system(
    system: System,
    trajectory: Trajectory | Mapping[str, Trajectory],
    *,
    trials: int = 1500,
    seed: int = 0,
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> MonteCarloStudy:
    """Study the estimator on a resolved system. See `monte_carlo`."""
    if trials < 2:
        raise ExperimentError(f"trials: {trials} is too few; a covariance needs at least 2")
    named = {"final": trajectory} if isinstance(trajectory, Trajectory) else dict(trajectory)
    workers = Workers.of_any(executor)

    # Fail before the first trial where a trajectory cannot be simulated.
    for curve in named.values():
        exact_outputs(system.released_as(curve.state[0]), curve.ctrl)

    systems = _calibrated_systems(system, named)
    generators = np.random.default_rng(seed).spawn(len(named))

    sets: dict[str, TrialStatistics] = {}
    information: dict[str, Array] = {}
    with stop_on_interrupt(stop) as token:
        plan = _Plan(trials=trials, executor=workers, budget=Budget(stop=token))
        for i, (name, curve) in enumerate(named.items()):
            progress = _Progress(callback=callback, part=name, index=i, count=len(named))
            found = _trial_set(systems[name], curve, plan, generators[i], progress)

            # An interrupted set holds the trials that are finished.
            if found is not None:
                sets[name], information[name] = found
            if token.requested:
                break

    return MonteCarloStudy(
        parameters=system.parameters.names,
        theta=system.parameters.true,
        measure_rate=system.measure_rate,
        sets=sets,
        information=information,
        labels=labels_of_system(system),
    )


def _calibrated_systems(system: System, named: Mapping[str, Trajectory]) -> dict[str, System]:
    """The system of each trajectory by name, with difference steps that suit the first one.

    Trajectories with releases of their own are systems of their own.
    """
    first = next(iter(named.values()))
    if not system.experiment.initial.free:
        return dict.fromkeys(named, system.calibrated(system.theta, first.ctrl))

    return {
        name: system.released_as(curve.state[0]).calibrated(system.theta, curve.ctrl)
        for name, curve in named.items()
    }


def chunk_sizes(system: System, samples: int, trials: int) -> tuple[int, ...]:
    """Numbers of trials that are stepped together.

    They depend on the study only, not on the machine.

    Args:
        system: The system.
        samples: Number of samples of the trajectory.
        trials: Number of all trials.

    Returns:
        The numbers, which differ by 1 at most.
    """
    jacobian = NUMBER_BYTES * _measurements(system, samples) * len(system.parameters)
    steps = samples * system.grid.substeps * (len(system.parameters) + 1)
    most = min(int(CHUNK_BYTES / jacobian), int(CHUNK_STEPS / steps), trials // CHUNKS)
    count = max(trials // max(MIN_CHUNK, most), 1)

    # Memory and time decide where they do not permit so many.
    fitting = int(LARGEST_CHUNK_BYTES / _trial_bytes(system, samples))
    fitting = max(min(fitting, int(LARGEST_CHUNK_STEPS / steps)), 1)
    count = max(count, -(-trials // fitting))
    smaller, larger = divmod(trials, count)
    return (smaller + 1,) * larger + (smaller,) * (count - larger)


def _measurements(system: System, samples: int) -> int:
    """Number of measured values of a trial."""
    return int(np.sum(samples // np.asarray(system.noise.strides)))


def _trial_bytes(system: System, samples: int) -> float:
    """Estimate of the memory of one trial [bytes].

    Counted are the Jacobian, the columns of which it is put together, the measurements and
    predictions; the state and the control of every engine step of a simulation; and a copy of the
    model.
    """
    state, nu = system.nominal_initial_state.size, len(system.controls)
    sensors = int(system.model.nsensordata) if system.outputs.needs_sensors else 0
    fitted = _measurements(system, samples) * (2 * len(system.parameters) + 5)

    at_engine_steps = system.grid.substeps * (1 + state + nu + sensors)
    at_samples = state + sensors + 2 * len(system.outputs)
    numbers = fitted + samples * (at_engine_steps + at_samples)
    return float(NUMBER_BYTES * numbers + system.plant.source.model.nbuffer)


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """Number of trials of each trajectory, and the executor that runs them.

    Attributes:
        trials: Number of repetitions.
        executor: Runs the chunks side by side; None for this process.
        budget: Ends the study early.
    """

    trials: int
    executor: ExecutorLike | None
    budget: Budget

    def estimates(
        self,
        trials: TrialSet,
        counts: Sequence[int],
        rng: np.random.Generator,
        report: Callable[[float], None],
    ) -> Iterator[Array]:
        """Estimates of each finished chunk; see `estimates_here`."""
        if self.executor is None:
            return estimates_here(trials, counts, rng, report, self.budget)
        return estimates_on_workers(self.executor, trials, counts, rng, report, self.budget)


@dataclass(frozen=True, kw_only=True)
class _Progress:
    """Reports the progress of the trials of one trajectory.

    Attributes:
        callback: Called with every event, or None.
        part: Name of the trajectory.
        index: Number of the trajectory, from 0.
        count: Number of trajectories.
    """

    callback: Callback | None
    part: str
    index: int
    count: int

    def report(self, share: float) -> None:
        """Report that a share of the trials, 0 to 1, is done."""
        if self.callback is None:
            return

        event = StudyEvent(
            study="monte_carlo",
            part=self.part,
            index=self.index,
            count=self.count,
            share=share,
        )
        self.callback(event)


def _trial_set(
    system: System,
    curve: Trajectory,
    plan: _Plan,
    rng: np.random.Generator,
    progress: _Progress,
) -> tuple[TrialStatistics, Array] | None:
    """Run all trials along one trajectory.

    Args:
        system: System whose parameters are estimated.
        curve: The trajectory.
        plan: How many trials there are, and where they run.
        rng: Random numbers of the noise.
        progress: Reports the progress.

    Returns:
        Statistics of the finished trials and (p, p) information of the trajectory
        [1 / theta-unit^2]; None where the study was interrupted before any were finished.
    """
    begun = time.perf_counter()
    trials = TrialSet.of(system, curve.ctrl)
    J = trials.jacobian
    information = np.asarray(J.T @ J)
    require_visible(system.parameters, system.parameters.prior_information, J)

    # Those of a finished chunk are kept after a request to stop.
    counts = chunk_sizes(system, len(curve.ctrl), plan.trials)
    estimates = list(plan.estimates(trials, counts, rng, progress.report))
    if not estimates:
        return None

    crlb = np.asarray(np.linalg.inv(information))
    seconds = time.perf_counter() - begun
    return _statistics(np.concatenate(estimates), crlb, seconds), information


def _statistics(estimates: Array, crlb: Array, seconds: float) -> TrialStatistics:
    """Compare the scatter of estimates with the Cramér-Rao bound.

    Args:
        estimates: (m, p) estimates, NaN where a trial failed [theta-unit].
        crlb: (p, p) Cramér-Rao bound [theta-unit^2].
        seconds: Time that the trials took [s].
    """
    good = estimates[np.isfinite(estimates).all(axis=1)]
    n, p = len(good), estimates.shape[1]

    mean = efficiency = np.full(p, np.nan)
    covariance = np.full((p, p), np.nan)
    interval = np.full((p, 2), np.nan)

    # A covariance needs two estimates; its 95 % interval follows the chi-squared distribution.
    if n >= 2:
        mean = good.mean(axis=0)
        covariance = np.atleast_2d(np.cov(good, rowvar=False))
        efficiency = np.diag(crlb) / np.diag(covariance)
        quantiles = scipy.stats.chi2.ppf([0.025, 0.975], n - 1) / (n - 1)
        interval = efficiency[:, None] * quantiles

    return TrialStatistics(
        estimates=estimates,
        mean=mean,
        covariance=covariance,
        crlb=crlb,
        efficiency=efficiency,
        efficiency_interval=interval,
        trials=len(estimates),
        failed=len(estimates) - n,
        seconds=seconds,
    )
