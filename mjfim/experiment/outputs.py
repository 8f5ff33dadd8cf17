"""The measured outputs of an experiment and their noise.

They follow from its tables `noise` and `correlated`, the state and the sensors of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import Correlated, NoiseSpec
from mjfim.model.coordinates import (
    ModelCoordinates,
    SensorComponent,
    StateComponent,
    unknown_coordinate,
)
from mjfim.plant.noise import Noise
from mjfim.plant.outputs import Output, Outputs
from mjfim.plant.state_space import StateSpace

# A covariance is not positive definite if its smallest eigenvalue is below this fraction of its
# largest entry.
DEFINITENESS = 1e-12


def resolve_outputs(
    experiment: Experiment,
    coordinates: ModelCoordinates,
    space: StateSpace,
    *,
    stride: int,
    stride_of_key: Mapping[str, int],
) -> tuple[Outputs, Noise]:
    """Resolve the measured outputs and their noise.

    Args:
        experiment: The experiment.
        coordinates: Coordinates of its model that can be measured.
        space: The state space of the model.
        stride: Samples from one measurement to the next at `measure_rate`.
        stride_of_key: Samples between measurements, for each key of `noise` that states a rate.

    Returns:
        The outputs, and the noise with their covariance and strides.

    Raises:
        ExperimentError: A key of the tables is not valid for the model; the message names it.
    """
    columns_of_key = columns_of_keys(coordinates)
    stated = dict(experiment.noise) or _noise_of_mjcf(
        coordinates, required=not experiment.correlated
    )
    for key in stated:
        if key not in columns_of_key:
            raise ExperimentError(
                f"noise: {unknown_coordinate('sensor', key, list(columns_of_key))}"
            )

    table = _NoiseTable(coordinates, stride)

    # Keys that cover fewer outputs are entered last, so that they take precedence over keys that
    # cover more outputs.
    for key in sorted(stated, key=lambda k: -len(columns_of_key[k])):
        table.set_key(key, stated[key], columns_of_key[key], stride_of_key.get(key, stride))
    for block in experiment.correlated:
        table.correlate(block)

    measured = sorted(table.measured)
    outputs = _outputs(coordinates, table.covariance, measured)
    noise = Noise(
        covariance=table.covariance[np.ix_(measured, measured)], strides=table.strides[measured]
    )
    return Outputs(outputs=outputs, space=space), noise


class _NoiseTable:
    """Noise of all n columns that can be measured, filled key by key.

    Attributes:
        columns: Names of the n columns.
        covariance: (n, n) covariance of the noise; zero for columns that are not measured.
        strides: (n,) samples from one measurement to the next.
        measured: Indices of the columns that are measured.
    """

    def __init__(self, coordinates: ModelCoordinates, stride: int) -> None:
        """Begin without measured columns.

        stride: samples from one measurement to the next, for keys that state no rate.
        """
        self.columns = list(coordinates.measurable)
        n = len(self.columns)
        self.covariance = np.zeros((n, n))
        self.strides = np.full(n, stride)
        self.measured: set[int] = set()

        self._sigma_factors = np.ones(n)
        self._sigma_factors[: len(coordinates.state)] = [
            component.sigma_factor for component in coordinates.state
        ]

    def indices(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Indices of columns by their names."""
        found = [self.columns.index(name) for name in names]
        return np.array(found, dtype=np.intp)

    def set_key(self, key: str, value: float | NoiseSpec, names: list[str], stride: int) -> None:
        """Enter one key of the table `noise`.

        Args:
            key: The key.
            value: What the table states for it.
            names: The columns for which it is valid.
            stride: Samples from one of their measurements to the next.
        """
        if not names:
            raise ExperimentError(
                "noise.state: the model has no joint to measure; name sensors instead"
            )

        spec = value if isinstance(value, NoiseSpec) else NoiseSpec(sigma=value)
        rows = self.indices(names)
        self.covariance[rows] = 0.0
        self.covariance[:, rows] = 0.0
        self.covariance[np.ix_(rows, rows)] = _key_covariance(
            f"noise.{key}", spec, self._sigma_factors[rows]
        )
        self.measured.update(rows.tolist())

        self.strides[rows] = stride

    def correlate(self, block: Correlated) -> None:
        """Enter one block of the table `correlated`."""
        for name in block.outputs:
            if name not in self.columns:
                raise ExperimentError(
                    f"correlated.outputs: {unknown_coordinate('output', name, self.columns)}"
                )

        rows = self.indices(block.outputs)
        outputs = listed(block.outputs)
        if len(set(rows.tolist())) < len(rows):
            raise ExperimentError(f"correlated.outputs: an output is listed twice: {outputs}")
        if len(set(self.strides[rows].tolist())) > 1:
            raise ExperimentError(f"correlated.outputs: {outputs} are measured at different rates")

        others = np.setdiff1d(np.arange(len(self.columns)), rows)
        if np.any(self.covariance[np.ix_(rows, others)]):
            raise ExperimentError(
                "correlated.outputs: one of them is already correlated with an output that is not "
                "listed"
            )

        self.covariance[np.ix_(rows, rows)] = _checked_covariance(
            "correlated.covariance", block.covariance, len(rows)
        )
        self.measured.update(rows.tolist())


