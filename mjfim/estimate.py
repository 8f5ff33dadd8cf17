"""Batch least squares in MuJoCo: `min_theta sum_k |Sigma^-1/2 (y~_k - y_k(theta))|^2` over one or several recordings.

The Jacobian is the sensitivity G = dy/dtheta. `newton` is the paper's Newton-Raphson with the Hessian of its Fisher
information (Gauss-Newton); the default is SciPy's trust-region solver, which respects bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_distribution

from mjfim.errors import ExperimentError, RecordingError, SimulationDiverged, unknown
from mjfim.experiment import Experiment
from mjfim.fisher import standard_deviations
from mjfim.sensing import components
from mjfim.setup import Setup
from mjfim.trajectory import Array, Estimate, Recording, Trajectory

MISFIT = 1e-3
# of scipy.optimize.least_squares, by status
OUTCOMES = {
    0: "not converged: the limit of evaluations was reached",
    1: "converged: the gradient vanished",
    2: "converged: the residual stopped falling",
    3: "converged: the step vanished",
    4: "converged: neither step nor residual changed any more",
}
Method = Literal["least_squares", "newton"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of all recordings, prior rows last, and their Jacobian. r: (n,), J: (n, p)."""

    r: Array
    J: Array


class Fit:
    """Residuals of an experiment against recordings, as functions of the unknowns. Evaluates each of them once.

    The unknowns are theta, whose start deviations are those of the first recording, then the start deviations of every
    further recording.
    data_only: leave priors and bounds out
    """

    def __init__(self, setup: Setup, recordings: Sequence[Recording], data_only: bool = False) -> None:
        self.setup = setup
        self.data_only = data_only
        self.recordings = [aligned(setup, r) for r in recordings]
        if not self.recordings:
            raise RecordingError("identify needs at least one recording")
        self.masks = [_used(r) for r in self.recordings]
        if not any(mask.any() for mask in self.masks):
            raise RecordingError("the recordings hold no measured value after t = 0")
        p = setup.parameters
        self.starts = np.flatnonzero(p.start(setup.space.nx).any(axis=0))
        self._key: bytes = b""
        self._value: Residuals | None = None

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(sum(mask.sum() for mask in self.masks))

    def whole(self, theta: Array) -> Array:
        """Unknowns from theta: (p,), every recording starting as the first."""
        return np.concatenate([theta, np.tile(theta[self.starts], len(self.recordings) - 1)])

    def of(self, unknowns: Array, recording: int) -> Array:
        """(p,) theta of one recording."""
        theta, further = np.array(unknowns[: len(self.setup.parameters)]), unknowns[len(self.setup.parameters) :]
        if recording and len(self.starts):
            theta[self.starts] = further.reshape(-1, len(self.starts))[recording - 1]
        return theta

    def _columns(self, recording: int) -> np.ndarray:
        """(p,) places of one recording's theta among the unknowns."""
        places = np.arange(len(self.setup.parameters))
        if recording:
            places[self.starts] = len(places) + (recording - 1) * len(self.starts) + np.arange(len(self.starts))
        return places

    def at(self, theta: Array) -> Residuals | None:
        """Residuals and Jacobian at the unknowns; None where the simulation diverges."""
        key = np.asarray(theta).tobytes()
        if key != self._key:
            self._key, self._value = key, self._evaluate(np.asarray(theta))
        return self._value

    def _evaluate(self, theta: Array) -> Residuals | None:
        noise, p = self.setup.noise, self.setup.parameters
        rows, slopes = [], []
        for i, (recording, mask) in enumerate(zip(self.recordings, self.masks, strict=True)):
            predicted = self.setup.plant.predict(self.of(theta, i), recording.ctrl)
            if predicted is None:
                return None
            y, G = predicted
            rows.append(noise.whiten_present(np.where(mask, y - recording.y, 0.0), mask))
            own = noise.whiten_present(G, mask)
            slopes.append(np.zeros((len(own), len(theta))))
            slopes[-1][:, self._columns(i)] = own
        weight = self.whole(np.sqrt(np.diag(p.prior_information)) * (not self.data_only))
        rows.append((weight * (theta - self.whole(p.guess)))[weight > 0])
        slopes.append(np.diag(weight)[weight > 0])
        return Residuals(np.concatenate(rows), np.concatenate(slopes))


