"""Monte-Carlo studies that compare the estimator with the Cramér-Rao bound.

The trials are divided into chunks. The trials of a chunk are stepped together, in this process or
by a worker. Every chunk has its part of one sequence of random numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.evaluation import motion_of
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import TrajectoryLike
from mjfim.experiment.schema import ExperimentLike, experiment_of
from mjfim.experiment.system import System, SystemOrder, labels_of_system, order_of
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from mjfim.information.identifiability import require_visible
from mjfim.parallel import ExecutorLike, one_blas_thread, results_on
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.records.events import Callback, StudyEvent, shown_progress
from mjfim.records.studies import MonteCarloStudy, TrialStatistics
from mjfim.records.trajectory import Recording, Trajectory

# Length of the last step, in standard deviations, below which a trial has converged.
CONVERGED_STEP = 0.03

# Number of Gauss-Newton steps with the Jacobian of the measurement without noise, which all trials
# share, and largest number of steps with the Jacobian of each trial.
SHARED_STEPS = 3
OWN_STEPS = 12

# Difference step for the Jacobian of each trial, relative to the size of each parameter.
JACOBIAN_STEP = 1e-6


@record
class TrialSet:
    """Repetitions of one control, all of which are stepped together.

    Attributes:
        system: The experiment with the true values.
        ctrl: (N, nu) control.
        exact: (n,) whitened measurement without noise.
        jacobian: (n, p) its derivatives at the true values [1 / theta-unit].
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
        true = system.parameters.true
        predicted = system.plant.derivatives.predict(true, ctrl)
        if predicted is None:
            why = system.plant.why_diverged(true, ctrl)
            raise SimulationDivergedError(
                f"the simulation diverges at the true parameters under this control: {why}"
            )
        exact, jacobian = (system.noise.whitened_rows(each) for each in predicted)
        return cls(system=system, ctrl=ctrl, exact=exact, jacobian=jacobian)

    def estimates(self, noise: Array, stop: StopToken) -> Array | None:
        """Estimate the parameters of all trials.

        Args:
            noise: (m, n) standard normal numbers, one row for each trial.
            stop: Ends the work early.

        Returns:
            (m, p) estimates, NaN where no fit succeeds; None after a request to stop [theta-unit].
        """
        measured = self.exact + noise
        centre, std, inverse = self._centre
        theta = centre[None]
        for _ in range(SHARED_STEPS):
            predicted, finite = self._outputs(theta)
            step = (measured - predicted) @ inverse
            # A trial whose simulation diverges starts again.
            theta = np.where(finite[:, None], theta + step, centre)

        active = np.arange(len(measured))
        for _ in range(OWN_STEPS):
            if stop.requested:
                return None
            step = self._own_step(theta[active], measured[active])
            theta[active] = np.where(np.isfinite(step), theta[active] + step, centre)
            active = active[~(np.abs(step) < CONVERGED_STEP * std).all(axis=1)]
            if not len(active):
                break

        # Trials that have not converged go through the general solver, one by one.
        for i in active:
            if stop.requested:
                return None
            theta[i] = self._fitted(measured[i], centre)
        return theta

    @cached_property
    def _centre(self) -> tuple[Array, Array, Array]:
        """Fit of the measurement without noise, where all trials start.

        Returns:
            (p,) parameters, (p,) their standard deviations, and the (n, p) transposed
            pseudo-inverse of the Jacobian [theta-unit].
        """
        theta = self._fitted(self.exact, self.system.parameters.guess)
        theta = self.system.parameters.true if np.isnan(theta).any() else theta
        predicted = self.system.plant.derivatives.predict(theta, self.ctrl)
        if predicted is None:
            raise SimulationDivergedError(
                "the simulation diverges near the fit of the measurement without noise"
            )
        inverse = np.asarray(np.linalg.pinv(self.system.noise.whitened_rows(predicted[1])).T)
        return theta, np.asarray(np.linalg.norm(inverse, axis=0)), inverse

    def _outputs(self, theta: Array) -> tuple[Array, np.ndarray]:
        """(m, n) whitened predictions at theta: (m, p), and which of them are finite."""
        y, finite = self.system.plant.measure(theta, self.ctrl)
        return self.system.noise.whitened_rows(np.moveaxis(y, 0, -1)).T, finite

    def _own_step(self, theta: Array, measured: Array) -> Array:
        """(m, p) Gauss-Newton steps with the Jacobian of each trial; NaN where there is none."""
        predicted, finite = self._outputs(theta)
        columns = []
        for j, size in enumerate(JACOBIAN_STEP * self.system.parameters.magnitude):
            moved = np.array(theta)
            moved[:, j] += size
            columns.append((self._outputs(moved)[0] - predicted) / size)
        J = np.stack(columns, axis=2)
        usable = finite & np.isfinite(J).all(axis=(1, 2))
        J = J[usable]
        JT = np.swapaxes(J, 1, 2)
        residual = (measured - predicted)[usable, :, None]
        step = np.full(theta.shape, np.nan)
        step[usable] = (np.linalg.pinv(JT @ J, hermitian=True) @ (JT @ residual))[:, :, 0]
        return step

    def _fitted(self, measured: Array, start: Array) -> Array:
        """(p,) estimate of one trial by the general solver; NaN where the fit fails."""
        noise = self.system.noise
        mask = noise.measured(len(self.ctrl)) > 0
        whitened = np.zeros(mask.shape)
        whitened[mask] = measured
        recording = Recording(
            t=np.arange(len(mask), dtype=np.float64) * self.system.dt,
            ctrl=self.ctrl,
            y=np.where(mask, whitened @ noise.factor.T, np.nan),
            outputs=self.system.outputs.names,
            name="trial",
        )
        found = least_squares(FitProblem.of(self.system, [recording], data_only=True), start)
        return found.unknowns.theta if found.success else np.full_like(start, np.nan)


