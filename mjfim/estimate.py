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

from mjfim.earlier import shared
from mjfim.errors import ExperimentError, SimulationDiverged, unknown
from mjfim.experiment import Experiment
from mjfim.fisher import standard_deviations
from mjfim.identifiability import Null, grouped, invisible
from mjfim.residuals import Fit, Residuals
from mjfim.setup import Setup
from mjfim.trajectory import Array, Estimate, Recording

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
    null = _null(setup, fit, theta0)
    fit.pin(theta0, null)
    solve = newton_raphson if method == "newton" else trust_region
    solution = solve(fit, fit.whole(theta0))
    return _report(setup, fit, theta0, solution, null)


def _null(setup: Setup, fit: Fit, theta: Array) -> Null:
    """Directions of theta that neither the recordings nor the priors tell, at the start of the search."""
    p = setup.parameters
    J, error = (np.concatenate(part) for part in zip(*fit.sensed(theta), strict=True))
    weight = np.sqrt(np.diag(np.diag(p.prior_information)))
    J, error = np.concatenate([J, weight]), np.concatenate([error, np.zeros_like(weight)])
    return invisible(J, error, p.step, p.scale, np.arange(len(p)), np.zeros_like(weight))


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


def _report(setup: Setup, fit: Fit, theta0: Array, solution: Solution, null: Null) -> Estimate:
    p = setup.parameters
    final, theta = _at(fit, solution.theta), solution.theta[: len(p)]
    information = final.J.T @ final.J
    std = standard_deviations(information)[: len(p)]
    singular = not np.isfinite(std).all()
    blank = np.full((len(p), len(p)), np.inf)
    covariance = blank if singular else np.asarray(np.linalg.inv(information))[: len(p), : len(p)]
    groups = grouped(null, p.names, p.step, [q.unit for q in p.parameters])
    together = np.isin(p.names, [name for group in groups for name in group.members])
    std = np.where(together, np.inf, std)
    covariance = np.where(np.logical_or.outer(together, together), np.inf, covariance)
    lost = together & np.array([not q.group for q in p.parameters])
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
        success=solution.success and not singular and not outside.any() and not lost.any(),
        misfit=misfit,
        iterations=solution.iterations,
        residual_rms=_rms(setup, fit, predicted),
        at_bound=at_bound,
        predicted=predicted,
        recordings=tuple(fit.recordings),
        warnings=(
            *(f"the recordings tell {group}; the rest was held at the start" for group in groups),
            *_warnings(chi2, dof, misfit, at_bound, singular, bool(outside.any())),
        ),
        combinations=tuple(str(group) for group in groups),
        data=_data(fit, final),
    )


def _data(fit: Fit, final: Residuals) -> Array:
    """(p, p) information of the recordings alone, every start's own deviation marginalised."""
    p, J = fit.setup.parameters, final.J[: fit.count]
    information = J.T @ J
    private = np.concatenate([p.private, np.ones(len(information) - len(p), dtype=bool)])
    prior = np.diag(fit.whole(np.diag(p.prior_information)))
    return shared(information, prior, private)[: len(p), : len(p)]


def _predict(setup: Setup, theta: Array, recording: Recording) -> Array:
    y, _ = setup.plant.measure(theta[None], recording.ctrl)
    return np.asarray(y[0])


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
