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
    """Residuals of an experiment against recordings, as functions of theta. Evaluates each theta once.

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
        self._key: bytes = b""
        self._value: Residuals | None = None

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(sum(mask.sum() for mask in self.masks))

    def at(self, theta: Array) -> Residuals | None:
        """Residuals and Jacobian at theta: (p,); None where the simulation diverges."""
        key = np.asarray(theta).tobytes()
        if key != self._key:
            self._key, self._value = key, self._evaluate(np.asarray(theta))
        return self._value

    def _evaluate(self, theta: Array) -> Residuals | None:
        sigma, p = self.setup.outputs.sigma, self.setup.parameters
        rows, slopes = [], []
        for recording, mask in zip(self.recordings, self.masks, strict=True):
            predicted = self.setup.plant.predict(theta, recording.ctrl)
            if predicted is None:
                return None
            y, G = predicted
            rows.append(((y - recording.y) / sigma)[mask])
            slopes.append((G / sigma[:, None])[mask])
        weight = np.sqrt(np.diag(p.prior_information)) * (not self.data_only)
        rows.append((weight * (theta - p.guess))[weight > 0])
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
    return Recording(t, ctrl, y, names, where)


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
    if fit.at(theta0) is None:
        raise SimulationDiverged(
            f"the simulation diverges at the start {dict(zip(setup.parameters.names, theta0, strict=True))}"
        )
    solution = newton_raphson(fit, theta0) if method == "newton" else trust_region(fit, theta0)
    return _report(setup, fit, theta0, solution)


def trust_region(fit: Fit, theta0: Array) -> Solution:
    """SciPy's `least_squares` (trust-region reflective) inside the bounds."""
    p = fit.setup.parameters
    size = len(_at(fit, theta0).r)
    lower, upper = (-np.inf, np.inf) if fit.data_only else (p.lower, p.upper)

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
    final = _at(fit, solution.theta)
    information = final.J.T @ final.J
    std = standard_deviations(information)
    singular = not np.isfinite(std).all()
    covariance = np.full((len(p), len(p)), np.inf) if singular else np.asarray(np.linalg.inv(information))
    data = final.r[: fit.count]
    chi2, dof = float(data @ data), max(fit.count - len(p), 1)
    predicted = tuple(_predict(setup, solution.theta, r) for r in fit.recordings)
    near = 1e-6 * p.step
    touch = (solution.theta - p.lower < near) | (p.upper - solution.theta < near)
    at_bound = tuple(n for n, hit in zip(p.names, touch, strict=True) if hit)
    outside = (solution.theta < p.lower - near) | (solution.theta > p.upper + near)
    misfit = bool(chi2_distribution.sf(chi2, dof) < MISFIT)
    return Estimate(
        parameters=p.names,
        theta=solution.theta,
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
    """The recorded motion as a trajectory, where every scalar position was measured at most samples; else None.

    Gaps are bridged linearly; unmeasured velocities are zero. For pictures, not for estimation.
    """
    names = [f"qpos:{c.name}" for c in setup.coordinates]
    if setup.model.nq != len(names) or any(name not in recording.outputs for name in names):
        return None
    qpos = np.empty((len(recording.t), len(names)))
    for coordinate, name in zip(setup.coordinates, names, strict=True):
        column = recording.y[:, recording.outputs.index(name)]
        seen = np.isfinite(column)
        if not seen.any():
            return None
        qpos[:, coordinate.q] = np.interp(recording.t, recording.t[seen], column[seen])
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