def aligned(setup: Setup, recording: Recording) -> Recording:
    """The recording on the experiment's sample grid and in the order of its outputs (absent ones NaN).

    Raises RecordingError where time, control or columns do not fit.
    """
    names, where = setup.outputs.names, recording.name
    t = recording.t - recording.t[0]
    if len(t) < 3:
        raise RecordingError(f"{where}: too few rows ({len(t)}); an identification needs at least 3")
    if np.abs(t - np.arange(len(t)) * setup.dt).max() > 0.01 * setup.dt:
        raise RecordingError(f"{where}: column 't' is not the experiment's grid of {setup.experiment.rate:g} Hz")
    ctrl = recording.ctrl[: len(t) - 1]
    if not np.isfinite(ctrl).all():
        row = int(np.argmax(~np.isfinite(ctrl).all(axis=1)))
        raise RecordingError(f"{where}: the control in data row {row + 1} is NaN; only the last row may leave it out")
    shared = [name for name in names if name in recording.outputs]
    if not shared:
        raise RecordingError(f"{where}: no measured column; {unknown('column', ', '.join(recording.outputs), names)}")
    y = np.full((len(t), len(names)), np.nan)
    for name in shared:
        y[:, names.index(name)] = recording.y[:, recording.outputs.index(name)]
    return Recording(t, ctrl, _continuous(setup, y), names, where)


def _continuous(setup: Setup, y: Array) -> Array:
    """Measured quaternions with the sign that follows from the start: q and -q are one orientation."""
    start = setup.plant.nominal_start
    for q, _ in setup.space.quaternions:
        found = [(i, o.state) for i, o in enumerate(setup.outputs.outputs) if o.state is not None]
        at, states = [i for i, s in found if q <= s < q + 4], [s for _, s in found if q <= s < q + 4]
        last = start[states]
        for row in y:
            if at and np.isfinite(row[at]).all():
                row[at] *= 1.0 if last @ row[at] >= 0.0 else -1.0
                last = np.array(row[at])
    return y


def _used(recording: Recording) -> np.ndarray:
    """Measured values after the known start, (N+1, ny)."""
    mask = np.isfinite(recording.y)
    mask[0] = False
    return mask


@dataclass(frozen=True, eq=False)
class Solution:
    """Where a solver ended."""

    theta: Array
    iterations: int
    success: bool
    status: str


def identify(
    experiment: Experiment | Setup,
    recordings: Sequence[Recording],
    method: Method = "least_squares",
    start: Array | None = None,
) -> Estimate:
    """Estimate the parameters from recordings, starting at the guess (or `start`: (p,)).

    The stated std is formal: it is accuracy only if the model and the noise are right; `misfit` says when they are not.
    Raises RecordingError for unusable recordings, SimulationDiverged where the model diverges at the start.
    """
    if method not in get_args(Method):
        raise ExperimentError(unknown("method", method, get_args(Method)))
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment)
    fit = Fit(setup, recordings)
    theta0 = setup.parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    if theta0.shape != setup.parameters.guess.shape:
        raise ExperimentError(
            f"start: {theta0.shape} numbers, wanted one per parameter: {', '.join(setup.parameters.names)}"
        )
    if fit.at(fit.whole(theta0)) is None:
        raise SimulationDiverged(
            f"the simulation diverges at the start {dict(zip(setup.parameters.names, theta0, strict=True))}"
        )
    solve = newton_raphson if method == "newton" else trust_region
    solution = solve(fit, fit.whole(theta0))
    return _report(setup, fit, theta0, solution)


def trust_region(fit: Fit, theta0: Array) -> Solution:
    """SciPy's `least_squares` (trust-region reflective) inside the bounds."""
    p = fit.setup.parameters
    size = len(_at(fit, theta0).r)
    lower, upper = (-np.inf, np.inf) if fit.data_only else (fit.whole(p.lower), fit.whole(p.upper))

    def residual(theta: Array) -> Array:
        value = fit.at(theta)
        return np.full(size, np.inf) if value is None else value.r

    inside = np.clip(theta0, np.nextafter(lower, np.inf), np.nextafter(upper, -np.inf))
    result = least_squares(
        residual,
        inside,
        lambda theta: _at(fit, theta).J,
        (lower, upper),
        x_scale="jac",
        ftol=1e-12,
        xtol=1e-10,
        gtol=1e-10,
    )
    return Solution(result.x, int(result.nfev), bool(result.success), OUTCOMES.get(result.status, str(result.message)))


def newton_raphson(fit: Fit, theta0: Array, iterations: int = 50, tolerance: float = 1e-5) -> Solution:
    """The paper's iterator `theta - (J'J)^-1 J'r`, its step halved while the residual would grow.

    Stops when a step is below tolerance standard deviations in every direction. Bounds are not used.
    """
    theta = np.array(theta0)
    for k in range(iterations):
        now = _at(fit, theta)
        step, *_ = np.linalg.lstsq(now.J, -now.r, rcond=None)
        if np.linalg.norm(now.J @ step) < tolerance:
            return Solution(theta, k, True, "converged: the Newton-Raphson step vanished")
        gamma = 1.0
        while True:
            trial = fit.at(theta + gamma * step)
            if trial is not None and trial.r @ trial.r <= now.r @ now.r:
                break
            gamma *= 0.5
            if gamma < 1e-8:
                done = bool(np.linalg.norm(now.J @ step) < 1e-3)
                return Solution(theta, k, done, "stopped: no step along Newton-Raphson lowers the residual")
        theta = theta + gamma * step
    return Solution(theta, iterations, False, f"not converged in {iterations} Newton-Raphson iterations")


