"""Derivatives of observations within samples, from derivatives of their engine steps."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.closed_form import SampleJacobians, advance, by_state_and_control, unmoved


def observation_jacobian(
    found: SampleJacobians, ctrl: Array, observations: SubstepObservations
) -> Array | None:
    """Derivatives of observations by state and control.

    Args:
        found: Derivatives of N samples.
        ctrl: (N, nu) controls of the samples.
        observations: The w observed quantities.

    Returns:
        (N, S, w, nx+nu) derivatives at the S rows of `SubstepObservations.derivative_rows`; None
        for quantities that have none here.
    """
    if observations.has_stages or len(observations.turns) or len(observations.tendon_lengths):
        return None

    samples = _ObservedSamples(found, ctrl, observations)
    AB = unmoved(found.accelerations)
    rows = []
    for i in range(found.accelerations.shape[1]):
        acceleration = by_state_and_control(found.accelerations[:, i], AB)
        forces = samples.forces(i, AB)
        advance(AB, acceleration, observations.timestep)
        if i + 1 in observations.derivative_substeps:
            rows.append(np.concatenate([samples.motion(AB, acceleration), forces], axis=1))

    # The further row has the forces at the end of the sample.
    if observations.force_rows:
        forces = samples.forces(found.accelerations.shape[1], AB)
        motion = rows[-1][:, : rows[-1].shape[1] - forces.shape[1]]
        rows.append(np.concatenate([motion, forces], axis=1))
    return np.stack(rows, axis=1)


class _ObservedSamples:
    """Derivatives of the observations at single engine steps of samples."""

    def __init__(
        self, found: SampleJacobians, ctrl: Array, observations: SubstepObservations
    ) -> None:
        """Set the samples, their controls and the observations."""
        self.found, self.ctrl, self.observations = found, ctrl, observations

    def motion(self, AB: Array, acceleration: Array) -> Array:
        """(N, m, nx+nu) derivatives of positions, speeds and accelerations.

        Args:
            AB: (N, 2 nv, nx+nu) derivatives of the state after an engine step.
            acceleration: (N, nv, nx+nu) derivatives of the mean acceleration of the step.
        """
        wanted, nv = self.observations, acceleration.shape[1]
        return np.concatenate(
            [
                AB[:, wanted.positions],
                AB[:, nv + wanted.velocities],
                acceleration[:, wanted.accelerations],
            ],
            axis=1,
        )

    def forces(self, step: int, AB: Array) -> Array:
        """(N, f, nx+nu) derivatives of the forces that belong to the state before an engine step.

        Args:
            step: Number of the engine step, from 0.
            AB: (N, 2 nv, nx+nu) derivatives of the state before it.
        """
        wanted = self.observations
        if not wanted.fields:
            return np.zeros((len(AB), 0, AB.shape[2]))

        slopes = self.found.forces.actuator_slopes(self.found.states[:, step], self.ctrl)
        actuators = by_state_and_control(slopes, AB)
        joints = self.found.forces.moments.T @ actuators
        tendons = [actuators[:, list(pulling)].sum(axis=1) for pulling in wanted.tendon_forces]
        parts = [actuators[:, wanted.actuator_forces], joints[:, wanted.joint_forces]]
        if tendons:
            parts.append(np.stack(tendons, axis=1))
        return np.concatenate(parts, axis=1)
