"""The measured outputs of an experiment and their noise.

They follow from the tables `noise` and `correlated` of the experiment file, and from the state and
the sensors of the model.
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
    unknown_coordinate,
)
from mjfim.plant.outputs import Noise, Output, Outputs
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
        coordinates: Coordinates and sensors of the model.
        space: Layout of the state.
        stride: Samples from one measurement to the next.
        stride_of_key: The same for keys of the table `noise` with a rate of their own.

    Returns:
        The outputs in the order of the columns, and their noise.

    Raises:
        ExperimentError: A key names no output, or a covariance is not valid.
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

    components = [*coordinates.state, *coordinates.sensors]
    columns = [component.name for component in components]
    covariance = np.zeros((len(columns), len(columns)))
    strides = np.full(len(columns), stride)
    measured: set[int] = set()
    # Keys that cover fewer outputs are entered last, so that they take precedence over keys that
    # cover more outputs.
    for key in sorted(stated, key=lambda k: -len(columns_of_key[k])):
        rows = [columns.index(name) for name in columns_of_key[key]]
        if not rows:
            raise ExperimentError(
                "noise.state: the model has no joint to measure; name sensors instead"
            )
        covariance[rows] = 0.0
        covariance[:, rows] = 0.0
        factors = [components[i].sigma_factor for i in rows]
        covariance[np.ix_(rows, rows)] = _key_covariance(
            f"noise.{key}", stated[key], np.array(factors)
        )
        strides[rows] = stride_of_key.get(key, stride)
        measured.update(rows)

    for block in experiment.correlated:
        rows = _correlated_columns(block, columns, covariance, strides)
        covariance[np.ix_(rows, rows)] = _checked_covariance(
            "correlated.covariance", block.covariance, len(rows)
        )
        measured.update(rows)

    kept = sorted(measured)
    noise = Noise(covariance=covariance[np.ix_(kept, kept)], strides=strides[kept])

    outputs = tuple(
        Output(
            name=columns[i],
            sigma=float(np.sqrt(covariance[i, i])),
            unit=components[i].unit,
            **{"state" if i < len(coordinates.state) else "sensor": components[i].address},
        )
        for i in kept
    )
    return Outputs(outputs=outputs, space=space), noise


def _correlated_columns(
    block: Correlated, columns: list[str], covariance: Array, strides: np.ndarray
) -> list[int]:
    """Numbers of the columns of one table `correlated`, which must have no other correlations."""
    for name in block.outputs:
        if name not in columns:
            raise ExperimentError(
                f"correlated.outputs: {unknown_coordinate('output', name, columns)}"
            )
    rows = [columns.index(name) for name in block.outputs]
    others = np.setdiff1d(np.arange(len(columns)), rows)
    fault = ""
    if len(set(rows)) < len(rows):
        fault = "an output is listed twice"
    elif len(set(strides[rows].tolist())) > 1:
        fault = "these outputs are measured at different rates"
    elif np.any(covariance[rows][:, others]):
        fault = "one of them is already correlated with an output that is not listed"
    if fault:
        raise ExperimentError(f"correlated.outputs: {fault}: {listed(block.outputs)}")
    return rows


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
        columns_of_sensor.setdefault(number.groups[0], []).append(number.name)
    return found | {k: columns for k, columns in columns_of_sensor.items() if k not in found}


def _noise_of_mjcf(coordinates: ModelCoordinates, *, required: bool) -> dict[str, Any]:
    """Standard deviations of the sensors whose `noise` the MJCF states.

    They are used if the experiment states no noise. Raises ExperimentError if `required` and the
    MJCF states none either.
    """
    stated = {each.groups[0]: each.sigma for each in coordinates.sensors if each.sigma > 0}
    if required and not stated:
        valid = listed(["state", *coordinates.measurable])
        raise ExperimentError(
            "noise: no output is measured; state `state` or outputs by name here, or `noise` of "
            f"sensors in the MJCF; valid: {valid}"
        )
    return stated


def _key_covariance(key: str, stated: float | NoiseSpec, sigma_factors: Array) -> Array:
    """(n, n) covariance of the n columns of one key."""
    n = len(sigma_factors)
    spec = stated if isinstance(stated, NoiseSpec) else NoiseSpec(sigma=stated)
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
