"""Outputs of an experiment as signals of `mujoco.sysid`, and their residuals.

sysid stamps the sensor values of a step with the time after the step, though they belong to the
state before it; states are not delayed. So positions and velocities become state signals, and
sensors are read one step earlier. sysid divides residuals by the norm of each measured signal,
whatever its noise, and takes weights by name for sensors only; here residuals are whitened, or
divided in the manner of sysid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco import sysid
from scipy.interpolate import CubicSpline

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.plant.noise import Noise

# Largest distance of a time from an engine step at which it counts as on that step [engine steps].
ON_STEP_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class SignalLayout:
    """Columns of a sysid TimeSeries that holds the outputs of an experiment.

    Attributes:
        mapping: Type and columns of each signal by name, in the form that sysid takes.
        sensed: (c,) True for columns of sensors.
        source: (c,) place of each column in sensordata or in the state (qpos, qvel, act).
        outputs: (ny,) column of each output of the experiment.
        shown: Type and column of each of the ny outputs by name; sysid's report can draw single
            components only.
    """

    mapping: dict[str, tuple[Any, np.ndarray]]
    sensed: np.ndarray
    source: np.ndarray
    outputs: np.ndarray
    shown: dict[str, tuple[Any, np.ndarray]]

    @staticmethod
    def of(system: System) -> SignalLayout:
        """Lay out whole signals, also where some of their components are not measured.

        Args:
            system: The experiment.

        Raises:
            ExperimentError: An output belongs to a joint or body without a name.
        """
        qpos, qvel, act, _ = sysid.TimeSeries.compute_all_state_mappings(system.model)
        wholes = {
            False: qpos | qvel | act,
            True: sysid.TimeSeries.compute_all_sensor_mapping(system.model),
        }
        mapping: dict[str, tuple[Any, np.ndarray]] = {}
        columns: list[tuple[bool, int]] = []
        sought = [
            (o.sensor is not None, o.state if o.sensor is None else o.sensor)
            for o in system.outputs.outputs
        ]
        for output, (sensed, place) in zip(system.outputs.outputs, sought, strict=True):
            hits = [name for name, (_, indices) in wholes[sensed].items() if place in indices]
            if not hits or hits[0] in ("_qpos", "_qvel"):
                raise ExperimentError(
                    f"output {output.name!r}: sysid goes by names; give joint and body one in the "
                    "MJCF"
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
        return SignalLayout(
            mapping,
            np.array([sensed for sensed, _ in columns], dtype=bool),
            np.array([place for _, place in columns], dtype=np.intp),
            at,
            {labels[c][0]: (labels[c][1], np.array([i])) for i, c in enumerate(at.tolist())},
        )

    def series(self, t: Array, y: Array) -> Any:
        """Return outputs as a TimeSeries of sysid.

        Args:
            t: (M,) times [s].
            y: (M, ny) outputs [y-unit]; NaN where not measured.
        """
        data = np.full((len(t), len(self.source)), np.nan)
        data[:, self.outputs] = y
        return sysid.TimeSeries(np.array(t), data, self.mapping)


@dataclass(frozen=True, eq=False)
class WhitenedComparison:
    """Residuals of measured and predicted outputs, in the form of `modify_residual` of sysid.

    Attributes:
        layout: Columns of the signals.
        timestep: Timestep of the engine [s].
        noise: Noise that whitens the residuals; None where each signal is divided by its measured
            norm.
    """

    layout: SignalLayout
    timestep: float
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
        """Return the residuals of all measured values, and both TimeSeries after time 0.

        Args:
            params: Parameters, not used.
            predicted: Predicted TimeSeries of the sensors.
            measured: Measured TimeSeries.
            model: The model, not used.
            everything: True where the TimeSeries are to be drawn.
            state: States of the rollout, with the time in the first column.
        """
        layout, later = self.layout, measured.times > 0.0
        t, seen = measured.times[later], measured.data[later]
        y = np.empty(seen.shape)
        for sensed, values, first in ((False, state[:, 1:], 1), (True, predicted.data, 0)):
            chosen = layout.sensed == sensed
            if chosen.any():
                y[:, chosen] = interpolated(
                    values[:, layout.source[chosen]], t / self.timestep - first
                )
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
    """Fill gaps of measured outputs linearly; a curve through single samples could not be seen.

    Args:
        t: (M,) times [s].
        y: (M, ny) outputs [y-unit]; NaN where not measured.
    """
    filled = np.array(y)
    for column in filled.T:
        seen = np.isfinite(column)
        if seen.any():
            column[~seen] = np.interp(t[~seen], t[seen], column[seen])
    return filled


def interpolated(values: Array, place: Array) -> Array:
    """Return rows of values between the engine steps by a cubic spline.

    Args:
        values: (n, c) values at the engine steps.
        place: (M,) engine steps, which need not be whole numbers.
    """
    near = np.rint(place)
    if np.abs(place - near).max() <= ON_STEP_TOLERANCE:
        return np.asarray(values[near.astype(int)])
    return np.asarray(CubicSpline(np.arange(len(values)), values)(place))
