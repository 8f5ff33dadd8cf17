"""Measured outputs: which components of the state and which sensors are recorded, and with what noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.trajectory import Array


@dataclass(frozen=True)
class Output:
    """One measured scalar.

    name: column name in recordings;  sigma: 1-sigma noise in its unit
    state: tangent-space index of a measured state component, or None;  sensor: address in sensordata, or None
    """

    name: str
    sigma: float
    unit: str = ""
    state: int | None = None
    sensor: int | None = None


@dataclass(frozen=True, eq=False)
class OutputMap:
    """The vector `y = h(x, u, theta)`: (ny,) in the order of `outputs`. States here are scalar coordinates, so h is exact."""

    outputs: tuple[Output, ...]
    state_rows: np.ndarray
    state_columns: np.ndarray
    state_address: np.ndarray
    sensor_rows: np.ndarray
    sensor_address: np.ndarray

    @staticmethod
    def build(outputs: Sequence[Output], address: dict[int, int]) -> OutputMap:
        """address: tangent index -> index into the state vector (qpos, qvel, act)."""
        states = [(i, o.state) for i, o in enumerate(outputs) if o.state is not None]
        sensors = [(i, o.sensor) for i, o in enumerate(outputs) if o.sensor is not None]
        return OutputMap(
            tuple(outputs),
            np.array([i for i, _ in states], np.intp),
            np.array([s for _, s in states], np.intp),
            np.array([address[s] for _, s in states], np.intp),
            np.array([i for i, _ in sensors], np.intp),
            np.array([s for _, s in sensors], np.intp),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """ny column names."""
        return tuple(o.name for o in self.outputs)

    @property
    def sigma(self) -> Array:
        """(ny,) standard deviations."""
        return np.array([o.sigma for o in self.outputs])

    @property
    def needs_sensors(self) -> bool:
        """True where a MuJoCo sensor is among the outputs."""
        return len(self.sensor_rows) > 0

    def __call__(self, states: Array, sensors: Array | None) -> Array:
        """(..., ny) from states (..., ns) and sensordata (..., nsensordata)."""
        y = np.empty((*states.shape[:-1], len(self.outputs)))
        y[..., self.state_rows] = states[..., self.state_address]
        if sensors is not None:
            y[..., self.sensor_rows] = sensors[..., self.sensor_address]
        return y

    def tangent(self, dx: Array, dsensors: Array | None) -> Array:
        """(..., ny) change of the outputs from a tangent step dx (..., nx) and the change of sensordata."""
        dy = np.empty((*dx.shape[:-1], len(self.outputs)))
        dy[..., self.state_rows] = dx[..., self.state_columns]
        if dsensors is not None:
            dy[..., self.sensor_rows] = dsensors[..., self.sensor_address]
        return dy
