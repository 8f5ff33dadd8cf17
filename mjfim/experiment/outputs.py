"""The measured outputs of an experiment and their noise.

They follow from its tables `noise` and `correlated`, the state and the sensors of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import Correlated, NoiseSpec
from mjfim.model.coordinates import (
    StateComponent,
    measurable_columns,
    sensor_columns,
    state_components,
    unknown_coordinate,
)
from mjfim.model.elements import names_of
from mjfim.plant.noise import Noise
from mjfim.plant.outputs import Output, Outputs
from mjfim.plant.state_space import StateSpace

# A ratio of two rates counts as a whole number within this relative tolerance.
RATE_TOLERANCE = 1e-6

# A covariance is not positive definite if its smallest eigenvalue is below this fraction of its
# largest entry.
DEFINITENESS = 1e-12


def resolve_outputs(
    experiment: Experiment, model: Any, space: StateSpace, stride: int
) -> tuple[Outputs, Noise]:
    """Resolve the measured outputs and their noise.

    Args:
        experiment: The experiment.
        model: Its compiled model (`mujoco.MjModel`).
        space: The state space of the model.
        stride: Samples from one measurement to the next at `measure_rate`.

    Returns:
        The outputs, and the noise with their covariance and strides.

    Raises:
        ExperimentError: A key of the tables is not valid for the model; the message names it.
    """
    components = {component.name: component for component in state_components(model)}
    sensors = names_of(model, "sensor")
    columns_of_key = _columns_of_keys(components, model, sensors)
    stated = dict(experiment.noise) or _noise_of_mjcf(
        model, sensors, required=not experiment.correlated
    )
    for key in stated:
        if key not in columns_of_key:
            raise ExperimentError(
                f"noise: {unknown_coordinate('sensor', key, list(columns_of_key))}"
            )

    table = _NoiseTable(components, list(measurable_columns(model)), stride)

    # Keys that cover fewer outputs are entered last, so that they take precedence over keys that
    # cover more outputs.
    for key in sorted(stated, key=lambda k: -len(columns_of_key[k])):
        table.set_key(key, stated[key], columns_of_key[key], experiment)
    for block in experiment.correlated:
        table.correlate(block)

    measured = sorted(table.measured)
    outputs = _outputs(model, sensors, components, table, measured)
    noise = Noise(
        covariance=table.covariance[np.ix_(measured, measured)], strides=table.strides[measured]
    )
    return Outputs(outputs=outputs, space=space), noise


def measurement_stride(experiment: Experiment) -> int:
    """Samples from one measurement to the next at the experiment's `measure_rate`."""
    measure_rate = experiment.measure_rate or experiment.rate
    return _stride("measure_rate", experiment.rate, measure_rate)


class _NoiseTable:
    """Noise of all n columns that can be measured, filled key by key.

    Attributes:
        columns: Names of the n columns.
        covariance: (n, n) covariance of the noise; zero for columns that are not measured.
        strides: (n,) samples from one measurement to the next.
        measured: Indices of the columns that are measured.
    """

    def __init__(
        self, components: Mapping[str, StateComponent], columns: list[str], stride: int
    ) -> None:
        """Begin without measured columns.

        stride: samples from one measurement to the next, for keys that state no rate.
        """
        n = len(columns)
        self.columns = columns
        self.covariance = np.zeros((n, n))
        self.strides = np.full(n, stride)
        self.measured: set[int] = set()

        self._default_stride = stride
        self._sigma_factors = np.array(
            [components[name].sigma_factor if name in components else 1.0 for name in columns]
        )

    def indices(self, names: list[str] | tuple[str, ...]) -> np.ndarray:
        """Indices of columns by their names."""
        found = [self.columns.index(name) for name in names]
        return np.array(found, dtype=np.intp)

    def set_key(
        self, key: str, value: float | NoiseSpec, names: list[str], experiment: Experiment
    ) -> None:
        """Enter one key of the table `noise`, which is valid for the columns `names`."""
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

        self.strides[rows] = self._default_stride
        if spec.rate is not None:
            self.strides[rows] = _stride(f"noise.{key}.rate", experiment.rate, spec.rate)
            _require_measurement(key, spec.rate, experiment.horizon)

    def correlate(self, block: Correlated) -> None:
        """Enter one block of the table `correlated`."""
        for name in block.outputs:
            if name not in self.columns:
                fault = unknown_coordinate("output", name, self.columns)
                raise ExperimentError(f"correlated.outputs: {fault}")

        rows = self.indices(block.outputs)
        listed = ", ".join(block.outputs)
        if len(set(rows.tolist())) < len(rows):
            raise ExperimentError(f"correlated.outputs: an output is listed twice: {listed}")
        if len(set(self.strides[rows].tolist())) > 1:
            raise ExperimentError(f"correlated.outputs: {listed} are measured at different rates")

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


