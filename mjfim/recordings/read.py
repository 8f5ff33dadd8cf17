"""Reader of recordings: it applies the experiment's `[recording]` table to the columns of a log.

The times are those of the log, and nothing is interpolated. Only a control is held over rows in
which it is empty.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, closest, listed, unknown
from mjfim.model.coordinates import state_components, unknown_coordinate
from mjfim.recordings import formats
from mjfim.recordings.angle_units import check_angles
from mjfim.recordings.channels import Channels
from mjfim.recordings.column_units import check_unit, convert, units_of
from mjfim.recordings.formats.table import Table
from mjfim.recordings.law_columns import (
    check_references,
    require_law,
    require_one_source,
    units_of_inputs,
)
from mjfim.recordings.spec import INPUT_PREFIXES, LAW_PREFIXES, ColumnSpec, RecordingSpec
from mjfim.recordings.summary import LogSummary, summarize
from mjfim.recordings.validity import (
    SECONDS,
    check_clock,
    check_finite,
    check_held,
    check_measured,
    hold_last_value,
)
from mjfim.records.trajectory import Recording

# Endings of the names in a LeRobot dataset: of measured states, with the coordinates that they are,
# and of controls.
LEROBOT_STATES = {".pos": "qpos:", ".vel": "qvel:"}
LEROBOT_CONTROLS = (".pos", ".vel", ".effort")

# Tolerance of the beginning and the end of the window [s].
WINDOW_TOLERANCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """A recording, and a summary of the log from which it was read.

    Attributes:
        recording: The measured data in SI units.
        summary: Clock and columns of the log.
    """

    recording: Recording
    summary: LogSummary


def read_recording(path: Path, channels: Channels) -> Recording:
    """Read a recording from a log of any format.

    Args:
        path: The log: a file, or the folder of a ROS 2 bag.
        channels: The signals of the experiment, and how to read them.

    Returns:
        The recording, in SI units.

    Raises:
        ExperimentError: The `[recording]` table does not fit the model.
        RecordingError: The log cannot be used; the message names file and column.
    """
    return read_log(path, channels).recording


def read_log(path: Path, channels: Channels) -> Log:
    """Read a recording from a log of any format, and summarize the log.

    Args:
        path: The log: a file, or the folder of a ROS 2 bag.
        channels: The signals of the experiment, and how to read them.

    Returns:
        The recording, in SI units, and the summary.

    Raises:
        ExperimentError: The `[recording]` table does not fit the model.
        RecordingError: The log cannot be used; the message names file and column.
    """
    check_spec(channels)
    spec = channels.spec

    table = formats.read_columns(path, spec)
    if "time" not in spec.model_fields_set:
        _require_default(table, "time", spec.time, key="[recording] time")
    sources = _sources(table, channels)
    measured = tuple(name for name in sources if name not in channels.control_columns)

    stamps, rows = _window(table, spec)
    check_clock(f"{path}: column {spec.time!r}", stamps[rows], rows.start, spec.time_unit, spec.gap)
    columns = _columns(table, sources, stamps, rows, spec)

    # The recording begins at time 0.
    t = stamps[rows] - stamps[rows.start]
    for name in measured:
        check_measured(f"{path}: column {sources[name].column!r}", t, columns[name], spec.gap)
    stated = {name for name, source in sources.items() if source.unit is not None}
    if table.unit_hint:
        _check_units_of_controls(table, sources)
    try:
        check_angles(str(path), channels.model, t, columns, stated)
    except RecordingError as error:
        raise RecordingError(f"{error}. {table.unit_hint}" if table.unit_hint else error) from None
    check_references(path, channels, columns, stated)

    column_names = {name: source.column for name, source in sources.items()}
    summary = summarize(str(path), t, columns, column_names, dropped=len(stamps) - len(t))

    # Columns are dropped as soon as the recording holds them, since logs may be long.
    table.columns.clear()
    recording = Recording(
        t=_frozen(t),
        ctrl=_controls(columns, channels, len(t) - 1),
        y=_joined(columns, measured, len(t)),
        outputs=measured,
        name=str(path),
    )
    return Log(recording=recording, summary=summary)


def _controls(columns: dict[str, Array], channels: Channels, rows: int) -> Array:
    """(M-1, nu) controls of all rows but the last one, whose control would act after the end.

    A model without actuators has none. The columns of controls are taken out of `columns`.
    """
    constants = channels.spec.constants
    for name in channels.control_columns:
        if name in constants:
            columns[name] = np.full(rows, constants[name])
    return _joined(columns, channels.control_columns, rows)


def _joined(columns: dict[str, Array], names: Sequence[str], rows: int) -> Array:
    """(rows, n) read-only matrix of the first rows of n columns, taken out of `columns`."""
    matrix = np.empty((rows, len(names)))
    for j, name in enumerate(names):
        matrix[:, j] = columns.pop(name)[:rows]
    return _frozen(matrix)


def _frozen(array: Array) -> Array:
    """This array, read-only from now on, so that records share it."""
    own = array if array.flags.owndata else np.array(array)
    own.setflags(write=False)
    return own


def recording_paths(paths: Sequence[Path], channels: Channels) -> list[Path]:
    """List the recordings that logs hold: one for each log, or for each episode of a dataset.

    Args:
        paths: Logs, and folders of LeRobot datasets, of which all episodes or those of
            `recording.episodes` are recordings.
        channels: The signals of the experiment, and how to read them.

    Returns:
        One path for each recording.

    Raises:
        RecordingError: A dataset cannot be read.
    """
    found: list[Path] = []
    for path in paths:
        is_dataset = formats.is_lerobot_dataset(path)
        found += formats.lerobot_episodes(path, channels.spec) if is_dataset else [path]
    return found


def check_spec(channels: Channels) -> None:
    """Check the `[recording]` table against the model.

    Args:
        channels: The signals of the experiment, and how to read them.

    Raises:
        ExperimentError: A column has an unknown name, or a unit that does not fit it.
    """
    where = f"{channels.source}: recording.columns"
    units = units_of(channels.model)
    units.update(dict.fromkeys(channels.control_columns, "any"))
    units.update(units_of_inputs(channels))

    for name in channels.spec.columns:
        if name not in units:
            require_law(where, name, channels)
            raise ExperimentError(f"{where}: {unknown_coordinate('column', name, list(units))}")

    for name, source in channels.spec.sources.items():
        check_unit(f"{where}.{name}", source, units[name])
    for name in channels.spec.constants:
        if name not in channels.control_columns:
            raise ExperimentError(
                f"{where}.{name}: a number is the value of a constant control, and this is a "
                "measured column; state the name of the column in the log"
            )


def _check_units_of_controls(table: Table, sources: Mapping[str, ColumnSpec]) -> None:
    """Refuse commands without a unit beside positions that have one: both have that of the robot.

    Args:
        table: The log, in whose format commands of servos end in `.pos`.
        sources: Rules of the columns.
    """
    converted = [name for name, s in sources.items() if s.unit is not None or s.scale != 1.0]
    positions = [name for name in converted if name.startswith("qpos:")]
    for name, source in sources.items():
        is_command = source.column.startswith("action:") and source.column.endswith(".pos")
        if positions and is_command and name not in converted:
            raise RecordingError(
                f"{table.source}: {positions[0]!r} has a unit or a scale in [recording.columns], "
                f"but the command {name!r} has none; state the same for it, as in {name!r} = "
                f'{{ column = "{source.column}", unit = "deg" }}, or unit = "rad"'
            )


def _sources(table: Table, channels: Channels) -> dict[str, ColumnSpec]:
    """Rules of all columns of the recording, first the controls, then the measured columns.

    A control without a stated rule or value is read under its default name. Measured columns are
    read under their default names only if the experiment file states none of them.
    """
    stated = channels.spec.sources
    default = _columns_by_default_name(table, channels)
    if channels.laws is not None:
        require_one_source(table.source, table.names, channels)

    controls = {
        name: stated.get(name) or ColumnSpec(column=default.get(name, name))
        for name in channels.control_columns
        if name not in channels.spec.constants
    }
    # The look-up of a missing column raises the error that explains it.
    for name, source in controls.items():
        if name not in stated:
            key = f'[recording.columns] "{name}"'
            off = f"; if the motor was off or its control constant, state the value: {key} = 0.0"
            if not name.startswith("ctrl:"):
                off = f"; where it is constant, state the value, for example {key} = 1.0"
            _require_default(table, name, source.column, key=key, otherwise=off)
        table.column(source.column)

    measured = {name: source for name, source in stated.items() if name not in controls}
    if not measured:
        _check_names(table, channels)
        measured = {
            name: ColumnSpec(column=default[name]) for name in channels.outputs if name in default
        }

    if not any(name in measured for name in channels.outputs):
        used = {channels.spec.time, *(source.column for source in controls.values())}
        found = measured or [name for name in table.names if name not in used]
        fault = unknown("column", listed([*found]), channels.outputs)
        advice = "" if measured else _advice(channels.outputs, list(found))
        raise RecordingError(f"{table.source}: no measured column; {fault}{advice}")

    return {**controls, **measured}


def _require_default(
    table: Table, name: str, column: str, *, key: str, otherwise: str = ""
) -> None:
    """Raise RecordingError if the log lacks a column that the experiment file does not state.

    Args:
        table: The log.
        name: What the column holds.
        column: Name that the column has in the files of mjfim.
        key: Key of the experiment file that states another name.
        otherwise: End of the message, where there is another way.
    """
    if column in table.names:
        return

    # Names of other programs have no prefix such as `ctrl:`, and often other capitals.
    plain = {own.lower(): own for own in table.names}
    near = closest(name.lower(), list(plain)) or closest(
        name.rpartition(":")[2].lower(), list(plain)
    )
    proposal = plain[near] if near else "<name of the column in the log>"
    raise RecordingError(
        f"{table.source}: column {column!r} is missing; found: {listed(table.names)}. If another "
        f'column holds it, state its name in the experiment file: {key} = "{proposal}"{otherwise}'
    )


def _check_names(table: Table, channels: Channels) -> None:
    """Refuse a column whose name looks like mjfim's but does not exist in this model.

    A misspelled joint is an example.
    """
    known = (*channels.control_columns, *channels.measurable)
    for name in table.names:
        if name.startswith(("ctrl:", "qpos:", "qvel:", *LAW_PREFIXES)) and name not in known:
            require_law(table.source, name, channels)
            fault = unknown_coordinate("column", name, ["t", *known])
            raise RecordingError(f"{table.source}: {fault}")


def _advice(outputs: Sequence[str], found: Sequence[str]) -> str:
    """End of a message about a log without a column of mjfim's names.

    outputs: names of the measured outputs. found: names of the columns that the log has.
    """
    plain = {own.lower(): own for own in found}
    pairs = ((name, closest(name.rpartition(":")[2].lower(), list(plain))) for name in outputs)
    name, near = next(((name, plain[near]) for name, near in pairs if near), (outputs[0], ""))
    column = near or "<name of the column in the log>"
    return (
        ". Columns with other names are stated in the experiment file, for example "
        f'[recording.columns] "{name}" = "{column}"'
    )


def _columns_by_default_name(table: Table, channels: Channels) -> dict[str, str]:
    """Names of the table's columns, by the names that mjfim gives them.

    The joint states of a bag and the matrices of a design.npz have other names there; all other
    columns keep their names.
    """
    found = {}
    for name in table.names:
        for quantity, coordinate in (("position:", "qpos:"), ("velocity:", "qvel:")):
            if name.startswith(quantity):
                found[coordinate + name.removeprefix(quantity)] = name
        found |= dict.fromkeys(_names_of_lerobot_column(name), name)

    for matrix, parts in _matrices(channels).items():
        labels = [name for name in table.names if name == matrix or name.startswith(f"{matrix}[")]
        if not labels:
            continue
        if len(labels) != len(parts):
            raise RecordingError(
                f"{table.source}: array {matrix!r} has {len(labels)} columns; the model needs "
                f"{len(parts)}: {listed(parts)}"
            )
        found.update(zip(parts, labels, strict=True))

    found.update({name: name for name in table.names})
    return found


def _names_of_lerobot_column(name: str) -> list[str]:
    """Names in mjfim that a column of a LeRobot dataset may mean.

    A state without an ending is a position. The control of a motor may have any ending.
    """
    feature, _, component = name.partition(":")
    stem, dot, ending = component.rpartition(".")

    if feature == "observation.state":
        coordinate = LEROBOT_STATES.get(f"{dot}{ending}")
        return [f"{coordinate}{stem}"] if coordinate else [f"qpos:{component}"]
    if feature == "action":
        actuator = stem if f"{dot}{ending}" in LEROBOT_CONTROLS else component
        return [f"ctrl:{actuator}", f"reference:{actuator}"]
    return []


def _matrices(channels: Channels) -> dict[str, list[str]]:
    """Default names of the columns of the matrices qpos, qvel and ctrl.

    A matrix is left out if stated rules replace it.
    """
    stated = channels.spec.columns
    state = [component.name for component in state_components(channels.model)]
    nq = channels.model.nq

    matrices = {}
    if all(name.startswith(INPUT_PREFIXES) for name in stated):
        matrices["qpos"] = state[:nq]
        matrices["qvel"] = state[nq:]
    if channels.laws is None and any(name not in stated for name in channels.control_columns):
        matrices["ctrl"] = list(channels.control_columns)
    return matrices


def _window(table: Table, spec: RecordingSpec) -> tuple[Array, slice]:
    """(M,) times of all rows [s], and the rows inside the window."""
    t = table.measurement(spec.time) * SECONDS[spec.time_unit]
    if spec.window is None or not len(t):
        return t, slice(0, len(t))

    since = t - t[0]
    begin = _first_true(since >= spec.window[0] - WINDOW_TOLERANCE)

    # The window ends at the first time after its end. Only rows after its beginning are searched,
    # because the clock may have restarted before.
    end = begin + _first_true(since[begin:] > spec.window[1] + WINDOW_TOLERANCE)

    if end == begin:
        raise RecordingError(
            f"{table.source}: recording.window: no row between {spec.window[0]:g} and "
            f"{spec.window[1]:g} s; the log lasts {t[-1] - t[0]:g} s"
        )
    return t, slice(begin, end)


def _first_true(condition: np.ndarray) -> int:
    """Index of the first True of condition: (M,); M if there is none."""
    return int(np.argmax(condition)) if condition.any() else len(condition)


def _columns(
    table: Table, sources: Mapping[str, ColumnSpec], t: Array, rows: slice, spec: RecordingSpec
) -> dict[str, Array]:
    """Converted columns inside the window, by the name of the recording's column.

    Empty rows of a control get its last value, which may be from before the window.
    """
    columns = {}

    for name, source in sources.items():
        # Truth values may switch a control or a factor on and off.
        if not name.startswith(INPUT_PREFIXES):
            table.measurement(source.column)

        for raw in (source.column, *source.multiply_by):
            check_finite(f"{table.source}: column {raw!r}", table.column(raw)[rows], rows.start)

        values = convert(table, source)
        if name.startswith(INPUT_PREFIXES):
            values, age = hold_last_value(t, values)
            kind = "control" if name.startswith("ctrl:") else "input"
            where = f"{table.source}: column {source.column!r} (the {kind} {name!r})"
            check_held(where, t[rows][:-1], values[rows][:-1], age[rows][:-1], spec.gap)

        # Finite raw numbers may become infinite by the conversion.
        columns[name] = values[rows]
        check_finite(f"{table.source}: column {name!r}", columns[name], rows.start)

    return columns
