"""Measured outputs `y = h(x, u, theta)`: parts of the state and sensors, their noise and delay.

The noise has a covariance, with which measurements are sampled and whitened. The delay is
interpolation between samples, written as a linear operator, with its derivative by the delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.plant.state_space import StateSpace, quaternion_product

# Number of samples through which the cubic polynomial of the interpolation passes.
NODES = 4


@record
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
        stated = [(i, o.state) for i, o in enumerate(self.outputs) if o.state is not None]
        return _columns(stated, 2)

    @cached_property
    def _sensors(self) -> np.ndarray:
        """(2, n) output and address in sensordata of every measured sensor."""
        sensed = [(i, o.sensor) for i, o in enumerate(self.outputs) if o.sensor is not None]
        return _columns(sensed, 2)

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
        rows = [
            (i, address - q, q, v)
            for i, address in self._states.T.tolist()
            for q, v in self.space.quaternions
            if q <= address < q + 4
        ]
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
        joint = model.sensor_objid[s]
        kind = model.sensor_type[s]
        if kind == mujoco.mjtSensor.mjSENS_JOINTPOS:
            sensors[int(model.sensor_adr[s])] = int(model.jnt_qposadr[joint])
        elif kind == mujoco.mjtSensor.mjSENS_JOINTVEL:
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


@record
class Calibration:
    """Scale errors and biases of the ny outputs as functions of the p parameters.

    Attributes:
        scale: (ny, p) derivative of the relative scale errors s by theta [1 / theta-unit].
        bias: (ny, p) derivative of the biases b by theta [y-unit / theta-unit].
    """

    scale: Array
    bias: Array

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
        return 1.0 + theta @ self.scale.T

    def measured(self, h: Array, theta: Array) -> Array:
        """Outputs with their errors.

        Args:
            h: (..., ny) outputs of the model [y-unit].
            theta: (p,) parameters [theta-unit].

        Returns:
            (..., ny) outputs [y-unit].
        """
        return self.factor(theta) * h + self.bias @ theta

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
        return self.factor(theta)[:, None] * derivative

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


@record
class Noise:
    """Gaussian noise, white in time, correlated between the outputs of one sample.

    Attributes:
        covariance: (ny, ny) covariance [y-unit y-unit].
        strides: (ny,) strides; every strides[i]-th sample measures output i, except the initial
            state k = 0. Correlated outputs share their stride.
    """

    covariance: Array
    strides: np.ndarray

    @cached_property
    def sigma(self) -> Array:
        """(ny,) standard deviations [y-unit]."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def correlated(self) -> bool:
        """True if any two outputs are correlated."""
        return bool(np.count_nonzero(self.covariance) > len(self.covariance))

    @cached_property
    def factor(self) -> Array:
        """(ny, ny) lower triangular L with `L L' = covariance` [y-unit]."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def precision(self) -> Array:
        """(ny, ny) inverse of the covariance [1 / y-unit y-unit]."""
        return np.asarray(np.linalg.inv(self.covariance))

    def at_every_sample(self, stride: int) -> Noise:
        """Noise on a grid that measures every output at every sample.

        The information per second is equal to that of this noise.

        Args:
            stride: Stride of the measurement rate to which information is related.

        Returns:
            The noise on the other grid.
        """
        scale = np.sqrt(self.strides / stride)
        return Noise(
            covariance=self.covariance * np.outer(scale, scale), strides=np.ones_like(self.strides)
        )

    def measured(self, N: int) -> Array:
        """Mask of the measured samples.

        Args:
            N: Number of control samples.

        Returns:
            (N+1, ny) 1 where an output is measured, else 0.
        """
        k = np.arange(N + 1)[:, None]
        return np.asarray((k % self.strides == 0) & (k > 0), dtype=np.float64)

    def whiten(self, values: Array) -> Array:
        """Whitened values `L^-1 y`.

        Args:
            values: (N+1, ny, ...) values [y-unit].

        Returns:
            (N+1, ny, ...) whitened values.
        """
        if not self.correlated:
            return values / self.sigma.reshape(-1, *[1] * (values.ndim - 2))

        rows = np.moveaxis(values, 1, 0)
        flat = scipy.linalg.solve_triangular(self.factor, rows.reshape(len(rows), -1), lower=True)
        return np.moveaxis(flat.reshape(rows.shape), 0, 1)

    def whitened_rows(self, values: Array) -> Array:
        """Whitened values of all measurements, one after the other.

        Args:
            values: (N+1, ny, ...) values [y-unit].

        Returns:
            (n, ...) whitened values of the n measurements.
        """
        return self.whiten(values)[self.measured(len(values) - 1) > 0]

    def whiten_present(self, values: Array, present: np.ndarray) -> Array:
        """Whitened values of the measurements that are present; missing ones are marginalised out.

        Args:
            values: (N+1, ny, ...) values [y-unit].
            present: (N+1, ny) True where a measurement is present.

        Returns:
            (n, ...) whitened values of the n measurements that are present.
        """
        if not self.correlated:
            return np.asarray(self.whiten(values)[present])

        # The marginal covariance, and with it the factor, depends on which outputs are present at a
        # sample. All samples with an equal pattern are whitened together.
        whitened = np.zeros(values.shape)
        for pattern in np.unique(present, axis=0):
            if not pattern.any():
                continue
            samples = (present == pattern).all(axis=1)
            marginal = Noise(
                covariance=self.covariance[np.ix_(pattern, pattern)], strides=self.strides[pattern]
            )
            block = np.ix_(samples, pattern)
            whitened[block] = marginal.whiten(values[block])
        return np.asarray(whitened[present])

    def sample(self, count: int, rng: np.random.Generator) -> Array:
        """Draw noise.

        Args:
            count: Number of samples.
            rng: Random generator.

        Returns:
            (count, ny) noise [y-unit].
        """
        return rng.standard_normal((count, len(self.factor))) @ self.factor.T


@record
class OutputDelay:
    """Values `y(t - d)` from samples y_k, by cubic Lagrange interpolation.

    The order is lower where there are fewer than four samples. Before the first sample the first
    value is held, after the last sample the last one.

    Attributes:
        weights: (M, N+1) sparse interpolation weights; M = N+1 if values are wanted at the samples
            themselves.
        node_slopes: (M n,) derivative of the stored weights by d [1/s].
    """

    weights: Any
    node_slopes: Array

    @cached_property
    def weight_slopes(self) -> Any:
        """(M, N+1) sparse derivative of the weights by d [1/s]."""
        places = self.weights.indices, self.weights.indptr
        return scipy.sparse.csr_array((self.node_slopes, *places), shape=self.weights.shape)

    @staticmethod
    def on_grid(samples: int, delay: float, dt: float) -> OutputDelay:
        """Delayed values at the samples themselves.

        Args:
            samples: Number of samples N+1.
            delay: Delay d [s].
            dt: Sample period [s].

        Returns:
            The operator.
        """
        wanted = np.arange(samples, dtype=np.float64) - delay / dt
        return OutputDelay.at(wanted, samples, dt)

    @staticmethod
    def at(wanted: Array, samples: int, dt: float) -> OutputDelay:
        """Delayed values at any times, for outputs that are measured between the samples.

        Args:
            wanted: (M,) places `(t - d) / dt` in samples.
            samples: Number of samples N+1.
            dt: Sample period [s].

        Returns:
            The operator.
        """
        place = np.clip(wanted, 0.0, samples - 1.0)
        count = min(NODES, samples)

        # No node lies after the sample at or behind the place: a controller feeds the noise of a
        # measurement back into the later samples, and a slope from these would be correlated with
        # that noise. At both ends, the nodes are shifted to existing samples.
        first = np.clip(np.ceil(place).astype(int) - (count - 1), 0, samples - count)
        nodes = first[:, None] + np.arange(count)
        value, slope = _lagrange(place[:, None] - first[:, None], count)

        # Where the first or last value is held, a change of the delay changes nothing.
        inside = (wanted >= 0.0) & (wanted <= samples - 1.0)
        slope *= np.where(inside, -1.0 / dt, 0.0)[:, None]

        # All rows have the same number of nodes, so that the operators need no sorting.
        row_starts = np.arange(len(place) + 1) * count
        weights = scipy.sparse.csr_array(
            (value.ravel(), nodes.ravel(), row_starts), shape=(len(place), samples)
        )
        return OutputDelay(weights=weights, node_slopes=slope.ravel())

    def apply(self, values: Array) -> Array:
        """Delayed values.

        Args:
            values: (N+1, ...) samples.

        Returns:
            (M, ...) delayed values.
        """
        return _apply(self.weights, values)

    def derivative(self, values: Array) -> Array:
        """Derivative of the delayed values by the delay.

        Args:
            values: (N+1, ...) samples.

        Returns:
            (M, ...) derivative [unit of the values / s].
        """
        return _apply(self.weight_slopes, values)

    def apply_transposed(self, values: Array) -> Array:
        """Adjoint of `apply`.

        Args:
            values: (M, ...) covector of the delayed values.

        Returns:
            (N+1, ...) covector of the samples.
        """
        return _apply(self.weights.T, values)

    def derivative_transposed(self, values: Array) -> Array:
        """Adjoint of `derivative`.

        Args:
            values: (M, ...) covector of the derivative.

        Returns:
            (N+1, ...) covector of the samples.
        """
        return _apply(self.weight_slopes.T, values)


def _apply(operator: Any, values: Array) -> Array:
    """Apply a sparse operator (M, N+1) to the first axis of values: (N+1, ...)."""
    rows = values.reshape(len(values), -1)
    applied = operator @ rows

    shape = (operator.shape[0], *values.shape[1:])
    return np.asarray(applied.reshape(shape))


def _lagrange(s: Array, count: int) -> tuple[Array, Array]:
    """Lagrange weights of equidistant nodes.

    Args:
        s: (n, 1) places, in units of the distance between two nodes.
        count: Number of nodes; they are at 0, 1, 2 and so on.

    Returns:
        (n, count) weights, and (n, count) their derivatives by s.
    """
    # Values of all nodes are contiguous here, because NumPy is slow along short rows.
    value = np.ones((count, len(s)))
    slope = np.zeros((count, len(s)))
    for i in range(count):
        others = [j for j in range(count) if j != i]
        scale = math.prod(i - j for j in others)
        factors = [s[:, 0] - j for j in others]
        value[i] = math.prod(factors, start=value[i]) / scale

        # The product rule: a sum of products, each without one of the factors.
        for k in range(count - 1):
            slope[i] += math.prod(factors[:k] + factors[k + 1 :])
        slope[i] /= scale
    return value.T, slope.T