def columns_of_keys(coordinates: ModelCoordinates) -> dict[str, list[str]]:
    """Columns for which each key of the table `noise` is valid."""
    stated = [component.name for component in coordinates.state if not component.is_added]
    found: dict[str, list[str]] = {"state": stated}
    for component in coordinates.state:
        found[component.name] = [component.name]
        for group in component.groups:
            found.setdefault(group, []).append(component.name)

    # Where a sensor has the name of a key of the state, the key means the state.
    columns_of_sensor: dict[str, list[str]] = {}
    for number in coordinates.sensors:
        columns_of_sensor.setdefault(number.sensor, []).append(number.name)
    return found | {k: columns for k, columns in columns_of_sensor.items() if k not in found}


def _noise_of_mjcf(coordinates: ModelCoordinates, *, required: bool) -> dict[str, Any]:
    """Standard deviations of the sensors whose `noise` the MJCF states.

    They are used if the experiment states no noise. Raises ExperimentError if `required` and the
    MJCF states none either.
    """
    stated = {number.sensor: number.sigma for number in coordinates.sensors if number.sigma > 0}
    if required and not stated:
        valid = listed(["state", *coordinates.measurable])
        raise ExperimentError(
            "noise: no output is measured; state `state` or outputs by name here, or `noise` of "
            f"sensors in the MJCF; valid: {valid}"
        )
    return stated


def _outputs(
    coordinates: ModelCoordinates, covariance: Array, measured: list[int]
) -> tuple[Output, ...]:
    """The measured outputs, in the order of the columns.

    Args:
        coordinates: What can be measured: n columns.
        covariance: (n, n) covariance of the noise.
        measured: Places of the columns that are measured.
    """
    components: list[StateComponent | SensorComponent] = [*coordinates.state, *coordinates.sensors]
    sigma = np.sqrt(np.diag(covariance))

    outputs = []
    for i in measured:
        component = components[i]
        if isinstance(component, StateComponent):
            output = Output(
                name=component.name,
                sigma=float(sigma[i]),
                unit=component.unit,
                state=component.address,
            )
        else:
            output = Output(name=component.name, sigma=float(sigma[i]), sensor=component.address)
        outputs.append(output)
    return tuple(outputs)


def _key_covariance(key: str, spec: NoiseSpec, sigma_factors: Array) -> Array:
    """(n, n) covariance of the n columns of one key.

    Args:
        key: The key, for messages.
        spec: The stated noise.
        sigma_factors: (n,) ratio of each column's standard deviation to the stated one.
    """
    n = len(sigma_factors)
    if spec.covariance is not None:
        if (sigma_factors != 1.0).any():
            raise ExperimentError(f"{key}: an orientation takes one sigma [rad] and no covariance")
        return _checked_covariance(f"{key}.covariance", spec.covariance, n)

    sigma = np.asarray(spec.sigma, dtype=np.float64)
    if sigma.ndim and len(sigma) != n:
        raise ExperimentError(
            f"{key}.sigma: {len(sigma)} numbers; expected one, or one for each of {n} components"
        )
    return np.diag((sigma * sigma_factors) ** 2)


def _checked_covariance(key: str, rows: tuple[tuple[float, ...], ...], n: int) -> Array:
    """(n, n) stated covariance.

    Raises ExperimentError unless it is symmetric and positive definite.
    """
    if len(rows) != n or any(len(row) != n for row in rows):
        raise ExperimentError(f"{key}: expected {n} rows of {n} numbers, one per output")

    matrix = np.array(rows, dtype=np.float64)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise ExperimentError(f"{key}: not symmetric")
    if not np.linalg.eigvalsh(matrix)[0] > DEFINITENESS * np.abs(matrix).max():
        raise ExperimentError(
            f"{key}: not positive definite; variances must exceed what the correlations imply"
        )
    return matrix
