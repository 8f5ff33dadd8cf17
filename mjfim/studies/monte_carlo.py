"""Monte-Carlo studies that compare the estimator with the Cramér-Rao bound.

All trials are stepped together. Each trial minimises its squared residual, in four steps:

1. A fit of the mean measurement leads from the guess to a point near the minima of all trials.
2. Gauss-Newton steps with a shared Jacobian, which is expanded to second order about that fit,
   bring each trial close to its minimum.
3. Gauss-Newton steps with the Jacobian of each trial finish it. A trial has converged when its last
   step is small compared with its standard deviation.
4. The few trials that have not converged are solved one by one with the least-squares solver of
   `identify`. A trial that this does not solve has failed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import ExperimentError, SimulationDivergedError, explain_renamed_arguments
from mjfim.experiment.labels import labels_of_system
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.identify import least_squares, newton_raphson
from mjfim.identification.residuals import FitProblem
from mjfim.information.identifiability import require_visible
from mjfim.memory import NUMBER_BYTES, require_memory
from mjfim.parallel import one_blas_thread
from mjfim.records.events import Callback, StudyEvent
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.progress import shown_progress
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

# Length of the last step, in standard deviations, below which a trial has converged.
CONVERGED_STEP = 0.03

# Number of Gauss-Newton steps with the shared Jacobian, including the first one from the fit of the
# mean measurement.
SHARED_STEPS = 3

# Largest number of Gauss-Newton steps with the Jacobian of each trial.
INDIVIDUAL_STEPS = 12

# Largest size of the Jacobians of all trials that are stepped together [bytes].
CHUNK_BYTES = 1e8

# Copies of all estimates that exist at the same time: of both trajectories, for their statistics
# and for the files.
ESTIMATE_COPIES = 6

# Smallest number of trials that are stepped together, where their memory permits it.
MIN_CHUNK = 64

# Largest memory of all trials that are stepped together [bytes], for long trajectories and for
# models with large meshes, of which each trial has a copy.
LARGEST_CHUNK_BYTES = 1e9

# Number of chunks of many trials. A study that is stopped keeps the chunks that are finished.
CHUNKS = 10

# Largest number of engine steps for one Jacobian of all trials that are stepped together, beyond
# the smallest chunk. With more, the first chunk would take minutes, which a stop would lose.
CHUNK_STEPS = 1e6

# Difference step for the Jacobian of each trial, relative to the size of each parameter.
JACOBIAN_STEP = 1e-6

# Difference step for the derivative of the shared Jacobian, relative to the size of each parameter.
CURVATURE_STEP = 1e-3


@explain_renamed_arguments
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

    Raises:
        ExperimentError: Fewer than two trials, or more than fit into memory.
        SimulationDivergedError: The model diverges at the true values.
        UnidentifiableError: A parameter has no effect on the data.
    """
    if measure_rate is not None:
        experiment = experiment.replace(measure_rate=measure_rate)
    system = System.resolve(experiment, threads=threads)

    with shown_progress("repeating the experiment", callback, progress) as show:
        return monte_carlo_system(
            system, trajectory, trials=trials, seed=seed, callback=show, stop=stop
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
) -> MonteCarloStudy:
    """Study the estimator on a resolved system. See `monte_carlo`."""
    if trials < 2:
        raise ExperimentError(f"trials: {trials} is too few; a covariance needs at least 2")
    named = {"final": trajectory} if isinstance(trajectory, Trajectory) else dict(trajectory)
    require_memory_for_trials(system, named, trials)

    # Fail before the first trial where a trajectory cannot be simulated.
    for curve in named.values():
        _exact_outputs(system.released_as(curve.state[0]), curve)

    systems = _calibrated_systems(system, named)
    generators = np.random.default_rng(seed).spawn(len(named))

    sets: dict[str, TrialStatistics] = {}
    information: dict[str, Array] = {}
    with stop_on_interrupt(stop) as token:
        budget = Budget(stop=token)
        for i, (name, curve) in enumerate(named.items()):
            progress = _Progress(callback=callback, part=name, index=i, count=len(named))
            found = _trial_set(systems[name], curve, trials, generators[i], progress, budget)

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


