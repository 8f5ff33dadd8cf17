"""Least-squares estimates of repetitions of one control that differ by their noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from mjfim.parallel.budget import StopToken
from mjfim.records.trajectory import Recording

# Length of the last step, in standard deviations, below which a trial has converged.
CONVERGED_STEP = 0.03

# Number of Gauss-Newton steps with the Jacobian of the measurement without noise, which all trials
# share, and largest number of steps with the Jacobian of each trial.
SHARED_STEPS = 3
OWN_STEPS = 12

# Difference step for the Jacobian of each trial, relative to the size of each parameter.
JACOBIAN_STEP = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
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
            relative = np.nan_to_num(np.abs(step) / std, nan=np.inf)
            active = active[relative.max(axis=1) >= CONVERGED_STEP]
            if not len(active):
                break

        # Trials that have not converged go through the general solver, one by one.
        for i in active:
            if stop.requested:
                return None
            found = self._fitted(measured[i], centre)
            theta[i] = np.nan if found is None else found
        return np.asarray(theta)

    @cached_property
    def _centre(self) -> tuple[Array, Array, Array]:
        """Fit of the measurement without noise, where all trials start.

        Returns:
            (p,) parameters, (p,) their standard deviations, and the (n, p) transposed
            pseudo-inverse of the Jacobian [theta-unit].
        """
        theta = self._fitted(self.exact, self.system.parameters.guess)
        theta = self.system.parameters.true if theta is None else theta
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

    def _fitted(self, measured: Array, start: Array) -> Array | None:
        """(p,) estimate of one trial by the general solver; None where the fit fails."""
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
        problem = FitProblem.of(self.system, [recording], data_only=True)
        found = least_squares(problem, start)
        return found.unknowns.theta if found.success else None