def _columns_of_keys(
    components: Mapping[str, StateComponent], model: Any, sensors: list[str]
) -> dict[str, list[str]]:
    """Columns for which each key of the table `noise` is valid."""
    found: dict[str, list[str]] = {"state": list(components)}
    for component in components.values():
        found[component.name] = [component.name]
        for group in component.groups:
            found.setdefault(group, []).append(component.name)
    for sensor in sensors:
        found.setdefault(sensor, sensor_columns(model, sensor))
    return found


def _noise_of_mjcf(model: Any, sensors: list[str], required: bool) -> dict[str, Any]:
    """Standard deviations of the sensors whose `noise` the MJCF states.

    They are used if the experiment states no noise. Raises ExperimentError if `required` and the
    MJCF states none either.
    """
    sigmas = {name: float(model.sensor(name).noise[0]) for name in sensors}
    stated = {name: sigma for name, sigma in sigmas.items() if sigma > 0}
    if required and not stated:
        valid = ", ".join(["state", *measurable_columns(model)])
        raise ExperimentError(
            "noise: no output is measured; state `state` or outputs by name here, or `noise` of "
            f"sensors in the MJCF; valid: {valid}"
        )
    return stated


def _outputs(
    model: Any,
    sensors: list[str],
    components: Mapping[str, StateComponent],
    table: _NoiseTable,
    measured: list[int],
) -> tuple[Output, ...]:
    """The measured outputs, in the order of the columns."""
    addresses = {
        column: int(model.sensor(sensor).adr[0]) + i
        for sensor in sensors
        for i, column in enumerate(sensor_columns(model, sensor))
    }
    sigma = np.sqrt(np.diag(table.covariance))

    outputs = []
    for i in measured:
        name = table.columns[i]
        component = components.get(name)
        if component is None:
            output = Output(name=name, sigma=float(sigma[i]), sensor=addresses[name])
        else:
            output = Output(
                name=name, sigma=float(sigma[i]), unit=component.unit, state=component.address
            )
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


def _require_measurement(key: str, rate: float, horizon: float | None) -> None:
    """Raise ExperimentError if a rate [Hz] gives no measurement within the horizon [s].

    horizon: None if the experiment states none; then every rate is accepted.
    """
    if horizon is not None and rate * horizon < 1.0 - RATE_TOLERANCE:
        raise ExperimentError(
            f"noise.{key}.rate: {rate:g} Hz gives no measurement within the horizon ({horizon:g} s)"
        )


def _stride(key: str, rate: float, measure_rate: float) -> int:
    """Samples from one measurement to the next.

    Args:
        key: The key that states the rate of measurements, for messages.
        rate: Rate of the samples [Hz].
        measure_rate: Rate of the measurements [Hz].

    Raises:
        ExperimentError: The rate of the measurements does not divide that of the samples.
    """
    ratio = rate / measure_rate
    stride = round(ratio)
    if stride < 1 or abs(ratio - stride) > RATE_TOLERANCE * stride:
        valid = ", ".join(f"{rate / k:g}" for k in (1, 2, 4, 5, 10))
        raise ExperimentError(
            f"{key}: {measure_rate:g} Hz does not divide rate {rate:g} Hz; valid: {valid}"
        )
    return stride
