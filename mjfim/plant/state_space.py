"""Differences and moves on MuJoCo's configuration space, for many states at once.

This is the vectorised form of `mj_differentiatePos` and `mj_integratePos`, and tests compare it
with both. Coordinates of scalar joints are subtracted; ball joints and the rotation of free joints
use the logarithm of quaternions in the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array, record
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    bristle_sizes,
    control_sizes,
    position_sizes,
    translations,
)
from mjfim.records.trajectory import Trajectory

# Angle below which the derivative of the logarithm uses the limit of its second-order term [rad].
SMALL_ANGLE = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class StateSpace:
    """Layout of states and of their tangent vectors.

    A state (qpos, qvel, act) has ns numbers, a tangent vector (dq, dv, da) has nx numbers.

    Attributes:
        nq: Length of qpos.
        nv: Length of qvel.
        na: Length of act.
        scalar_q: (n,) addresses in qpos of the coordinates that belong to no quaternion.
        scalar_v: (n,) addresses in qvel of these coordinates.
        quaternions: Pairs (address in qpos, address in qvel), one per ball or free joint.
    """

    nq: int
    nv: int
    na: int
    scalar_q: NDArray[np.intp]
    scalar_v: NDArray[np.intp]
    quaternions: tuple[tuple[int, int], ...]

    @property
    def nx(self) -> int:
        """Dimension of the tangent space, 2 nv + na."""
        return 2 * self.nv + self.na

    def split(self, state: Array) -> tuple[Array, Array, Array]:
        """Components of a state.

        Args:
            state: (..., ns) states.

        Returns:
            qpos (..., nq), qvel (..., nv) and act (..., na), views of the state.
        """
        velocity = self.nq
        activation = self.nq + self.nv
        return state[..., :velocity], state[..., velocity:activation], state[..., activation:]

    def plus(self, state: Array, dx: Array) -> Array:
        """State moved along a tangent vector; leading axes broadcast.

        Args:
            state: (..., ns) states.
            dx: (..., nx) tangent vectors.

        Returns:
            (..., ns) moved states.
        """
        if not self.quaternions:
            return state + dx

        shape = np.broadcast_shapes(state.shape[:-1], dx.shape[:-1])
        out = np.array(np.broadcast_to(state, (*shape, state.shape[-1])))
        out[..., self.scalar_q] += dx[..., self.scalar_v]
        out[..., self.nq :] += dx[..., self.nv :]
        for q, v in self.quaternions:
            turn = exponential(dx[..., v : v + 3])
            out[..., q : q + 4] = quaternion_product(out[..., q : q + 4], turn)
        return out

    def minus(self, state: Array, origin: Array) -> Array:
        """Tangent vector dx with `origin plus dx = state`; leading axes broadcast.

        Args:
            state: (..., ns) states.
            origin: (..., ns) states from which the difference is taken.

        Returns:
            (..., nx) tangent vectors.
        """
        if not self.quaternions:
            return state - origin

        shape = np.broadcast_shapes(state.shape[:-1], origin.shape[:-1])
        out = np.empty((*shape, self.nx))
        out[..., self.scalar_v] = state[..., self.scalar_q] - origin[..., self.scalar_q]
        out[..., self.nv :] = state[..., self.nq :] - origin[..., self.nq :]
        for q, v in self.quaternions:
            conjugate = origin[..., q : q + 4] * np.array([1.0, -1.0, -1.0, -1.0])
            out[..., v : v + 3] = logarithm(quaternion_product(conjugate, state[..., q : q + 4]))
        return out

    def minus_derivative(self, dx: Array) -> Array:
        """Derivative of `minus` by a move of its first argument along the tangent space there.

        Args:
            dx: (nx,) value of `minus`.

        Returns:
            (nx, nx) derivative.
        """
        out = np.eye(self.nx)
        for _, v in self.quaternions:
            out[v : v + 3, v : v + 3] = logarithm_derivative(dx[v : v + 3])
        return out


def quaternion_product(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions.

    Args:
        a: (..., 4) quaternions (w, x, y, z).
        b: (..., 4) quaternions (w, x, y, z).

    Returns:
        (..., 4) products a b.
    """
    a_real, a_vector = a[..., :1], a[..., 1:]
    b_real, b_vector = b[..., :1], b[..., 1:]
    real = a_real * b_real - np.sum(a_vector * b_vector, axis=-1, keepdims=True)
    vector = a_real * b_vector + b_real * a_vector + np.cross(a_vector, b_vector)
    return np.concatenate([real, vector], axis=-1)


def exponential(rotation: Array) -> Array:
    """Unit quaternion of a rotation vector.

    Args:
        rotation: (..., 3) rotation vectors [rad].

    Returns:
        (..., 4) unit quaternions (w, x, y, z).
    """
    half_angle = 0.5 * np.linalg.norm(rotation, axis=-1, keepdims=True)
    vector = 0.5 * rotation * np.sinc(half_angle / np.pi)
    return np.concatenate([np.cos(half_angle), vector], axis=-1)


def logarithm(quaternion: Array) -> Array:
    """Rotation vector of a unit quaternion, at most pi long.

    Args:
        quaternion: (..., 4) unit quaternions (w, x, y, z).

    Returns:
        (..., 3) rotation vectors [rad].
    """
    real, vector = quaternion[..., :1], quaternion[..., 1:]
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(length, np.abs(real))

    # A quaternion and its negative describe one rotation. The one with a positive real part gives
    # the shorter rotation vector.
    sign = np.where(real < 0.0, -1.0, 1.0)
    safe_length = np.where(length > 0.0, length, 1.0)
    return sign * vector * np.where(length > 0.0, angle / safe_length, 2.0)


def logarithm_derivative(rotation: Array) -> Array:
    """Derivative by e of the rotation vector of `exponential(rotation) * exponential(e)` at e = 0.

    Args:
        rotation: (3,) rotation vector shorter than pi [rad].

    Returns:
        (3, 3) derivative.
    """
    x, y, z = rotation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(rotation))

    second_order = 1.0 / 12.0
    if angle > SMALL_ANGLE:
        second_order = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    return np.asarray(np.eye(3) + 0.5 * cross + second_order * cross @ cross)


# Ratio of a largest control to its natural size below which the natural size counts.
NEGLIGIBLE_CONTROL = 1e-3


@record
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
            first = model.actuator_actadr[actuator]
            count = model.actuator_actnum[actuator]
            if first >= 0 and model.actuator_ctrlnum[actuator]:
                activation[first : first + count] = control[model.actuator_ctrladr[actuator]]

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

        # The distance travelled by a coordinate that is no rotation counts where it is larger.
        scalar_q, scalar_v = self.space.scalar_q, self.space.scalar_v
        path = trajectory.qpos[:, scalar_q]
        travelled = np.abs(path - path[0]).max(axis=0, initial=0.0)
        position = np.array(self.position)
        farther = self.translates[scalar_v] & (travelled > position[scalar_v])
        position[scalar_v[farther]] = travelled[farther]
        return np.concatenate(
            [
                position,
                velocity,
                _shown(trajectory.act, self.activation),
                _shown(trajectory.ctrl, self.control),
            ]
        )


def _shown(values: Array, natural: Array) -> Array:
    """(w,) largest magnitudes of values: (N, w); natural sizes where they are negligible."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    return np.where(largest > NEGLIGIBLE_CONTROL * natural, largest, natural)