def _at(fit: Fit, theta: Array) -> Residuals:
    value = fit.at(theta)
    if value is None:
        raise SimulationDiverged("the simulation diverges near the estimate")
    return value


def _report(setup: Setup, fit: Fit, theta0: Array, solution: Solution) -> Estimate:
    p = setup.parameters
    final, theta = _at(fit, solution.theta), solution.theta[: len(p)]
    information = final.J.T @ final.J
    std = standard_deviations(information)[: len(p)]
    singular = not np.isfinite(std).all()
    blank = np.full((len(p), len(p)), np.inf)
    covariance = blank if singular else np.asarray(np.linalg.inv(information))[: len(p), : len(p)]
    data = final.r[: fit.count]
    chi2, dof = float(data @ data), max(fit.count - len(solution.theta), 1)
    predicted = tuple(_predict(setup, fit.of(solution.theta, i), r) for i, r in enumerate(fit.recordings))
    near = 1e-6 * p.step
    touch = (theta - p.lower < near) | (p.upper - theta < near)
    at_bound = tuple(n for n, hit in zip(p.names, touch, strict=True) if hit)
    outside = (theta < p.lower - near) | (theta > p.upper + near)
    misfit = bool(chi2_distribution.sf(chi2, dof) < MISFIT)
    return Estimate(
        parameters=p.names,
        theta=theta,
        std=std,
        covariance=covariance,
        initial_theta=theta0,
        chi2=chi2,
        dof=dof,
        status=solution.status,
        success=solution.success and not singular and not outside.any(),
        misfit=misfit,
        iterations=solution.iterations,
        residual_rms=_rms(setup, fit, predicted),
        at_bound=at_bound,
        predicted=predicted,
        recordings=tuple(fit.recordings),
        warnings=tuple(_warnings(chi2, dof, misfit, at_bound, singular, bool(outside.any()))),
    )


def _predict(setup: Setup, theta: Array, recording: Recording) -> Array:
    y, _ = setup.plant.measure(theta[None], recording.ctrl)
    return np.asarray(y[0])


def measured_trajectory(setup: Setup, recording: Recording) -> Trajectory | None:
    """The recorded motion as a trajectory, where every position was measured at most samples; else None.

    Gaps are bridged linearly; unmeasured velocities are zero. For pictures, not for estimation.
    """
    positions = [c for c in components(setup.model) if c.state < setup.model.nq]
    if any(c.name not in recording.outputs for c in positions):
        return None
    qpos = np.empty((len(recording.t), setup.model.nq))
    for component in positions:
        column = recording.y[:, recording.outputs.index(component.name)]
        seen = np.isfinite(column)
        if not seen.any():
            return None
        qpos[:, component.state] = np.interp(recording.t, recording.t[seen], column[seen])
    for q, _ in setup.space.quaternions:
        qpos[:, q : q + 4] /= np.maximum(np.linalg.norm(qpos[:, q : q + 4], axis=1, keepdims=True), 1e-12)
    n = len(qpos)
    return Trajectory(recording.t, qpos, np.zeros((n, setup.model.nv)), np.zeros((n, setup.model.na)), recording.ctrl)


def _rms(setup: Setup, fit: Fit, predicted: tuple[Array, ...]) -> dict[str, float]:
    values = {}
    for i, name in enumerate(setup.outputs.names):
        parts = [(y[:, i] - r.y[:, i])[m[:, i]] for y, r, m in zip(predicted, fit.recordings, fit.masks, strict=True)]
        joined = np.concatenate(parts)
        if len(joined):
            values[name] = float(np.sqrt(np.mean(joined**2)))
    return values


def _warnings(
    chi2: float, dof: int, misfit: bool, at_bound: tuple[str, ...], singular: bool, outside: bool
) -> list[str]:
    found = []
    if singular:
        found.append("the recordings do not determine all parameters: the information is singular")
    if misfit:
        found.append(
            f"misfit: residuals are {np.sqrt(chi2 / dof):.2f} x the stated noise; the model or the noise is wrong, and the "
            "formal standard errors are not accuracy"
        )
    elif chi2_distribution.cdf(chi2, dof) < MISFIT:
        found.append(f"residuals are only {np.sqrt(chi2 / dof):.2f} x the stated noise: sigma is overstated")
    if outside:
        found.append(f"outside its bounds, which newton does not keep: {', '.join(at_bound)}; use least_squares")
    elif at_bound:
        found.append(f"at a bound: {', '.join(at_bound)}; the formal standard errors do not hold there")
    return found
