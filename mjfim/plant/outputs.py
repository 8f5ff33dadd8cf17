"""Measured outputs: which components of the state and which sensors are recorded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.plant.state_space import StateSpace, quaternion_product


@dataclass(frozen=True)
class Output:
    """One measured scalar.

    name: column name in recordings;  sigma: 1-sigma noise in its unit
    state: address in the state vector (qpos, qvel, act) of a measured component, or None
    sensor: address in sensordata, or None
    """

    name: str
    sigma: float
    unit: str = ""
    state: int | None = None
    sensor: int | None = None


@dataclass(frozen=True, eq=False)
class OutputMap:
    """The vector `y = h(x, u, theta)`: (ny,) in the order of `outputs`.

    States are scalar coordinates or components of quaternions, for which h and its derivatives are known exactly.
    """

    outputs: tuple[Output, ...]
    space: StateSpace

    @cached_property
    def _states(self) -> np.ndarray:
        """Rows: output, address in the state vector."""
        return _table([(i, o.state) for i, o in enumerate(self.outputs) if o.state is not None], 2)

    @cached_property
    def _sensors(self) -> np.ndarray:
        """Rows: output, address in sensordata."""
        return _table(
            [(i, o.sensor) for i, o in enumerate(self.outputs) if o.sensor is not None], 2
        )

    @cached_property
    def _scalar(self) -> np.ndarray:
        """Rows: output, tangent index, of state components that are no quaternion's."""
        tangent = dict(zip(self.space.scalar_q.tolist(), self.space.scalar_v.tolist(), strict=True))
        nq, shift = self.space.nq, self.space.nv - self.space.nq
        plain = [(i, s) for i, s in self._states.T.tolist() if s in tangent or s >= nq]
        return _table([(i, tangent[s] if s < nq else s + shift) for i, s in plain], 2)

    @cached_property
    def _turned(self) -> np.ndarray:
        """Rows: output, component, qpos and dof address of its quaternion."""
        joints = self.space.quaternions
        return _table(
            [
                (i, s - q, q, v)
                for i, s in self._states.T.tolist()
                for q, v in joints
                if q <= s < q + 4
            ],
            4,
        )

    def __len__(self) -> int:
        return len(self.outputs)

    @property
    def names(self) -> tuple[str, ...]:
        """ny column names."""
        return tuple(o.name for o in self.outputs)

    @property
    def needs_sensors(self) -> bool:
        """True where a MuJoCo sensor is among the outputs."""
        return any(o.sensor is not None for o in self.outputs)

    @property
    def curved(self) -> bool:
        """True where components of quaternions are measured, whose second derivative is not zero."""
        return bool(self._turned.shape[1])

    def __call__(self, states: Array, sensors: Array | None) -> Array:
        """(..., ny) from states (..., ns) and sensordata (..., nsensordata); NaN for sensors where that is None."""
        y = np.full((*states.shape[:-1], len(self.outputs)), np.nan)
        y[..., self._states[0]] = states[..., self._states[1]]
        if sensors is not None:
            y[..., self._sensors[0]] = sensors[..., self._sensors[1]]
        return y

    def tangent(self, states: Array, dx: Array, dsensors: Array | None) -> Array:
        """(..., ny) change of the outputs from a tangent step dx (..., nx) at states (..., ns), and that of sensordata."""
        dy = np.zeros((*dx.shape[:-1], len(self.outputs)))
        dy[..., self._scalar[0]] = dx[..., self._scalar[1]]
        for output, component, q, v in self._turned.T:
            rate = quaternion_product(states[..., q : q + 4], _pure(0.5 * dx[..., v : v + 3]))
            dy[..., output] = rate[..., component]
        if dsensors is not None:
            dy[..., self._sensors[0]] = dsensors[..., self._sensors[1]]
        return dy

    def bend(self, states: Array, first: Array, second: Array, dsensors: Array | None) -> Array:
        """(..., ny) mixed second change of the outputs: along `first`, then `second` from there, both (..., nx)."""
        dy = np.zeros((*np.broadcast_shapes(first.shape, second.shape)[:-1], len(self.outputs)))
        for output, component, q, v in self._turned.T:
            moved = quaternion_product(states[..., q : q + 4], _pure(0.5 * first[..., v : v + 3]))
            dy[..., output] = quaternion_product(moved, _pure(0.5 * second[..., v : v + 3]))[
                ..., component
            ]
        if dsensors is not None:
            dy[..., self._sensors[0]] = dsensors[..., self._sensors[1]]
        return dy


def _table(rows: list[tuple[int, ...]], width: int) -> np.ndarray:
    """Integer columns of a list of rows that may be empty."""
    return np.array(rows, np.intp).reshape(-1, width).T


def _pure(v: Array) -> Array:
    """Quaternion without a real part."""
    return np.concatenate([np.zeros((*v.shape[:-1], 1)), v], axis=-1)


def states_shown(model: Any, outputs: OutputMap) -> dict[int, int]:
    """Output that shows a component of the state, by its address: itself, or a sensor of the joint's position or velocity."""
    shown = {}
    kinds = {
        int(mujoco.mjtSensor.mjSENS_JOINTPOS): model.jnt_qposadr,
        int(mujoco.mjtSensor.mjSENS_JOINTVEL): model.jnt_dofadr,
    }
    for i, output in enumerate(outputs.outputs):
        if output.state is not None:
            shown[output.state] = i
    for i, output in enumerate(outputs.outputs):
        for s in range(model.nsensor if output.sensor is not None else 0):
            kind = int(model.sensor_type[s])
            if kind in kinds and int(model.sensor_adr[s]) == output.sensor:
                address = int(kinds[kind][int(model.sensor_objid[s])])
                velocity = kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL)
                shown.setdefault(address + (model.nq if velocity else 0), i)
    return shown
