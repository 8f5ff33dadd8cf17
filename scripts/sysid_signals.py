"""Outputs of an experiment as signals of `mujoco.sysid`, and how measured and predicted ones are compared.

sysid stamps the sensor values of a step with the time after it, though they belong to the state before; states do not lag. So
positions and velocities become state signals, and sensors are read one step earlier. sysid divides residuals by the norm of each
measured signal, whatever its noise, and takes weights by name for sensors only; here they are whitened, or divided as sysid does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco import sysid
from scipy.interpolate import CubicSpline

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.plant.noise import Noise

ON_STEP = 1e-6  # of an engine step: times that close to it are meant to be on it


@dataclass(frozen=True, eq=False)
class Layout:
    """Columns of a sysid TimeSeries that holds the outputs of an experiment.

    mapping: signal name -> (type, its columns), as sysid wants it
    sensed: (c,) True for columns of sensors;  source: (c,) their place in sensordata or the state (qpos, qvel, act)
    outputs: (ny,) column of each output of the experiment
    shown: of the ny outputs alone, component by component; sysid's report cannot draw others
    """

    mapping: dict[str, tuple[Any, np.ndarray]]
    sensed: np.ndarray
    source: np.ndarray
    outputs: np.ndarray
    shown: dict[str, tuple[Any, np.ndarray]]

    @staticmethod
    def of(task: DesignTask) -> Layout:
        """Whole signals, also where some of their components are not measured. Raises ExperimentError."""
        qpos, qvel, act, _ = sysid.TimeSeries.compute_all_state_mappings(task.system.model)
        wholes = {
            False: qpos | qvel | act,
            True: sysid.TimeSeries.compute_all_sensor_mapping(task.system.model),
        }
        mapping: dict[str, tuple[Any, np.ndarray]] = {}
        columns: list[tuple[bool, int]] = []
        sought = [
            (o.sensor is not None, o.state if o.sensor is None else o.sensor)
            for o in task.system.outputs.outputs
        ]
        for output, (sensed, place) in zip(task.system.outputs.outputs, sought, strict=True):
            hits = [name for name, (_, indices) in wholes[sensed].items() if place in indices]
            if not hits or hits[0] in ("_qpos", "_qvel"):
                raise ExperimentError(
                    f"output {output.name!r}: sysid goes by names; give joint and body one in the MJCF"
                )
            kind, indices = wholes[sensed][hits[0]]
            if hits[0] not in mapping:
                mapping[hits[0]] = (kind, np.arange(len(columns), len(columns) + len(indices)))
                columns += [(sensed, int(i)) for i in indices]
        at = np.array([columns.index(pair) for pair in sought], dtype=np.intp)  # type: ignore[arg-type]
        labels = {
            int(column): (name if len(indices) == 1 else f"{name}[{k}]", kind)
            for name, (kind, indices) in mapping.items()
            for k, column in enumerate(indices)
        }
        return Layout(
            mapping,
            np.array([sensed for sensed, _ in columns], dtype=bool),
            np.array([place for _, place in columns], dtype=np.intp),
            at,
            {labels[c][0]: (labels[c][1], np.array([i])) for i, c in enumerate(at.tolist())},
        )

    def series(self, t: Array, y: Array) -> Any:
        """TimeSeries of outputs: (M, ny), NaN where not measured."""
        data = np.full((len(t), len(self.source)), np.nan)
        data[:, self.outputs] = y
        return sysid.TimeSeries(np.array(t), data, self.mapping)


@dataclass(frozen=True, eq=False)
class Compared:
    """Measured against predicted, `modify_residual` of sysid. h: engine timestep [s]

    noise: whitens; None: each signal is divided by its measured norm, as sysid does
    """

    layout: Layout
    h: float
    noise: Noise | None

    def __call__(
        self,
        params: Any,
        predicted: Any,
        measured: Any,
        model: Any,
        everything: bool,
        state: Array,
        **_: Any,
    ) -> tuple[Array, Any, Any]:
        """Residuals of what is measured, one after the other, and both TimeSeries after the start. everything: to be drawn"""
        layout, later = self.layout, measured.times > 0.0
        t, seen = measured.times[later], measured.data[later]
        y = np.empty(seen.shape)
        for sensed, values, first in ((False, state[:, 1:], 1), (True, predicted.data, 0)):
            chosen = layout.sensed == sensed
            if chosen.any():
                y[:, chosen] = read(values[:, layout.source[chosen]], t / self.h - first)
        seen, y = seen[:, layout.outputs], y[:, layout.outputs]
        present = np.isfinite(seen)
        drawn = bridged(t, seen) if everything else seen
        pair = (sysid.TimeSeries(t, y, layout.shown), sysid.TimeSeries(t, drawn, layout.shown))
        r = np.where(present, seen - y, 0.0)
        if self.noise is not None:
            return self.noise.whiten_present(r, present), *pair
        with np.errstate(invalid="ignore"):  # of what a recording does not hold
            return sysid.normalize_residual(r, np.where(present, seen, 0.0))[present], *pair


def bridged(t: Array, y: Array) -> Array:
    """(M, ny) with gaps filled linearly, for curves that could not be seen otherwise."""
    filled = np.array(y)
    for column in filled.T:
        seen = np.isfinite(column)
        if seen.any():
            column[~seen] = np.interp(t[~seen], t[seen], column[seen])
    return filled


def read(values: Array, place: Array) -> Array:
    """Rows of values: (n, c) at places (M,), in between by a cubic spline."""
    near = np.rint(place)
    if np.abs(place - near).max() <= ON_STEP:
        return np.asarray(values[near.astype(int)])
    return np.asarray(CubicSpline(np.arange(len(values)), values)(place))