def require_memory_for_trials(
    system: System,
    trajectories: Mapping[str, Trajectory],
    trials: int,
    available: float | None = None,
) -> None:
    """Refuse trials that do not fit into memory.

    Args:
        system: The system whose parameters are estimated.
        trajectories: Trajectories by name.
        trials: Number of repetitions of each.
        available: Memory that is there [bytes]; None for that of this machine.

    Raises:
        ExperimentError: The estimates, or the trials that are stepped together, do not fit.
    """
    p = len(system.parameters)
    needed = NUMBER_BYTES * ESTIMATE_COPIES * float(trials) * p
    needed += max(
        chunk_size(system, len(curve.ctrl), trials) * _trial_bytes(system, len(curve.ctrl))
        for curve in trajectories.values()
    )
    require_memory(needed / NUMBER_BYTES, f"trials: {trials}", available=available)


def chunk_size(system: System, samples: int, trials: int) -> int:
    """Number of trials that are stepped together.

    It depends on the study only, not on the machine, because the results depend on it.

    Args:
        system: The system.
        samples: Number of samples of the trajectory.
        trials: Number of all trials.

    Returns:
        The number, at least 1.
    """
    jacobian = NUMBER_BYTES * _measurements(system, samples) * len(system.parameters)
    steps = samples * system.grid.substeps * (len(system.parameters) + 1)
    most = min(int(CHUNK_BYTES / jacobian), int(CHUNK_STEPS / steps), -(-trials // CHUNKS))
    fitting = int(LARGEST_CHUNK_BYTES / _trial_bytes(system, samples))
    return min(max(MIN_CHUNK, most), max(fitting, 1), trials)


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
class _Progress:
    """Reports the progress of the trials of one trajectory.

    Attributes:
        callback: Called with every event, or None.
        part: Name of the trajectory.
        index: Number of the trajectory, from 0.
        count: Number of trajectories.
        begin: Share of the trials before the current chunk.
        width: Share of the trials in the current chunk.
    """

    callback: Callback | None
    part: str
    index: int
    count: int
    begin: float = 0.0
    width: float = 1.0

    def chunk(self, number: int, count: int) -> _Progress:
        """Progress of chunk `number`, from 0, of `count` chunks."""
        return _Progress(
            callback=self.callback,
            part=self.part,
            index=self.index,
            count=self.count,
            begin=number / count,
            width=1.0 / count,
        )

    def report(self, share: float) -> None:
        """Report that a share of the chunk, 0 to 1, is done."""
        if self.callback is None:
            return

        event = StudyEvent(
            study="monte_carlo",
            part=self.part,
            index=self.index,
            count=self.count,
            share=self.begin + self.width * share,
        )
        self.callback(event)


@dataclass(frozen=True, eq=False, kw_only=True)
class _SharedFit:
    """Fit of the mean measurement, from which all trials start.

    Attributes:
        theta: (p,) estimate [theta-unit].
        J: (n, p) whitened Jacobian of the outputs [1 / theta-unit].
        curvature: (p, n, p) derivative of the Jacobian by theta [1 / theta-unit^2].
        std: (p,) standard deviations [theta-unit].
    """

    theta: Array
    J: Array
    curvature: Array
    std: Array

    def jacobian(self, theta: Array) -> Array:
        """(m, n, p) second-order expansion of the Jacobian at theta: (m, p) [theta-unit]."""
        change = np.tensordot(theta - self.theta, self.curvature, axes=(1, 0))
        return np.asarray(self.J + change)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Trials:
    """Repetitions of one control that differ by their noise.

    Attributes:
        system: System that is repeated.
        ctrl: (N, nu) control [unit of the actuator].
        measured: (m, n) whitened measurements of m trials.
    """

    system: System
    ctrl: Array
    measured: Array

    def outputs(self, theta: Array) -> tuple[Array, np.ndarray]:
        """Predict the whitened measurements.

        Args:
            theta: (m, p) parameters of every trial [theta-unit].

        Returns:
            (m, n) whitened predictions, and (m,) booleans, False where a prediction diverges.
        """
        y, finite = self.system.plant.measure(theta, self.ctrl)
        trials_last = np.moveaxis(y, 0, -1)
        whitened = self.system.noise.whitened_rows(trials_last)
        return whitened.T, finite

    def jacobian(self, theta: Array, predicted: Array) -> Array:
        """Differentiate the predictions by one-sided differences.

        Args:
            theta: (m, p) parameters of every trial [theta-unit].
            predicted: (m, n) whitened predictions there.

        Returns:
            (m, n, p) Jacobian of every trial [1 / theta-unit].
        """
        columns = []
        for j, step in enumerate(JACOBIAN_STEP * self.system.parameters.magnitude):
            moved = np.array(theta)
            moved[:, j] += step
            outputs, _ = self.outputs(moved)
            columns.append((outputs - predicted) / step)

        return np.stack(columns, axis=2)

    def part(self, indices: np.ndarray) -> _Trials:
        """The trials with some indices."""
        return _Trials(system=self.system, ctrl=self.ctrl, measured=self.measured[indices])

    def fit_problem(self, measured: Array) -> FitProblem:
        """Least-squares problem of one trial's whitened measurement: (n,), without priors."""
        return FitProblem.of(self.system, [self._recording(measured)], data_only=True)

    def _recording(self, measured: Array) -> Recording:
        """A recording in units of the outputs from a whitened measurement: (n,)."""
        noise = self.system.noise
        mask = noise.measured(len(self.ctrl)) > 0
        whitened = np.zeros(mask.shape)
        whitened[mask] = measured
        y = np.where(mask, whitened @ noise.factor.T, np.nan)

        return Recording(
            t=np.arange(len(y), dtype=np.float64) * self.system.dt,
            ctrl=self.ctrl,
            y=y,
            outputs=self.system.outputs.names,
            name="trial",
        )


def _trial_set(
    system: System,
    curve: Trajectory,
    count: int,
    rng: np.random.Generator,
    progress: _Progress,
    budget: Budget,
) -> tuple[TrialStatistics, Array] | None:
    """Run all trials along one trajectory.

    Args:
        system: System whose parameters are estimated.
        curve: The trajectory.
        count: Number of trials.
        rng: Random numbers of the noise.
        progress: Reports the progress.
        budget: Ends the study early.

    Returns:
        Statistics of the finished trials and (p, p) information of the trajectory
        [1 / theta-unit^2]; None where the study was interrupted before any were finished.
    """
    begun = time.perf_counter()
    y, G = _exact_outputs(system, curve)
    exact = system.noise.whitened_rows(y)
    J = system.noise.whitened_rows(G)
    information = np.asarray(J.T @ J)
    require_visible(system.parameters, system.parameters.prior_information, J)

    # Those of a finished chunk are kept after a request to stop.
    chunk = chunk_size(system, len(curve.ctrl), count)
    firsts = range(0, count, chunk)
    estimates = []
    for number, first in enumerate(firsts):
        m = min(chunk, count - first)
        measured = exact + rng.standard_normal((m, J.shape[0]))
        trials = _Trials(system=system, ctrl=curve.ctrl, measured=measured)

        report = progress.chunk(number, len(firsts)).report
        found = _estimate(trials, _fit_mean(trials), report, budget)
        if found is None:
            break
        estimates.append(found)

    if not estimates:
        return None

    crlb = np.asarray(np.linalg.inv(information))
    seconds = time.perf_counter() - begun
    return _statistics(np.concatenate(estimates), crlb, seconds), information


def _exact_outputs(system: System, curve: Trajectory) -> tuple[Array, Array]:
    """Outputs at the true values without noise.

    Returns:
        (N+1, ny) outputs [y-unit], and (N+1, ny, p) their derivative [y-unit / theta-unit].
    """
    true = system.parameters.true
    exact = system.plant.derivatives.predict(true, curve.ctrl)
    if exact is None:
        why = system.plant.why_diverged(true, curve.ctrl)
        raise SimulationDivergedError(
            f"the simulation diverges at the true parameters under this control: {why}"
        )
    return exact


def _fit_mean(trials: _Trials) -> _SharedFit:
    """Fit the mean measurement from the guess, and differentiate its Jacobian."""
    system = trials.system
    fit = trials.fit_problem(trials.measured.mean(axis=0))
    theta = newton_raphson(fit, system.parameters.guess).unknowns.theta

    def jacobian(at: Array) -> Array:
        """(n, p) whitened Jacobian at (p,) parameters."""
        predicted = system.plant.derivatives.predict(at, trials.ctrl)
        if predicted is None:
            raise SimulationDivergedError(
                "the simulation diverges near the fit of the mean measurement"
            )
        return system.noise.whitened_rows(predicted[1])

    J = jacobian(theta)
    curvature = []
    for step in np.diag(CURVATURE_STEP * system.parameters.magnitude):
        change = jacobian(theta + step) - jacobian(theta - step)
        curvature.append(change / (2 * step.max()))

    return _SharedFit(
        theta=theta,
        J=J,
        curvature=np.stack(curvature),
        std=np.sqrt(np.diag(np.linalg.inv(J.T @ J))),
    )


def _estimate(
    trials: _Trials, shared: _SharedFit, report: Callable[[float], None], budget: Budget
) -> Array | None:
    """(m, p) estimates of all trials, NaN where a trial failed; None after an interruption."""
    theta = _shared_steps(trials, shared, report, budget)
    if theta is None:
        return None
    unfinished = _individual_steps(trials, shared, theta, report, budget)

    # Trials that have not converged go through the general solver, one by one.
    for i in unfinished:
        if budget.exhausted:
            return None
        solution = least_squares(trials.fit_problem(trials.measured[i]), shared.theta)
        theta[i] = solution.unknowns.theta if solution.success else np.nan

    return theta


def _shared_steps(
    trials: _Trials, shared: _SharedFit, report: Callable[[float], None], budget: Budget
) -> Array | None:
    """(m, p) estimates after the steps with the shared Jacobian; None after an interruption."""
    predicted, _ = trials.outputs(shared.theta[None])
    theta = shared.theta + (trials.measured - predicted) @ np.linalg.pinv(shared.J).T

    for k in range(SHARED_STEPS - 1):
        if budget.exhausted:
            return None
        predicted, finite = trials.outputs(theta)
        step = _gauss_newton(shared.jacobian(theta), trials.measured - predicted)

        # A trial whose simulation diverges starts again from the shared fit.
        theta = np.where(finite[:, None], theta + step, shared.theta)
        report((k + 1) / (SHARED_STEPS + 3))

    return np.asarray(theta)


def _individual_steps(
    trials: _Trials,
    shared: _SharedFit,
    theta: Array,
    report: Callable[[float], None],
    budget: Budget,
) -> np.ndarray:
    """Step each trial with its Jacobian until it has converged.

    Args:
        trials: The m trials.
        shared: Fit of the mean measurement.
        theta: (m, p) estimates [theta-unit], improved in place.
        report: Called with the share that is done.
        budget: Ends the study early.

    Returns:
        Indices of the trials that have not converged.
    """
    active = np.arange(len(trials.measured))
    for k in range(INDIVIDUAL_STEPS):
        if budget.exhausted:
            break
        moving = trials.part(active)
        predicted, finite = moving.outputs(theta[active])
        J = moving.jacobian(theta[active], predicted)
        step = _gauss_newton(J, moving.measured - predicted)

        # A trial whose simulation diverges starts again from the shared fit.
        step[~finite] = np.nan
        theta[active] = np.where(np.isfinite(step), theta[active] + step, shared.theta)

        relative = np.nan_to_num(np.abs(step) / shared.std, nan=np.inf)
        active = active[relative.max(axis=1) >= CONVERGED_STEP]
        if not len(active):
            report(1.0)
            break
        report((SHARED_STEPS + k + 1) / (SHARED_STEPS + k + 2))

    return active


def _gauss_newton(J: Array, residual: Array) -> Array:
    """Gauss-Newton steps `(J'J)^-1 J'r` of all trials.

    Args:
        J: (m, n, p) Jacobians [1 / theta-unit].
        residual: (m, n) whitened residuals.

    Returns:
        (m, p) steps [theta-unit]; NaN where a Jacobian or a residual is not finite.
    """
    JT = np.swapaxes(J, 1, 2)
    gram = JT @ J
    projected = JT @ residual[:, :, None]

    usable = np.isfinite(gram).all(axis=(1, 2)) & np.isfinite(projected).all(axis=(1, 2))
    inverse = np.linalg.pinv(gram[usable], hermitian=True)
    step = np.full((len(J), J.shape[2]), np.nan)
    step[usable] = (inverse @ projected[usable])[:, :, 0]
    return step


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
