"""Measured outputs `y = h(x, u, theta)`: components of the state, and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet
from mjfim.plant.state_space import StateSpace, quaternion_product


@dataclass(frozen=True, kw_only=True)
class Output:
    """One measured scalar: a component of the state or of the sensor data.

    Attributes:
        name: Column name in recordings.
        sigma: Standard deviation of its noise, in its unit.
        unit: Unit, empty if not known.
        state: Address in the state vector (qpos, qvel, act), or None.
        sensor: Address in sensordata, or None.
    """

    name: str
    sigma: float
    unit: str = ""
    state: int | None = None
    sensor: int | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Outputs:
    """The output map h without errors of the sensors and delay.

    States are scalar coordinates or components of quaternions, for which h and its derivatives are
    known exactly.

    Attributes:
        outputs: The ny outputs in the order of y.
        space: Layout of the state.
    """

    outputs: tuple[Output, ...]
    space: StateSpace

    def __len__(self) -> int:
        return len(self.outputs)

    @property
    def names(self) -> tuple[str, ...]:
        """The ny column names."""
        return tuple(output.name for output in self.outputs)

    @property
    def needs_sensors(self) -> bool:
        """True if a MuJoCo sensor is among the outputs."""
        return any(output.sensor is not None for output in self.outputs)

    @property
    def curved(self) -> bool:
        """True if components of quaternions are measured: their second derivative is not zero."""
        return bool(self._quaternions.shape[1])

    @cached_property
    def _states(self) -> np.ndarray:
        """(2, n) output and address in the state vector of every measured state component."""
        rows = []
        for i, output in enumerate(self.outputs):
            if output.state is not None:
                rows.append((i, output.state))
        return _columns(rows, 2)

    @cached_property
    def _sensors(self) -> np.ndarray:
        """(2, n) output and address in sensordata of every measured sensor."""
        rows = []
        for i, output in enumerate(self.outputs):
            if output.sensor is not None:
                rows.append((i, output.sensor))
        return _columns(rows, 2)

    @cached_property
    def _scalars(self) -> np.ndarray:
        """(2, n) output and tangent index of every measured component outside quaternions."""
        space = self.space
        tangent = dict(zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True))
        rows = []
        for i, address in self._states.T.tolist():
            if address >= space.nq:
                rows.append((i, address + space.nv - space.nq))
            elif address in tangent:
                rows.append((i, tangent[address]))
        return _columns(rows, 2)

    @cached_property
    def _quaternions(self) -> np.ndarray:
        """Measured components of quaternions.

        Returns:
            (4, n) for each of them the output, the component, and the addresses of the quaternion
            in qpos and of its angular velocity in qvel.
        """
        rows = []
        for i, address in self._states.T.tolist():
            for q, v in self.space.quaternions:
                if q <= address < q + 4:
                    rows.append((i, address - q, q, v))
        return _columns(rows, 4)

    def __call__(self, states: Array, sensors: Array | None) -> Array:
        """Outputs of states and sensor data.

        Args:
            states: (..., ns) states.
            sensors: (..., nsensordata) sensor data, or None.

        Returns:
            (..., ny) outputs [y-unit], NaN for sensors without sensor data.
        """
        y = np.full((*states.shape[:-1], len(self.outputs)), np.nan)
        y[..., self._states[0]] = states[..., self._states[1]]
        if sensors is not None:
            y[..., self._sensors[0]] = sensors[..., self._sensors[1]]
        return y

    def tangent(self, states: Array, dx: Array, dsensors: Array | None) -> Array:
        """First-order change of the outputs.

        Args:
            states: (..., ns) states.
            dx: (..., nx) tangent vectors at the states.
            dsensors: (..., nsensordata) changes of the sensor data, or None for zero.

        Returns:
            (..., ny) changes [y-unit].
        """
        dy = np.zeros((*dx.shape[:-1], len(self.outputs)))
        dy[..., self._scalars[0]] = dx[..., self._scalars[1]]
        for output, component, q, v in self._quaternions.T:
            rate = _turned(states[..., q : q + 4], dx[..., v : v + 3])
            dy[..., output] = rate[..., component]
        if dsensors is not None:
            dy[..., self._sensors[0]] = dsensors[..., self._sensors[1]]
        return dy

    def mixed_change(
        self, states: Array, first: Array, second: Array, dsensors: Array | None
    ) -> Array:
        """Mixed second-order change of the outputs along two tangent vectors.

        The second vector is applied at the state to which the first one leads.

        Args:
            states: (..., ns) states.
            first: (..., nx) tangent vectors at the states.
            second: (..., nx) tangent vectors at the moved states.
            dsensors: (..., nsensordata) mixed changes of the sensor data, or None for zero.

        Returns:
            (..., ny) mixed changes [y-unit].
        """
        shape = np.broadcast_shapes(first.shape, second.shape)[:-1]
        dy = np.zeros((*shape, len(self.outputs)))
        for output, component, q, v in self._quaternions.T:
            moved = _turned(states[..., q : q + 4], first[..., v : v + 3])
            dy[..., output] = _turned(moved, second[..., v : v + 3])[..., component]
        if dsensors is not None:
            dy[..., self._sensors[0]] = dsensors[..., self._sensors[1]]
        return dy


def outputs_by_state(model: Any, outputs: Outputs) -> dict[int, int]:
    """Outputs that measure a component of the state, directly or by a sensor of its joint.

    Args:
        model: Compiled MuJoCo model.
        outputs: The outputs.

    Returns:
        Index of the output by the address of the component in the state vector.
    """
    found = {
        output.state: i for i, output in enumerate(outputs.outputs) if output.state is not None
    }

    # Address in sensordata -> address in the state vector.
    sensors = {}
    for s in range(model.nsensor):
        joint = int(model.sensor_objid[s])
        kind = int(model.sensor_type[s])
        if kind == int(mujoco.mjtSensor.mjSENS_JOINTPOS):
            sensors[int(model.sensor_adr[s])] = int(model.jnt_qposadr[joint])
        elif kind == int(mujoco.mjtSensor.mjSENS_JOINTVEL):
            sensors[int(model.sensor_adr[s])] = model.nq + int(model.jnt_dofadr[joint])

    # A component that is measured directly takes precedence over a sensor of it.
    for i, output in enumerate(outputs.outputs):
        if output.sensor in sensors:
            found.setdefault(sensors[output.sensor], i)
    return found


def _columns(rows: Sequence[tuple[int, ...]], width: int) -> np.ndarray:
    """(width, n) integer columns of n rows, of which there may be none."""
    return np.array(rows, np.intp).reshape(-1, width).T


def _turned(quaternion: Array, rotation: Array) -> Array:
    """First-order change of quaternions under a rotation.

    Args:
        quaternion: (..., 4) quaternions (w, x, y, z).
        rotation: (..., 3) rotation vectors in the body frame [rad].

    Returns:
        (..., 4) changes of the quaternions.
    """
    real = np.zeros((*rotation.shape[:-1], 1))
    half_rotation = np.concatenate([real, 0.5 * rotation], axis=-1)
    return quaternion_product(quaternion, half_rotation)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """Scale errors and biases of the ny outputs as functions of the p parameters.

    Attributes:
        scale: (ny, p) derivative of the relative scale errors s by theta [1 / theta-unit].
        bias: (ny, p) derivative of the biases b by theta [y-unit / theta-unit].
    """

    scale: Array
    bias: Array

    @staticmethod
    def of(parameters: ParameterSet, ny: int) -> Calibration:
        """Errors that some parameters stand for.

        Args:
            parameters: The parameters.
            ny: Number of outputs.
        """
        return Calibration(
            scale=parameters.scale_derivative(ny), bias=parameters.bias_derivative(ny)
        )

    @property
    def scales(self) -> bool:
        """Whether a parameter is the scale error of an output."""
        return bool(self.scale.any())

    def factor(self, theta: Array) -> Array:
        """Factors 1 + s of the outputs.

        Args:
            theta: (..., p) parameters [theta-unit].

        Returns:
            (..., ny) factors.
        """
        return np.asarray(1.0 + theta @ self.scale.T)

    def measured(self, h: Array, theta: Array) -> Array:
        """Outputs with their errors.

        Args:
            h: (..., ny) outputs of the model [y-unit].
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny) outputs [y-unit].
        """
        return np.asarray(self.factor(theta) * h + self.bias @ theta)

    def scaled(self, derivative: Array, theta: Array) -> Array:
        """Derivatives of the outputs by states, controls or directions of theta.

        Args:
            derivative: (..., ny, n) derivatives of the outputs of the model.
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny, n) derivatives of the outputs with their scales.
        """
        if not self.scales:
            return derivative
        return np.asarray(self.factor(theta)[:, None] * derivative)

    def by_theta(self, h: Array, derivative: Array, theta: Array) -> Array:
        """Derivatives of the outputs with their errors by theta.

        Args:
            h: (..., ny) outputs of the model [y-unit].
            derivative: (..., ny, p) derivatives of the outputs of the model by theta.
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny, p) derivatives [y-unit / theta-unit].
        """
        total = self.scaled(derivative, theta) + self.bias
        return total + h[..., None] * self.scale if self.scales else total
