"""What is measured: the experiment's `noise` and `correlated` tables resolved against the model's state and sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import Correlated, NoiseSpec
from mjfim.model.coordinates import (
    StateComponent,
    measurable_columns,
    sensor_columns,
    state_components,
)
from mjfim.model.paths import names_of
from mjfim.plant.noise import Noise
from mjfim.plant.outputs import Output, OutputMap
from mjfim.plant.state_space import StateSpace


def resolve_outputs(
    experiment: Experiment, model: Any, space: StateSpace, stride: int
) -> tuple[OutputMap, Noise]:
    """Outputs and their noise. stride: of measure_rate. Raises ExperimentError naming the key."""
    everything = {c.name: c for c in state_components(model)}
    sensors = names_of(model, "sensor")
    matches = _matches(everything, model, sensors)
    stated = dict(experiment.noise) or _from_mjcf(
        model, sensors, required=not experiment.correlated
    )
    for key in stated:
        if key not in matches:
            raise ExperimentError(f"noise: {unknown('sensor', key, list(matches))}")
    order = [*everything, *(label for s in sensors for label in sensor_columns(model, s))]
    covariance, strides, chosen = (
        np.zeros((len(order), len(order))),
        np.full(len(order), stride),
        set[int](),
    )
    # what names fewer outputs wins over what names more of them
    for key in sorted(stated, key=lambda k: -len(matches[k])):
        rows = np.array([order.index(name) for name in matches[key]], dtype=np.intp)
        if not len(rows):
            raise ExperimentError(
                "noise.state: the model has no joint to measure; name sensors instead"
            )
        value = stated[key]
        spec = value if isinstance(value, NoiseSpec) else NoiseSpec(sigma=value)
        share = np.array(
            [everything[order[i]].share if order[i] in everything else 1.0 for i in rows]
        )
        covariance[rows] = covariance[:, rows] = 0.0
        covariance[np.ix_(rows, rows)] = _block(f"noise.{key}", spec, share)
        strides[rows] = (
            stride
            if spec.rate is None
            else _stride(f"noise.{key}.rate", experiment.rate, spec.rate)
        )
        if spec.rate is not None and spec.rate * experiment.horizon < 1.0 - 1e-6:
            raise ExperimentError(
                f"noise.{key}.rate: {spec.rate:g} Hz measures nothing within {experiment.horizon:g} s"
            )
        chosen.update(rows.tolist())
    for block in experiment.correlated:
        _correlate(block, order, chosen, covariance, strides)
    keep = sorted(chosen)
    addresses = {
        label: int(model.sensor(s).adr[0]) + i
        for s in sensors
        for i, label in enumerate(sensor_columns(model, s))
    }
    sigma = np.sqrt(np.diag(covariance))
    made = []
    for i in keep:
        component = everything.get(order[i])
        if component is None:
            made.append(Output(order[i], float(sigma[i]), sensor=addresses[order[i]]))
        else:
            made.append(Output(order[i], float(sigma[i]), component.unit, state=component.state))
    return OutputMap(tuple(made), space), Noise(covariance[np.ix_(keep, keep)], strides[keep])


def _matches(
    everything: Mapping[str, StateComponent], model: Any, sensors: list[str]
) -> dict[str, list[str]]:
    """Outputs that each key of the noise table stands for."""
    found: dict[str, list[str]] = {"state": list(everything)}
    for c in everything.values():
        found[c.name] = [c.name]
        for key in c.keys:
            found.setdefault(key, []).append(c.name)
    for sensor in sensors:
        found.setdefault(sensor, sensor_columns(model, sensor))
    return found


def _from_mjcf(model: Any, sensors: list[str], required: bool) -> dict[str, Any]:
    """The MJCF's own noise where the experiment states none."""
    stated = {n: float(model.sensor(n).noise[0]) for n in sensors if model.sensor(n).noise[0] > 0}
    if required and not stated:
        raise ExperimentError(
            "noise: nothing is measured: give `state`, or sensors by name, or `noise` in the MJCF; valid: "
            + ", ".join(["state", *measurable_columns(model)])
        )
    return stated


def _block(key: str, spec: NoiseSpec, share: Array) -> Array:
    """(n, n) covariance of the n outputs that one key stands for."""
    n = len(share)
    if spec.covariance is not None:
        if (share != 1.0).any():
            raise ExperimentError(f"{key}: orientations take one sigma [rad], no covariance")
        return _covariance(f"{key}.covariance", spec.covariance, n)
    sigma = np.asarray(spec.sigma, dtype=np.float64)
    if sigma.ndim and len(sigma) != n:
        raise ExperimentError(
            f"{key}.sigma: {len(sigma)} numbers, wanted one, or one for each of {n} components"
        )
    return np.diag((sigma * share) ** 2)


def _covariance(key: str, rows: tuple[tuple[float, ...], ...], n: int) -> Array:
    if len(rows) != n or any(len(row) != n for row in rows):
        raise ExperimentError(f"{key}: wanted {n} rows of {n} numbers, one per output")
    matrix = np.array(rows, dtype=np.float64)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise ExperimentError(f"{key}: not symmetric")
    if not np.linalg.eigvalsh(matrix)[0] > 1e-12 * np.abs(matrix).max():
        raise ExperimentError(
            f"{key}: not positive definite; variances must exceed what the correlations imply"
        )
    return matrix


def _correlate(
    block: Correlated, order: list[str], chosen: set[int], covariance: Array, strides: np.ndarray
) -> None:
    for name in block.outputs:
        if name not in order:
            raise ExperimentError(f"correlated.outputs: {unknown('output', name, order)}")
    rows = np.array([order.index(name) for name in block.outputs], dtype=np.intp)
    if len(set(rows.tolist())) < len(rows):
        raise ExperimentError(
            f"correlated.outputs: an output stands there twice: {', '.join(block.outputs)}"
        )
    if len(set(strides[rows].tolist())) > 1:
        raise ExperimentError(
            f"correlated.outputs: {', '.join(block.outputs)} are measured at different rates"
        )
    others = np.setdiff1d(np.arange(len(order)), rows)
    if np.any(covariance[np.ix_(rows, others)]):
        raise ExperimentError(
            "correlated.outputs: one of them is correlated with an output outside already"
        )
    covariance[np.ix_(rows, rows)] = _covariance(
        "correlated.covariance", block.covariance, len(rows)
    )
    chosen.update(rows.tolist())


def _stride(key: str, rate: float, wanted: float) -> int:
    """Samples from one measurement to the next. Raises ExperimentError where the rates do not fit."""
    ratio = rate / wanted
    stride = round(ratio)
    if stride < 1 or abs(ratio - stride) > 1e-6 * stride:
        valid = ", ".join(f"{rate / k:g}" for k in (1, 2, 4, 5, 10))
        raise ExperimentError(
            f"{key}: {wanted:g} Hz does not divide rate {rate:g} Hz; valid: {valid}"
        )
    return stride


def measurement_stride(experiment: Experiment) -> int:
    """Samples from one measurement to the next at measure_rate."""
    return _stride("measure_rate", experiment.rate, experiment.measure_rate or experiment.rate)
