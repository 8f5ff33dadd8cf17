"""Sizes of states and controls, to which difference steps, weights and thresholds are relative."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.model.sizes import (
    LEAST_MOVE_PER_SAMPLE,
    bristle_sizes,
    control_sizes,
    position_sizes,
    translations,
)
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Trajectory

# Ratio of a largest control to its natural size below which the natural size counts.
NEGLIGIBLE_CONTROL = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSizes:
    """Natural sizes of states and controls where no trajectory shows them.

    Attributes:
        space: Layout of the state.
        position: (nv,) sizes of positions, 1 for rotations [m or rad].
        translates: (nv,) True for translations.
        velocity: (nv,) speeds below which a motion counts as slow [m/s or rad/s].
        activation: (na,) sizes of activations [unit of the actuator].
        control: (nu,) sizes of controls [u-unit].
    """

    space: StateSpace
    position: Array
    translates: np.ndarray
    velocity: Array
    activation: Array
    control: Array

    @staticmethod
    def of(model: Any, space: StateSpace, dt: float) -> StateSizes:
        """Sizes of a model.

        Args:
            model: The compiled model (`mujoco.MjModel`).
            space: Layout of the state.
            dt: Sample period [s].
        """
        control = control_sizes(model, dt / LEAST_MOVE_PER_SAMPLE)

        # An activation follows the first control of its actuator. The bristle of a dry friction is
        # bent by a natural force.
        activation = np.ones(space.na)
        for address, size in bristle_sizes(model, dt / LEAST_MOVE_PER_SAMPLE).items():
            activation[address] = size
        for actuator in range(model.nactuator):
            first, count = (
                int(model.actuator_actadr[actuator]),
                int(model.actuator_actnum[actuator]),
            )
            if first >= 0 and int(model.actuator_ctrlnum[actuator]):
                activation[first : first + count] = control[int(model.actuator_ctrladr[actuator])]

        position = position_sizes(model)
        return StateSizes(
            space=space,
            position=position,
            velocity=LEAST_MOVE_PER_SAMPLE * position / dt,
            translates=translations(model),
            activation=activation,
            control=control,
        )

    @property
    def state(self) -> Array:
        """(nx,) natural sizes of the state [x-unit]."""
        return np.concatenate([self.position, self.velocity, self.activation])

    def along(self, trajectory: Trajectory, least_speed: Array | None = None) -> Array:
        """Sizes along a trajectory.

        Args:
            trajectory: The trajectory.
            least_speed: (nv,) speeds below which a coordinate counts as slow [m/s or rad/s];
                default: `velocity`.

        Returns:
            (nx+nu,) largest values along the trajectory; natural sizes where they are larger, and
            for rotations [x-unit, u-unit].
        """
        if least_speed is None:
            least_speed = self.velocity
        velocity = np.maximum(least_speed, np.abs(trajectory.qvel).max(axis=0, initial=0.0))
        return np.concatenate(
            [
                self._travelled(trajectory),
                velocity,
                _shown(trajectory.act, self.activation),
                _shown(trajectory.ctrl, self.control),
            ]
        )

    def _travelled(self, trajectory: Trajectory) -> Array:
        """(nv,) natural sizes, or the distance travelled by a coordinate that is no rotation."""
        scalar_q, scalar_v = self.space.scalar_q, self.space.scalar_v
        path = trajectory.qpos[:, scalar_q]
        travelled = np.abs(path - path[0]).max(axis=0, initial=0.0)

        sizes = np.array(self.position)
        farther = self.translates[scalar_v] & (travelled > sizes[scalar_v])
        sizes[scalar_v[farther]] = travelled[farther]
        return sizes


def _shown(values: Array, natural: Array) -> Array:
    """(w,) largest magnitudes of values: (N, w); natural sizes where they are negligible."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    return np.asarray(np.where(largest > NEGLIGIBLE_CONTROL * natural, largest, natural))
