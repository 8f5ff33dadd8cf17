"""Monte-Carlo studies of the estimator against the Cramer-Rao bound, all trials stepped together.

Every trial minimises its own squared residual. The way there is shared: a fit of the mean measurement leads from the
guess to the neighbourhood of all minima, Gauss-Newton steps with the Jacobian expanded to second order about that point
bring each trial close, and a step with the trial's own Jacobian finishes it. A trial counts as converged when its last
own step is small against its standard deviation; the few others go one by one through the least-squares solver of
`identify`, and what that does not solve is a failed trial.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.identify import least_squares, newton_raphson
from mjfim.identification.residuals import FitProblem
from mjfim.information.identifiability import require_visible
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

CONVERGED = 0.03
SHARED_STEPS = 3
OWN_STEPS = 12
CHUNK_BYTES = 1e8  # of one Jacobian of all trials of a chunk
Progress = Callable[[str, float], None]


def monte_carlo(
    experiment: Experiment,
    trajectory: Trajectory | Mapping[str, Trajectory],
    trials: int = 1500,
    seed: int = 0,
    measure_rate: float | None = None,
    progress: Progress | None = None,
) -> MonteCarloStudy:
    """Estimate the parameters from many noisy repetitions of one or several trajectories (name -> trajectory).

    Parameters are searched without bounds and priors: the study holds the data's information alone. Ctrl-C returns the
    sets that are finished. Raises ExperimentError for fewer than two trials, UnidentifiableError where a parameter does
    not show in the data.
    """
    if measure_rate is not None:
        experiment = experiment.replace(measure_rate=measure_rate)
    return monte_carlo_system(System.resolve(experiment), trajectory, trials, seed, progress)


def monte_carlo_system(
    system: System,
    trajectory: Trajectory | Mapping[str, Trajectory],
    trials: int = 1500,
    seed: int = 0,
    progress: Progress | None = None,
) -> MonteCarloStudy:
    """Study the estimator on a resolved system. See `monte_carlo`."""
    if trials < 2:
        raise ExperimentError(f"trials: {trials} is too few; a covariance needs at least 2")
    named = {"final": trajectory} if isinstance(trajectory, Trajectory) else dict(trajectory)
    for curve in named.values():
        _exact(system, curve)
    system = system.calibrated(system.theta, next(iter(named.values())).ctrl)
    sets, information = {}, {}
    try:
        for rng, (name, curve) in zip(
            np.random.default_rng(seed).spawn(len(named)), named.items(), strict=True
        ):
            tell = None if progress is None else (lambda share, name=name: progress(name, share))
            sets[name], information[name] = _trial_set(system, curve, trials, rng, tell)
    except KeyboardInterrupt:
        if not sets:
            raise
    return MonteCarloStudy(
        parameters=system.parameters.names,
        theta=system.parameters.true,
        measure_rate=system.measure_rate,
        sets=sets,
        information=information,
    )


@dataclass(frozen=True, eq=False)
class Shared:
    """What all trials share, at the fit of the mean measurement.

    theta: (p,);  J: (n, p) whitened Jacobian;  bend: (p, n, p) its derivative by theta;  std: (p,)
    """

    theta: Array
    J: Array
    bend: Array
    std: Array

    def jacobian(self, theta: Array) -> Array:
        """(m, n, p) second-order Jacobians at theta: (m, p)."""
        return np.asarray(self.J + np.tensordot(theta - self.theta, self.bend, axes=(1, 0)))


class Trials:
    """Many repetitions of one control with their own noise. measured: (m, n) whitened measurements of all trials."""

    def __init__(self, system: System, ctrl: Array, measured: Array) -> None:
        self.system, self.ctrl, self.measured = system, ctrl, measured

    def outputs(self, theta: Array) -> tuple[Array, np.ndarray]:
        """Whitened predictions (m, n) at theta: (m, p), and which of them are finite."""
        y, finite = self.system.plant.measure(theta, self.ctrl)
        return self.system.noise.whitened_rows(np.moveaxis(y, 0, -1)).T, finite

    def recording(self, measured: Array) -> Recording:
        """One trial, (n,) whitened, as a recording."""
        noise = self.system.noise
        mask = noise.measured(len(self.ctrl)) > 0
        y = np.zeros(mask.shape)
        y[mask] = measured
        y = np.where(mask, y @ noise.factor.T, np.nan)
        return Recording(
            t=np.arange(len(y), dtype=np.float64) * self.system.dt,
            ctrl=self.ctrl,
            y=y,
            outputs=self.system.outputs.names,
            name="trial",
        )

    def jacobian(self, theta: Array, predicted: Array, relative: float = 1e-6) -> Array:
        """(m, n, p) by one-sided differences about predictions already made."""
        steps = relative * self.system.parameters.magnitude
        columns = []
        for j, h in enumerate(steps):
            moved = np.array(theta)
            moved[:, j] += h
            columns.append((self.outputs(moved)[0] - predicted) / h)
        return np.stack(columns, axis=2)


def _trial_set(
    system: System,
    curve: Trajectory,
    count: int,
    rng: np.random.Generator,
    tell: Callable[[float], None] | None,
) -> tuple[TrialStatistics, Array]:
    clock = time.perf_counter()
    y, G = _exact(system, curve)
    J = system.noise.whitened_rows(G)
    information = np.asarray(J.T @ J)
    require_visible(system.parameters, system.parameters.prior_information, J)
    estimates = []
    chunk = max(64, int(CHUNK_BYTES / (8 * J.size)))
    for first in range(0, count, chunk):
        m = min(chunk, count - first)
        whitened = system.noise.whitened_rows(y) + rng.standard_normal((m, J.shape[0]))
        trials = Trials(system, curve.ctrl, whitened)
        estimates.append(_solve(trials, _shared(system, trials), tell))
    every = np.concatenate(estimates)
    return _statistics(
        every, np.asarray(np.linalg.inv(information)), time.perf_counter() - clock
    ), information


def _exact(system: System, curve: Trajectory) -> tuple[Array, Array]:
    """Noise-free outputs (N+1, ny) at the true values and their derivative (N+1, ny, p)."""
    exact = system.plant.derivatives.predict(system.parameters.true, curve.ctrl)
    if exact is None:
        raise SimulationDivergedError(
            "the simulation diverges at the true parameters under this control"
        )
    return exact


def _shared(system: System, trials: Trials) -> Shared:
    """Fit of the mean measurement from the guess, with its Jacobian and the Jacobian's derivative."""
    fit = FitProblem.of(system, [trials.recording(trials.measured.mean(axis=0))], data_only=True)
    theta = newton_raphson(fit, system.parameters.guess).unknowns.theta
    h = 1e-3 * system.parameters.magnitude

    def jacobian(at: Array) -> Array:
        predicted = system.plant.derivatives.predict(at, trials.ctrl)
        if predicted is None:
            raise SimulationDivergedError(
                "the simulation diverges near the fit of the mean measurement"
            )
        return system.noise.whitened_rows(predicted[1])

    J = jacobian(theta)
    bend = np.stack(
        [(jacobian(theta + e) - jacobian(theta - e)) / (2 * e.max()) for e in np.diag(h)]
    )
    return Shared(theta, J, bend, np.sqrt(np.diag(np.linalg.inv(J.T @ J))))