# Smallest number of trials that are stepped together, where their memory and their time permit it,
# and the number of such chunks of many trials. A study that is stopped keeps finished chunks.
MIN_CHUNK = 250
CHUNKS = 10

# Largest memory of a chunk [bytes], and largest number of engine steps for one Jacobian of it. With
# more, the first chunk would take minutes, which a stop would lose.
CHUNK_BYTES = 1e9
CHUNK_STEPS = 5e6


@checked
def monte_carlo(
    experiment: ExperimentLike,
    trajectory: TrajectoryLike | Mapping[str, TrajectoryLike] | None = None,
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
        trajectory: One trajectory or design, which gets the name "final", or several by name;
            default: the initial motion.
        trials: Number of repetitions per trajectory.
        seed: Seed of the noise.
        measure_rate: Measurement rate [Hz] instead of that of the experiment.
        callback: Called with a `StudyEvent` whenever a chunk of trials is done.
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
        experiment = experiment_of(experiment).replace(measure_rate=measure_rate)
    system = System.resolve(experiment, threads=threads)

    if trials < 2:
        raise ExperimentError(f"trials: {trials} is too few; a covariance needs at least 2")
    named = _motions(system, trajectory)

    # A trajectory that cannot be simulated fails before the first trial.
    calibrated = system.calibrated(system.theta, next(iter(named.values())).ctrl)
    trial_sets = {}
    for name, curve in named.items():
        suited = calibrated
        if system.experiment.initial.free:
            suited = system.released_as(curve.state[0]).calibrated(system.theta, curve.ctrl)
        trial_sets[name] = TrialSet.of(suited, curve.ctrl)

    sets = {}
    information = {}
    generators = np.random.default_rng(seed).spawn(len(named))
    with (
        one_blas_thread(),
        stop_on_interrupt(stop) as token,
        shown_progress("repeating the experiment", callback, progress) as show,
    ):
        for i, (name, trial_set) in enumerate(trial_sets.items()):
            if token.requested:
                break

            def report(share: float, part: str = name, index: int = i) -> None:
                """Report that a share of the trials of this trajectory is done."""
                if show is not None:
                    count = len(named)
                    show(
                        StudyEvent(
                            study="monte_carlo", part=part, index=index, count=count, share=share
                        )
                    )

            begun = time.perf_counter()
            J = trial_set.jacobian
            require_visible(system.parameters, system.parameters.prior_information, J)
            found = list(_estimates(trial_set, trials, generators[i], report, executor, token))
            # An interrupted set holds the trials that are finished.
            if found:
                information[name] = J.T @ J
                crlb = np.asarray(np.linalg.inv(information[name]))
                seconds = time.perf_counter() - begun
                sets[name] = _statistics(np.concatenate(found), crlb, seconds)

    return MonteCarloStudy(
        parameters=system.parameters.names,
        theta=system.parameters.true,
        measure_rate=system.measure_rate,
        sets=sets,
        information=information,
        labels=labels_of_system(system),
    )


def _motions(
    system: System, given: TrajectoryLike | Mapping[str, TrajectoryLike] | None
) -> dict[str, Trajectory]:
    """The trajectories by name, at least one."""
    stated = given if isinstance(given, Mapping) else {"final": given}
    if not stated:
        raise ExperimentError("monte_carlo: trajectory: the table of trajectories is empty")
    return {name: motion_of(system, each, "monte_carlo") for name, each in stated.items()}


def _estimates(
    trial_set: TrialSet,
    trials: int,
    rng: np.random.Generator,
    report: Callable[[float], None],
    executor: ExecutorLike | None,
    stop: StopToken,
) -> Iterator[Array]:
    """Yield the estimates of each chunk, (m, p) [theta-unit]."""
    chunks = []
    for count in chunk_sizes(trial_set.system, len(trial_set.ctrl), trials):
        chunks.append((count, rng.bit_generator.state))
        rng.standard_normal((count, len(trial_set.exact)))  # the numbers of this chunk

    def make(threads: int) -> Callable[[], TrialSet]:
        return partial(_made_trials, order_of(trial_set.system, threads), trial_set.ctrl)

    budget = Budget(stop=stop)
    every = results_on(trial_set, make, _estimated, chunks, executor, budget)
    for number, found in enumerate(every):
        report((number + 1) / len(chunks))
        if found is not None:
            yield found


def _made_trials(order: SystemOrder, ctrl: Array) -> TrialSet:
    return TrialSet.of(order(), ctrl)


def _estimated(trial_set: TrialSet, chunk: tuple[int, Any], stop: StopToken) -> Array | None:
    """(m, p) estimates of a chunk, which is its number of trials and the state of the noise."""
    count, state = chunk
    source = np.random.PCG64()
    source.state = state
    noise = np.random.Generator(source).standard_normal((count, len(trial_set.exact)))
    return trial_set.estimates(noise, stop)


def chunk_sizes(system: System, samples: int, trials: int) -> tuple[int, ...]:
    """Numbers of trials that are stepped together.

    Args:
        system: The experiment.
        samples: Number of samples of the trajectory.
        trials: Number of all trials.
    """
    p, steps = len(system.parameters), samples * system.grid.substeps
    measured = int(np.sum(samples // np.asarray(system.noise.strides)))
    state = system.nominal_initial_state.size + len(system.controls) + system.model.nsensordata
    # Each trial has a copy of the model, its motion, and a Jacobian with its difference.
    memory = system.plant.source.model.nbuffer + 8 * (measured * (2 * p + 5) + steps * state)
    most = min(CHUNK_BYTES / memory, CHUNK_STEPS / (steps * (p + 1)))
    size = max(min(max(MIN_CHUNK, trials // CHUNKS), int(most)), 1)
    count = -(-trials // size)
    smaller, larger = divmod(trials, count)
    return (smaller + 1,) * larger + (smaller,) * (count - larger)


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
