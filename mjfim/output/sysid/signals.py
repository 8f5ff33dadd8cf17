"""Outputs of an experiment as signals of `mujoco.sysid`, and their residuals.

sysid gives the sensor values of a step the time after the step, although they belong to the state
before it; states are not delayed. Therefore positions and velocities become state signals, and
sensors are read one step earlier. sysid divides residuals by the norm of each measured signal,
whatever its noise, and takes weights by name for sensors only; here residuals are whitened, or
divided by these norms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from mujoco import sysid
from scipy.interpolate import CubicSpline

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.plant.noise import Noise
from mjfim.plant.outputs import Output

# Largest distance of a time from an engine step at which it counts as on that step [engine steps].
ON_STEP_TOLERANCE = 1e-6

# Names that sysid gives to the state of joints without a name.
UNNAMED_SIGNALS = ("_qpos", "_qvel")


# Type of a signal in sysid and its indices in sensordata or in the state, by name.
SignalMapping = dict[str, tuple[Any, np.ndarray]]

# Whether a column belongs to a sensor, and its index in sensordata or in the state.
Place = tuple[bool, int]


@dataclass(frozen=True, eq=False, kw_only=True)
class SignalLayout:
    """Columns of a sysid TimeSeries that holds the outputs of an experiment.

    Attributes:
        mapping: Type and columns of each signal by name, in the form that sysid takes.
        sensed: (c,) True for columns of sensors.
        source: (c,) index of each column in sensordata or in the state (qpos, qvel, act).
        outputs: (ny,) column of each output of the experiment.
        shown: Type and column of each of the ny outputs by name; sysid's report can draw single
            components only.
    """

    mapping: SignalMapping
    sensed: np.ndarray
    source: np.ndarray
    outputs: np.ndarray
    shown: SignalMapping

    @staticmethod
    def of(system: System) -> SignalLayout:
        """Lay out whole signals, also where some of their components are not measured.

        Args:
            system: The experiment.

        Raises:
            ExperimentError: An output belongs to a joint or body without a name.
        """
        qpos, qvel, act, _ = sysid.TimeSeries.compute_all_state_mappings(system.model)
        states = qpos | qvel | act
        sensors = sysid.TimeSeries.compute_all_sensor_mapping(system.model)

        # Every signal that has a measured component takes one column per component.
        mapping: SignalMapping = {}
        columns: list[Place] = []
        places = [_place(output) for output in system.outputs.outputs]
        for output, (sensed, index) in zip(system.outputs.outputs, places, strict=True):
            signals = sensors if sensed else states
            name = _signal_name(signals, index, output.name)
            if name not in mapping:
                kind, indices = signals[name]
                mapping[name] = (kind, len(columns) + np.arange(len(indices)))
                columns += [(sensed, int(i)) for i in indices]

        outputs = [columns.index(place) for place in places]
        return SignalLayout(
            mapping=mapping,
            sensed=np.array([sensed for sensed, _ in columns], dtype=bool),
            source=np.array([index for _, index in columns], dtype=np.intp),
            outputs=np.array(outputs, dtype=np.intp),
            shown=_single_signals(mapping, outputs),
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


def _place(output: Output) -> Place:
    """Return where the value of an output comes from."""
    if output.sensor is not None:
        return True, output.sensor
    return False, cast("int", output.state)


def _signal_name(signals: SignalMapping, index: int, output: str) -> str:
    """Return the name of the signal that holds an index; raise ExperimentError if it has none."""
    for name, (_, indices) in signals.items():
        if index in indices and name not in UNNAMED_SIGNALS:
            return name
    raise ExperimentError(
        f"output {output!r}: sysid finds signals by name; name the joint and the body in the MJCF"
    )


def _single_signals(mapping: SignalMapping, outputs: Sequence[int]) -> SignalMapping:
    """Return a signal of one component for each of the columns `outputs`, in their order."""
    names: dict[int, tuple[str, Any]] = {}
    for name, (kind, columns) in mapping.items():
        for k, column in enumerate(columns):
            names[int(column)] = (name if len(columns) == 1 else f"{name}[{k}]", kind)

    single: SignalMapping = {}
    for i, column in enumerate(outputs):
        name, kind = names[column]
        single[name] = (kind, np.array([i]))
    return single


@dataclass(frozen=True, eq=False, kw_only=True)
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
        after_start = measured.times > 0.0
        t = measured.times[after_start]
        y = measured.data[after_start][:, self.layout.outputs]
        y_predicted = self._predicted_outputs(predicted.data, state, t)
        present = np.isfinite(y)

        shown = self.layout.shown
        drawn = interpolate_gaps(t, y) if everything else y
        pair = (sysid.TimeSeries(t, y_predicted, shown), sysid.TimeSeries(t, drawn, shown))

        residual = np.where(present, y - y_predicted, 0.0)
        if self.noise is not None:
            return self.noise.whiten_present(residual, present), *pair

        # The norm of a signal that was not measured is 0; its residuals are left out.
        with np.errstate(invalid="ignore"):
            normalized = sysid.normalize_residual(residual, np.where(present, y, 0.0))
        return normalized[present], *pair

    def _predicted_outputs(self, sensors: Array, state: Array, t: Array) -> Array:
        """Return the (M, ny) predicted outputs [y-unit] at the times t (M,) [s].

        Args:
            sensors: (n, nsensordata) sensor values; row 0 belongs to the time 0.
            state: (n, 1 + nx) time and state after every engine step; row 0 is after the first.
            t: (M,) times [s].
        """
        columns = np.empty((len(t), len(self.layout.source)))
        for sensed, values, first_step in ((False, state[:, 1:], 1), (True, sensors, 0)):
            chosen = self.layout.sensed == sensed
            if chosen.any():
                rows = t / self.timestep - first_step
                columns[:, chosen] = interpolated(values[:, self.layout.source[chosen]], rows)
        return columns[:, self.layout.outputs]


def interpolate_gaps(t: Array, y: Array) -> Array:
    """Fill gaps of measured outputs linearly; a curve through single samples could not be seen.

    Args:
        t: (M,) times [s].
        y: (M, ny) outputs [y-unit]; NaN where not measured.
    """
    filled = np.array(y)
    for column in filled.T:
        known = np.isfinite(column)
        if known.any():
            column[~known] = np.interp(t[~known], t[known], column[known])
    return filled


def interpolated(values: Array, rows: Array) -> Array:
    """Return values at whole engine steps, and between them by a cubic spline.

    Args:
        values: (n, c) values at the engine steps.
        rows: (M,) numbers of the rows, which need not be whole.

    Returns:
        (M, c) values.
    """
    nearest = np.rint(rows)
    if np.abs(rows - nearest).max() <= ON_STEP_TOLERANCE:
        return np.asarray(values[nearest.astype(int)])
    return np.asarray(CubicSpline(np.arange(len(values)), values)(rows))
