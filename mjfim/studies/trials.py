"""Least-squares estimates of repetitions that differ by their noise, all stepped together.

Each trial minimises its squared residual, in four steps:

1. A fit of the measurement without noise leads from the guess to a point near the minima of all
   trials.
2. Gauss-Newton steps with a shared Jacobian, which is expanded to second order about that fit,
   bring each trial close to its minimum.
3. Gauss-Newton steps with the Jacobian of each trial finish it. A trial has converged when its last
   step is small compared with its standard deviation.
4. The few trials that have not converged are solved one by one with the least-squares solver of
   `identify`. A trial that this does not solve has failed.

The estimate of a trial does not depend on the trials that are stepped together with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares, newton_raphson
from mjfim.records.trajectory import Recording

# Length of the last step, in standard deviations, below which a trial has converged.
CONVERGED_STEP = 0.03

# Number of Gauss-Newton steps with the shared Jacobian, including the first one from the fit of the
# measurement without noise.
SHARED_STEPS = 3

# Largest number of Gauss-Newton steps with the Jacobian of each trial.
INDIVIDUAL_STEPS = 12

# Difference step for the Jacobian of each trial, relative to the size of each parameter.
JACOBIAN_STEP = 1e-6

# Difference step for the derivative of the shared Jacobian, relative to the size of each parameter.
CURVATURE_STEP = 1e-3


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedFit:
    """Fit of the measurement without noise, from which all trials start.

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
        flat = self.curvature.reshape(len(self.curvature), -1)
        change = _times_each(theta - self.theta, flat).reshape(len(theta), *self.J.shape)
        return np.asarray(self.J + change)


@dataclass(frozen=True, eq=False, kw_only=True)
class Trials:
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

    def part(self, indices: np.ndarray) -> Trials:
        """The trials with some indices."""
        return Trials(system=self.system, ctrl=self.ctrl, measured=self.measured[indices])

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


def fit_without_noise(exact: Trials) -> SharedFit:
    """Fit the measurement without noise from the guess, and differentiate its Jacobian.

    Args:
        exact: One trial whose measurement has no noise.

    Raises:
        SimulationDivergedError: The simulation diverges near the fit.
    """
    system = exact.system
    fit = exact.fit_problem(exact.measured[0])
    theta = newton_raphson(fit, system.parameters.guess).unknowns.theta

    def jacobian(at: Array) -> Array:
        """(n, p) whitened Jacobian at (p,) parameters."""
        predicted = system.plant.derivatives.predict(at, exact.ctrl)
        if predicted is None:
            raise SimulationDivergedError(
                "the simulation diverges near the fit of the measurement without noise"
            )
        return system.noise.whitened_rows(predicted[1])

    J = jacobian(theta)
    curvature = []
    for step in np.diag(CURVATURE_STEP * system.parameters.magnitude):
        change = jacobian(theta + step) - jacobian(theta - step)
        curvature.append(change / (2 * step.max()))

    return SharedFit(
        theta=theta,
        J=J,
        curvature=np.stack(curvature),
        std=np.sqrt(np.diag(np.linalg.inv(J.T @ J))),
    )


def estimated(
    trials: Trials, shared: SharedFit, report: Callable[[float], None], budget: Budget
) -> Array | None:
    """Estimate the parameters of all trials.

    Args:
        trials: The m trials.
        shared: Fit of the measurement without noise.
        report: Called with the share that is done.
        budget: Ends the work early.

    Returns:
        (m, p) estimates [theta-unit], NaN where a trial failed; None after a request to stop.
    """
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
    trials: Trials, shared: SharedFit, report: Callable[[float], None], budget: Budget
) -> Array | None:
    """(m, p) estimates after the steps with the shared Jacobian; None after an interruption."""
    predicted, _ = trials.outputs(shared.theta[None])
    theta = shared.theta + _times_each(
        trials.measured - predicted, np.asarray(np.linalg.pinv(shared.J).T, dtype=np.float64)
    )

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
    trials: Trials,
    shared: SharedFit,
    theta: Array,
    report: Callable[[float], None],
    budget: Budget,
) -> np.ndarray:
    """Step each trial with its Jacobian until it has converged.

    Args:
        trials: The m trials.
        shared: Fit of the measurement without noise.
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


def _times_each(rows: Array, matrix: Array) -> Array:
    """Multiply each of m rows, (m, k), by a (k, l) matrix.

    A product of all rows would round a row differently if there are other rows beside it, and so
    would rows that are not contiguous.
    """
    each = np.ascontiguousarray(rows)[:, None, :]
    return np.asarray((each @ matrix)[:, 0], dtype=np.float64)


def _gauss_newton(J: Array, residual: Array) -> Array:
    """Gauss-Newton steps `(J'J)^-1 J'r` of all trials.

    Args:
        J: (m, n, p) Jacobians [1 / theta-unit].
        residual: (m, n) whitened residuals.

    Returns:
        (m, p) steps [theta-unit]; NaN where a Jacobian or a residual is not finite.
    """
    # Products of contiguous arrays do not depend on the number of trials.
    J, residual = np.ascontiguousarray(J), np.ascontiguousarray(residual)
    JT = np.swapaxes(J, 1, 2)
    gram = JT @ J
    projected = JT @ residual[:, :, None]

    usable = np.isfinite(gram).all(axis=(1, 2)) & np.isfinite(projected).all(axis=(1, 2))
    inverse = np.linalg.pinv(gram[usable], hermitian=True)
    step = np.full((len(J), J.shape[2]), np.nan)
    step[usable] = (inverse @ projected[usable])[:, :, 0]
    return step