def _solve(trials: Trials, shared: Shared, tell: Callable[[float], None] | None) -> Array:
    """(m, p) estimates; NaN where a trial failed."""
    m = len(trials.measured)
    theta = (
        shared.theta
        + (trials.measured - trials.outputs(shared.theta[None])[0]) @ np.linalg.pinv(shared.J).T
    )
    for k in range(SHARED_STEPS - 1):
        predicted, finite = trials.outputs(theta)
        step = _gauss_newton(shared.jacobian(theta), trials.measured - predicted)
        theta = np.where(finite[:, None], theta + step, shared.theta)
        if tell is not None:
            tell((k + 1) / (SHARED_STEPS + 3))
    active = np.arange(m)
    for k in range(OWN_STEPS):
        own = Trials(trials.system, trials.ctrl, trials.measured[active])
        predicted, finite = own.outputs(theta[active])
        step = _gauss_newton(own.jacobian(theta[active], predicted), own.measured - predicted)
        step[~finite] = np.nan
        theta[active] = np.where(np.isfinite(step), theta[active] + step, shared.theta)
        small = np.nan_to_num(np.abs(step) / shared.std, nan=np.inf).max(axis=1) < CONVERGED
        active = active[~small]
        if tell is not None:
            tell(1.0 if not len(active) else (SHARED_STEPS + k + 1) / (SHARED_STEPS + k + 2))
        if not len(active):
            break
    for i in active:
        fit = FitProblem.of(trials.system, [trials.recording(trials.measured[i])], data_only=True)
        solution = least_squares(fit, shared.theta)
        theta[i] = solution.unknowns.theta if solution.success else np.nan
    return theta


def _gauss_newton(J: Array, r: Array) -> Array:
    """(m, p) steps `(J'J)^-1 J'r`; J: (m, n, p), r: (m, n)."""
    JT = np.swapaxes(J, 1, 2)
    gram, rhs = JT @ J, JT @ r[:, :, None]
    usable = np.isfinite(gram).all(axis=(1, 2)) & np.isfinite(rhs).all(axis=(1, 2))
    step = np.full((len(J), J.shape[2]), np.nan)
    step[usable] = (np.linalg.pinv(gram[usable], hermitian=True) @ rhs[usable])[:, :, 0]
    return step


def _statistics(estimates: Array, crlb: Array, seconds: float) -> TrialStatistics:
    good = estimates[np.isfinite(estimates).all(axis=1)]
    n, p = len(good), estimates.shape[1]
    if n < 2:
        blank = np.full(p, np.nan)
        return TrialStatistics(
            estimates=estimates,
            mean=blank,
            covariance=np.full((p, p), np.nan),
            crlb=crlb,
            efficiency=blank,
            efficiency_interval=np.full((p, 2), np.nan),
            trials=len(estimates),
            failed=len(estimates) - n,
            seconds=seconds,
        )
    covariance = np.atleast_2d(np.cov(good, rowvar=False))
    efficiency = np.diag(crlb) / np.diag(covariance)
    interval = efficiency[:, None] * chi2_distribution.ppf([0.025, 0.975], n - 1) / (n - 1)
    return TrialStatistics(
        estimates=estimates,
        mean=good.mean(axis=0),
        covariance=covariance,
        crlb=crlb,
        efficiency=efficiency,
        efficiency_interval=interval,
        trials=len(estimates),
        failed=len(estimates) - n,
        seconds=seconds,
    )
