"""Differences and steps on MuJoCo's configuration space, for many states at once.

The vectorised counterpart of `mj_differentiatePos` and `mj_integratePos` (tests hold it against both):
scalar joints subtract, ball joints and the rotation of free joints use the quaternion logarithm in the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array


@dataclass(frozen=True, eq=False)
class StateSpace:
    """Layout of states (qpos, qvel, act) and of their tangent vectors (dq, dv, da).

    quaternions: pairs (qpos address, dof address), one per ball or free joint
    scalar_q, scalar_v: addresses of every other coordinate, in the same order
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
        """(..., nq+nv+na) -> qpos, qvel, act (views)."""
        nq, nv = self.nq, self.nv
        return state[..., :nq], state[..., nq : nq + nv], state[..., nq + nv :]

    def plus(self, state: Array, dx: Array) -> Array:
        """State moved along a tangent vector; broadcasts. state: (..., nq+nv+na), dx: (..., nx)."""
        if not self.quaternions:
            return state + dx
        nq, nv = self.nq, self.nv
        shape = np.broadcast_shapes(state.shape[:-1], dx.shape[:-1])
        out = np.array(np.broadcast_to(state, (*shape, state.shape[-1])))
        out[..., self.scalar_q] += dx[..., self.scalar_v]
        out[..., nq:] += dx[..., nv:]
        for q, v in self.quaternions:
            out[..., q : q + 4] = quaternion_product(
                out[..., q : q + 4], exponential(dx[..., v : v + 3])
            )
        return out

    def minus(self, state: Array, origin: Array) -> Array:
        """Tangent vector dx with `origin plus dx = state`; broadcasts. Returns (..., nx)."""
        if not self.quaternions:
            return state - origin
        nq, nv = self.nq, self.nv
        shape = np.broadcast_shapes(state.shape[:-1], origin.shape[:-1])
        out = np.empty((*shape, self.nx))
        out[..., self.scalar_v] = state[..., self.scalar_q] - origin[..., self.scalar_q]
        out[..., nv:] = state[..., nq:] - origin[..., nq:]
        for q, v in self.quaternions:
            conjugate = origin[..., q : q + 4] * np.array([1.0, -1.0, -1.0, -1.0])
            out[..., v : v + 3] = logarithm(quaternion_product(conjugate, state[..., q : q + 4]))
        return out

    def minus_slope(self, dx: Array) -> Array:
        """(nx, nx) derivative of `minus` by a move of its state along the tangent space there, where it is dx: (nx,)."""
        out = np.eye(self.nx)
        for _, v in self.quaternions:
            out[v : v + 3, v : v + 3] = logarithm_slope(dx[v : v + 3])
        return out


def quaternion_product(a: Array, b: Array) -> Array:
    """Hamilton product of (w, x, y, z) quaternions, (..., 4)."""
    aw, av, bw, bv = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    scalar = aw * bw - np.sum(av * bv, axis=-1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], axis=-1)


def exponential(rotation: Array) -> Array:
    """Unit quaternion of a rotation vector [rad], (..., 3) -> (..., 4)."""
    half = 0.5 * np.linalg.norm(rotation, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * rotation * np.sinc(half / np.pi)], axis=-1)


def logarithm(quaternion: Array) -> Array:
    """Rotation vector [rad], at most pi long, of a unit quaternion, (..., 4) -> (..., 3)."""
    w, v = quaternion[..., :1], quaternion[..., 1:]
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(length, np.abs(w))
    safe = np.where(length > 0.0, length, 1.0)
    return np.where(w < 0.0, -1.0, 1.0) * v * np.where(length > 0.0, angle / safe, 2.0)


def logarithm_slope(rotation: Array) -> Array:
    """(3, 3) derivative by e of the rotation vector of `exponential(rotation) * exponential(e)`; rotation: (3,), below pi."""
    x, y, z = rotation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = float(np.linalg.norm(rotation))
    bend = 1.0 / 12.0
    if angle > 1e-3:
        bend = (1.0 - 0.5 * angle / np.tan(0.5 * angle)) / angle**2
    return np.asarray(np.eye(3) + 0.5 * cross + bend * cross @ cross)
