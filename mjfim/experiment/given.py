"""Recordings and trajectories as Python and the command line give them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from mjfim.errors import ExperimentError, RecordingError, in_words, unknown
from mjfim.experiment.arguments import is_numeric
from mjfim.experiment.system import System
from mjfim.recordings.formats import table_of_arrays
from mjfim.recordings.read import log_of, read_recording, recording_paths
from mjfim.recordings.section import RecordingSpec
from mjfim.records.design import Design
from mjfim.records.trajectory import Recording, Trajectory


@runtime_checkable
class SysidSequences(Protocol):
    """A `ModelSequences` of mujoco.sysid, each of whose sequences is a recording."""

    sequence_name: Any
    control: Any
    sensordata: Any


# Names of the arrays of one recording: (M,) times, (M or M-1, nu) controls, and (M, n) positions,
# velocities and values of all sensors, as MuJoCo has them. A table holds columns by name.
ARRAY_NAMES = ("t", "ctrl", "qpos", "qvel", "sensordata")
Arrays = ArrayLike | Mapping[str, ArrayLike]

# A recording: itself, a log of any format, or arrays by `ARRAY_NAMES` or by the columns of a log.
RecordingLike = Recording | str | Path | Mapping[str, Any] | SysidSequences
RecordingsLike = RecordingLike | Sequence[RecordingLike]

# A motion: a trajectory, or the design that has it.
TrajectoryLike = Trajectory | Design

NO_ARRAYS: Mapping[str, Any] = MappingProxyType({})

# Relative deviation of two sample periods that is round-off.
PERIOD_TOLERANCE = 1e-6

# Ends of the names of signals of sysid, and what mjfim calls them.
SUFFIXES = {"MjStateQPos": "qpos", "MjStateQVel": "qvel", "MjCtrl": "ctrl"}

# Name of a recording that is given as arrays.
ARRAYS_NAME = "arrays"


def check_fits(name: str | Path, trajectory: Trajectory, system: System) -> None:
    """Check that a motion belongs to an experiment.

    Args:
        name: What it is, or its file, for the message.
        trajectory: The motion.
        system: The experiment.

    Raises:
        RecordingError: The motion was made for another model or another rate.
    """
    parts = (trajectory.qpos, trajectory.qvel, trajectory.act, trajectory.ctrl)
    found = tuple(width for part in parts for width in part.shape[1:])
    model = system.model
    wanted = (model.nq, model.nv, model.na, len(system.inputs))
    if found != wanted:
        raise RecordingError(
            f"{name}: made for (nq, nv, na, nu) = {found}, the experiment's model has {wanted}"
        )

    if abs(trajectory.dt - system.dt) > PERIOD_TOLERANCE * system.dt:
        raise RecordingError(
            f"{name}: sampled at {1 / trajectory.dt:g} Hz, the experiment at {1 / system.dt:g} Hz"
        )


def recordings_of(
    system: System, given: RecordingsLike, arrays: Mapping[str, Any] = NO_ARRAYS
) -> tuple[Recording, ...]:
    """All recordings of what is given, one of which needs no list.

    Args:
        system: The system, whose table `[recording]` says how logs and columns are read.
        given: Recordings, paths of logs, tables of MuJoCo's arrays or of the columns of a log, and
            `ModelSequences` of mujoco.sysid.
        arrays: One more recording by the names of `ARRAY_NAMES`.

    Raises:
        ExperimentError: An array has another name.
        RecordingError: A log or an array cannot be used.
    """
    for name in arrays:
        if name not in ARRAY_NAMES:
            raise ExperimentError(unknown("argument", name, ARRAY_NAMES))
    stated: Any = given if isinstance(given, (list, tuple)) else [given]
    every = [*stated, arrays] if arrays else stated
    return tuple(found for each in every for found in _recordings(system, each))


def _recordings(system: System, given: RecordingLike) -> Iterator[Recording]:
    """The recordings of one entry."""
    channels = system.channels
    if isinstance(given, Recording):
        yield given
    elif given == "":
        raise RecordingError('recordings: "" names no log; give the path of one')
    elif isinstance(given, (str, Path)):
        for path in recording_paths([Path(given)], channels.spec):
            yield read_recording(path, channels)
    else:
        # The table is about logs; MuJoCo's arrays have MuJoCo's names and units.
        pairs = [(ARRAYS_NAME, given)] if isinstance(given, Mapping) else _columns_of(given)
        if not (isinstance(given, Mapping) and given.keys() - ARRAY_NAMES):
            channels = replace(channels, spec=RecordingSpec(gap=channels.spec.gap))
        for name, columns in pairs:
            if channels.spec.time not in columns:
                raise RecordingError(
                    f"{name}: {channels.spec.time!r} is missing, the time of each row [s]"
                )
            table = table_of_arrays(Path(name), _by_column(name, columns), channels.spec)
            yield log_of(replace(table, is_file=False), channels)[0]


def _by_column(name: str, columns: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays by the name of the column or matrix; tables hold columns by joint or sensor."""
    found: dict[str, Any] = {}
    for key, values in columns.items():
        prefix = "" if key == "sensordata" else f"{key}:"
        is_table = isinstance(values, Mapping)
        found |= {prefix + k: v for k, v in values.items()} if is_table else {key: values}
    for key, values in found.items():
        if not is_numeric(values) and not isinstance(values, (int, float)):
            raise RecordingError(
                f"{name}: {key!r}: needs an array of numbers; not {in_words(values)}"
            )
        # A matrix of one column is a column.
        array = np.asarray(values)
        found[key] = array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array
    return found


def _columns_of(sequences: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Names and columns of the sequences of a `ModelSequences`; their initial states are not used.

    A time of a measurement is that of the state that is measured.
    """
    for name, control, measured in zip(
        sequences.sequence_name, sequences.control, sequences.sensordata, strict=True
    ):
        t = np.union1d(control.times, measured.times)
        columns = {"t": t}
        for series, whole in ((control, "ctrl"), (measured, "sensordata")):
            rows = np.full((len(t), series.data.shape[1]), np.nan)
            rows[np.searchsorted(t, series.times)] = series.data
            for signal, (kind, indices) in (series.signal_mapping or {whole: (None, ...)}).items():
                quantity = SUFFIXES.get(getattr(kind, "name", ""))
                key = signal
                if quantity is not None:
                    key = f"{quantity}:{signal.removesuffix(f'_{quantity}')}"
                columns[key] = rows[:, indices]
        yield name, columns
