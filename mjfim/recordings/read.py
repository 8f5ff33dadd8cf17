"""Reader of recordings: it applies the experiment's `[recording]` table to the columns of a log.

The times are those of the log, and nothing is interpolated. Only a control is held over rows in
which it is empty. With the names of `ColumnSpec`, a column of the recording is

    value = (scale * unit * raw + offset) * product of the columns `multiply_by`          (1)

Signs are restored and counter wraps are removed from the raw numbers before; jumps by whole turns
are removed from the values.
"""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow

from mjfim.arrays import Array, record
from mjfim.errors import RecordingError, RecordingWarning, listed, shortened, unknown
from mjfim.model.coordinates import sensor_columns, state_components, unknown_coordinate
from mjfim.recordings.channels import (
    ANY,
    UNIT_FACTORS,
    Channels,
    check_spec,
    require_law,
    units_of,
)
from mjfim.recordings.checks import (
    LARGEST_VALUE,
    MIN_ROWS,
    check_angles,
    check_clock,
    check_finite,
    check_held,
    check_measured,
    in_order,
)
from mjfim.recordings.formats import Table, is_lerobot_dataset, lerobot_episodes, read_columns
from mjfim.recordings.proposal import proposed_recording, references, sensors_of_joints
from mjfim.recordings.quantities import TURN, Unit
from mjfim.recordings.section import INPUT_PREFIXES, LAW_PREFIXES, ColumnSpec, RecordingSpec
from mjfim.records.base import Record
from mjfim.records.trajectory import Recording

# Differences below this fraction of the column's largest value are rounding errors.
ROUNDING = 1e-12


@record
class ColumnSummary(Record):
    """Range and resolution of one column of a recording, in the model's unit.

    Attributes:
        name: Name of the column in the recording.
        source: Name of the column in the log.
        minimum: Smallest value, NaN if the column is empty.
        maximum: Largest value, NaN if the column is empty.
        empty_share: Share of the rows that are empty, 0 to 1.
        resolution: Smallest difference between two different values, 0 if all values are equal.
    """

    name: str
    source: str
    minimum: float
    maximum: float
    empty_share: float
    resolution: float


@record
class LogSummary(Record):
    """Clock and columns of one log.

    Attributes:
        file: The log.
        rows: Number of rows inside the window.
        duration: Time from the first to the last row [s].
        rate: Inverse of the median step [Hz].
        jitter_std: Standard deviation of the steps about their median [s].
        longest_step: Longest step [s].
        dropped: Number of rows outside the window.
        columns: Summary of each column of the recording.
    """

    file: str
    rows: int
    duration: float
    rate: float
    jitter_std: float
    longest_step: float
    dropped: int
    columns: tuple[ColumnSummary, ...]


def summarize(
    file: str, t: Array, columns: Mapping[str, Array], sources: Mapping[str, ColumnSpec], rows: int
) -> LogSummary:
    """Summarize a log.

    Args:
        file: The log.
        t: (M,) times inside the window [s], M > 1.
        columns: (M,) values by name of the recording's column, NaN where empty.
        sources: Rules of the columns, by name.
        rows: Number of rows inside and outside the window.
    """
    steps = np.diff(t)
    return LogSummary(
        file=file,
        rows=len(t),
        duration=float(t[-1] - t[0]),
        rate=1.0 / float(np.median(steps)),
        jitter_std=float(steps.std()),
        longest_step=float(steps.max()),
        dropped=rows - len(t),
        columns=tuple(
            _column(name, sources[name].column, values) for name, values in columns.items()
        ),
    )


def _column(name: str, source: str, values: Array) -> ColumnSummary:
    """Summary of one column; values: (M,), NaN where empty."""
    present = np.sort(values[np.isfinite(values)])

    differences = np.diff(present)
    differences = differences[differences > ROUNDING * np.abs(present[[0, -1]]).max()]

    return ColumnSummary(
        name=name,
        source=source,
        minimum=float(present[0]),
        maximum=float(present[-1]),
        empty_share=1.0 - len(present) / len(values),
        resolution=min(differences.tolist(), default=0.0),
    )


# Names of columns in bags and in LeRobot datasets, and what they are in mjfim.
OTHER_NAMES = (
    (r"position:(.+)", ("qpos:",)),
    (r"velocity:(.+)", ("qvel:",)),
    (r"observation\.state:(.+)\.vel", ("qvel:",)),
    (r"observation\.state:(.+?)(?:\.pos)?", ("qpos:",)),
    (r"action:(.+?)(?:\.pos|\.vel|\.effort)?", ("ctrl:", "reference:")),
)

# Period of a control that is sent more seldom than rows are written [median steps of the rows].
MIN_PERIOD = 1.2

# Tolerance of the beginning and the end of the window [s].
WINDOW_TOLERANCE = 1e-9


def read_recording(path: Path, channels: Channels) -> Recording:
    """Read a recording from a log of any format. See `read_log`."""
    return read_log(path, channels)[0]


def read_log(path: Path, channels: Channels) -> tuple[Recording, LogSummary]:
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
    return log_of(read_columns(path, channels.spec), channels)


def log_of(table: Table, channels: Channels) -> tuple[Recording, LogSummary]:
    """Make a recording of the columns of a log, and summarize the log. See `read_log`."""
    check_spec(channels)
    spec, path = channels.spec, table.source
    if "time" not in spec.model_fields_set and spec.time not in table.names:
        raise _unfit(table, channels, f"column {spec.time!r} is missing")
    sources = _sources(table, channels)
    measured = tuple(name for name in sources if name not in channels.control_columns)

    sources = _in_units_of_titles(table, sources, channels)
    unit = spec.time_unit if "time_unit" in spec.model_fields_set else None
    table, stamps = _merged(table, sources, table.seconds(spec.time, unit))
    rows = _rows(table, channels, sources, stamps)
    numbers = _places(rows, len(stamps))
    check_clock(f"{path}: column {spec.time!r}", stamps[rows], numbers, spec.time_unit, spec.gap)
    columns = _columns(table, sources, stamps, rows, spec)

    # The recording begins at time 0.
    t = stamps[rows] - stamps[numbers[0]]
    resting = set()
    for name, position in references(channels):
        if name in columns and np.nanmin(columns[name]) == np.nanmax(columns[name]):
            resting |= {position, position.replace("qpos:", "qvel:", 1)}
    for name in measured:
        where = f"{path}: column {sources[name].column!r}"
        check_measured(where, t, columns[name], spec.gap, may_rest=name in resting)
    stated = {name for name, s in sources.items() if s.unit is not None or table.unit(s.column)}
    if table.unit_hint:
        _check_units_of_controls(table, sources)
    check_angles(str(path), channels, t, columns, stated, table.unit_hint)

    summary = summarize(str(path), t, columns, sources, len(stamps))
    columns |= {name: np.full(len(t), value) for name, value in spec.constants.items()}
    recording = Recording(
        t=t,
        # The control of the last row would act after the end.
        ctrl=_joined(columns, channels.control_columns, len(t) - 1),
        y=_joined(columns, measured, len(t)),
        outputs=measured,
        name=str(path),
    )
    return recording, summary


def recording_paths(paths: Sequence[Path], spec: RecordingSpec) -> list[Path]:
    """List the recordings that logs hold: one for each log, or for each episode of a dataset.

    Args:
        paths: Logs, or folders of LeRobot datasets.
        spec: How to read them.

    Raises:
        RecordingError: A dataset is damaged, or has no such episode.
    """
    found = []
    for path in paths:
        is_dataset = is_lerobot_dataset(path)
        found += lerobot_episodes(path, spec) if is_dataset else [path]
    return found


def _joined(columns: dict[str, Array], names: Sequence[str], rows: int) -> Array:
    """(rows, n) read-only matrix of the first rows of n columns, taken out of `columns`."""
    matrix = np.empty((rows, len(names)))
    for j, name in enumerate(names):
        matrix[:, j] = columns.pop(name)[:rows]
    matrix.setflags(write=False)
    return matrix


def _check_units_of_controls(table: Table, sources: Mapping[str, ColumnSpec]) -> None:
    """Refuse commands without a unit beside positions that have one, which holds for both."""
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


class RowReader:
    """Reads the rows of a CSV stream one after the other, by the rules of the files.

    Args:
        header: The first line, with the names of the columns.
        channels: The signals of the experiment, and how to read them.
        source: Name of the stream, for messages.

    Raises:
        ExperimentError: The `[recording]` table does not fit the model.
        RecordingError: A column is missing, or two have one name.
    """

    def __init__(self, header: str, channels: Channels, source: str) -> None:
        check_spec(channels)
        self._channels, self._source, spec = channels, Path(source), channels.spec
        self._names = [name.strip() for name in next(csv.reader([header]))]
        if len(set(self._names)) < len(self._names):
            raise RecordingError(f"{source}: line 1: two columns have the same name")
        # Only names and units are looked up here, so that one row of ones stands for all.
        table = Table.of(self._source, dict.fromkeys(self._names, np.ones(1)), spec)
        if "time" not in spec.model_fields_set and spec.time not in table.names:
            raise _unfit(table, channels, f"column {spec.time!r} is missing")
        self._sources = _in_units_of_titles(table, _sources(table, channels), channels)
        unit = spec.time_unit if "time_unit" in spec.model_fields_set else None
        self._unit_of_time = float(table.seconds(spec.time, unit)[0])
        rules = self._sources.values()
        used = [spec.time, *(name for rule in rules for name in (rule.column, *rule.multiply_by))]
        for name in used:
            table.column(name)
        self._places = {name: table.names.index(table.key(name)) for name in used}
        self._begin = np.nan
        # The latest number of every column that is used, and of every column of the recording.
        self._raw = dict.fromkeys(used, np.nan)
        self._values = dict.fromkeys(self._sources, np.nan) | spec.constants

    def row(self, line: str) -> tuple[float, list[float], list[float]] | None:
        """Read a line.

        Args:
            line: The line.

        Returns:
            Time [s], controls, and outputs in the order of the channels, NaN where there is no
            number yet or none of this row; None outside the window.

        Raises:
            RecordingError: A cell is missing or holds no number that can be used.
        """
        spec, cells = self._channels.spec, next(csv.reader([line]))
        if len(cells) != len(self._names):
            raise RecordingError(f"{len(cells)} cells, but line 1 has {len(self._names)}")
        new, held = {}, {}
        for name, old in self._raw.items():
            cell = cells[self._places[name]]
            try:
                new[name] = float(cell.strip() or "nan")
            except ValueError:
                new[name] = np.inf
            if abs(new[name]) > LARGEST_VALUE:
                text = shortened(repr(cell))
                raise RecordingError(f"column {name!r}: {text} is no measured number")
            held[name] = old if np.isnan(new[name]) else new[name]
        pairs = {name: np.array([self._raw[name], held[name]]) for name in held}
        measured = {}
        for name, rule in self._sources.items():
            before, value = _converted(self._source, pairs.__getitem__, rule)
            # An unwrapped value goes on from the one before it.
            jumps = rule.unwrap or rule.period is not None
            value += np.nan_to_num(self._values[name] - before) if jumps else 0.0
            self._values[name] = float(value)
            measured[name] = np.nan if np.isnan(new[rule.column]) else float(value)
        self._raw = held
        time = self._unit_of_time * new[spec.time]
        self._begin = time if np.isnan(self._begin) else self._begin
        since, window = time - self._begin, spec.window or (-np.inf, np.inf)
        if since < window[0] - WINDOW_TOLERANCE or since > window[1] + WINDOW_TOLERANCE:
            return None
        controls = [self._values[name] for name in self._channels.control_columns]
        return time, controls, [measured.get(name, np.nan) for name in self._channels.outputs]


# ---- which column is what


def _sources(table: Table, channels: Channels) -> dict[str, ColumnSpec]:
    """Rules of all columns of the recording, first the controls, then the measured columns."""
    stated = channels.spec.sources
    default = _columns_by_default_name(table, channels)
    controls = {
        name: stated.get(name) or ColumnSpec(column=default.get(name, name))
        for name in channels.control_columns
        if name not in channels.spec.constants
    }
    # The look-up of a missing column raises the error that explains it.
    for name, source in controls.items():
        if name not in stated and source.column not in table.names:
            value = "0.0" if name.startswith("ctrl:") else "1.0"
            constant = f'; where it is constant, state the value: "{name}" = {value}'
            raise _unfit(table, channels, f"column {name!r} is missing", constant)
        table.column(source.column)

    measured = {name: source for name, source in stated.items() if name not in controls}
    if not measured:
        _check_names(table, channels)
        measured = {
            name: ColumnSpec(column=default[name]) for name in channels.outputs if name in default
        }
    if any(name in measured for name in channels.outputs):
        return {**controls, **measured}

    used = {channels.spec.time, *(source.column for source in controls.values())}
    found = [*measured] or [name for name in table.names if name not in used]
    fault = unknown("column", listed(found), channels.outputs)
    if measured:
        raise RecordingError(f"{table.source}: no measured column; {fault}")
    raise _unfit(table, channels, f"no measured column; {fault}")


def _unfit(table: Table, channels: Channels, fault: str, otherwise: str = "") -> RecordingError:
    """The error of a log whose columns do not fit, with a table that may read it."""
    fault = f"{table.source}: {fault}; found: {listed(table.names)}"
    if not table.is_file:
        return RecordingError(
            f"{fault}; arrays are called `t`, `ctrl`, `qpos`, `qvel` and `sensordata`, or as one "
            "of their columns"
        )
    proposal = proposed_recording(table, channels).replace("\n", "\n  ")
    return RecordingError(
        f"{fault}. Other names are stated in {channels.source}{otherwise}. Proposed, to be "
        f"checked:\n  {proposal}"
    )


def _check_names(table: Table, channels: Channels) -> None:
    """Refuse a column whose name looks like mjfim's but does not exist in this model."""
    stated = (source.column for source in channels.spec.sources.values())
    known = (*channels.control_columns, *channels.measurable, *stated)
    for name in table.names:
        if name.startswith(("ctrl:", "qpos:", "qvel:", *LAW_PREFIXES)) and name not in known:
            require_law(table.source, name, channels)
            fault = unknown_coordinate("column", name, ["t", *known])
            raise RecordingError(f"{table.source}: {fault}")


def _columns_by_default_name(table: Table, channels: Channels) -> dict[str, str]:
    """Names of the table's columns, by the names that mjfim gives them."""
    found: dict[str, str] = {}
    for name in table.names:
        for pattern, kinds in OTHER_NAMES:
            if match := re.fullmatch(pattern, name):
                found |= {f"{kind}{match[1]}": name for kind in kinds}
                break

    for matrix, parts in _matrices(channels).items():
        labels = [name for name in table.names if name == matrix or name.startswith(f"{matrix}[")]
        if labels and len(labels) != len(parts):
            raise RecordingError(
                f"{table.source}: array {matrix!r} has {len(labels)} columns; the model needs "
                f"{len(parts)}: {listed(parts)}"
            )
        found |= dict(zip(parts, labels, strict=False))
    found |= {name: name for name in table.names}
    # A sensor of a joint measures what the position or velocity of the joint is.
    joints = sensors_of_joints(channels).items()
    return {sensor: found[column] for column, sensor in joints if column in found} | found


def _matrices(channels: Channels) -> dict[str, list[str]]:
    """Default names of the columns of the matrices qpos, qvel, sensordata and ctrl."""
    stated = channels.spec.columns
    state = [component.name for component in state_components(channels.model)]
    nq = channels.model.nq
    matrices: dict[str, list[str]] = {}
    if all(name.startswith(INPUT_PREFIXES) for name in stated):
        matrices |= {"qpos": state[:nq], "qvel": state[nq:]}
        matrices["sensordata"] = list(_all_sensor_columns(channels.model))
    if channels.laws is None and any(name not in stated for name in channels.control_columns):
        matrices["ctrl"] = list(channels.control_columns)
    return matrices


def _all_sensor_columns(model: Any) -> Iterator[str]:
    """Columns of MuJoCo's sensordata, also of sensors without a name, which are not used."""
    for i in range(model.nsensor):
        name = model.sensor(i).name
        unused = [f"sensor {i}[{k}]" for k in range(model.sensor_dim[i])]
        yield from sensor_columns(model, name) if name else unused


# ---- values


def _in_units_of_titles(
    table: Table, sources: Mapping[str, ColumnSpec], channels: Channels
) -> dict[str, ColumnSpec]:
    """The rules with the units of titles, where a rule states no unit and no scale but -1."""
    converted = dict(sources)
    for name, source in sources.items():
        unit, wanted = table.unit(source.column), units_of(channels)[name]
        if not unit or source.unit is not None or abs(source.scale) != 1.0:
            continue
        if wanted not in (ANY, "") and not Unit.parse(unit).measures(Unit.parse(wanted)):
            raise RecordingError(
                f"{table.source}: the title of column {source.column!r} says {unit}, but {name!r} "
                f"is in {wanted}; name another column, or state its unit or scale in "
                "[recording.columns]"
            )
        converted[name] = source.model_copy(
            update={"scale": source.scale * Unit.parse(unit).factor}
        )
    return converted


def _merged(table: Table, sources: Mapping[str, ColumnSpec], t: Array) -> tuple[Table, Array]:
    """The table with one row for rows of one time t: (M,) that do not contradict each other.

    Programs that write one row for each message leave the columns of other messages empty.
    """
    differs = np.diff(t) != 0.0
    if differs.all():
        return table, t
    starts = np.flatnonzero(np.append(True, differs))
    used = {name for s in sources.values() for name in (s.column, *s.multiply_by)}
    contents = dict(table.contents)
    for name in used:
        column = table.column(name)
        values = np.fmax.reduceat(column, starts)
        if not np.array_equal(values, np.fmin.reduceat(column, starts), equal_nan=True):
            return table, t
        contents[table.key(name)] = pyarrow.array(values)
    return replace(table, contents=contents), t[starts]


def _rows(
    table: Table, channels: Channels, sources: Mapping[str, ColumnSpec], t: Array
) -> slice | np.ndarray:
    """Rows that are used, of M with the times t: (M,) [s]; the others are counted in a warning."""
    rows = _window(table.source, t, channels.spec)
    if rows.stop - rows.start < MIN_ROWS:
        return rows
    begin = rows.start
    for name in channels.control_columns:
        if name not in sources:
            continue
        set_at = np.flatnonzero(np.isfinite(table.column(sources[name].column)))
        # A control that is sent more seldom than rows are written begins within its own period.
        if len(set_at) > 1 and set_at[0] > begin:
            period = np.median(np.diff(t[set_at]))
            is_near = t[set_at[0]] - t[rows.start] <= period
            is_seldom = period > MIN_PERIOD * np.median(np.diff(t))
            begin = int(set_at[0]) if is_near and is_seldom else begin
    stays = in_order(t[begin : rows.stop])
    left_out = {
        "before the first value of a control": begin - rows.start,
        "whose time repeats or is out of order": np.count_nonzero(~stays),
    }
    said = [f"{count} {why}" for why, count in left_out.items() if count]
    if said:
        warnings.warn(f"{table.source}: rows left out: {', '.join(said)}", RecordingWarning, 2)
    return slice(begin, rows.stop) if stays.all() else begin + np.flatnonzero(stays)


def _places(rows: slice | np.ndarray, count: int) -> Sequence[int]:
    """Places of some of `count` rows."""
    return range(count)[rows] if isinstance(rows, slice) else rows.tolist()


def _window(source: Path, t: Array, spec: RecordingSpec) -> slice:
    """Rows inside the window, of M with the times t: (M,) [s]."""
    if spec.window is None or not len(t):
        return slice(0, len(t))
    since = t - t[0]
    begin = _first_true(since >= spec.window[0] - WINDOW_TOLERANCE)
    # The window ends at the first time after its end. Only rows after its beginning are searched,
    # because the clock may have restarted before.
    end = begin + _first_true(since[begin:] > spec.window[1] + WINDOW_TOLERANCE)
    if end == begin:
        raise RecordingError(
            f"{source}: recording.window: no row between {spec.window[0]:g} and "
            f"{spec.window[1]:g} s; the log lasts {t[-1] - t[0]:g} s"
        )
    return slice(begin, end)


def _first_true(condition: np.ndarray) -> int:
    """Index of the first True of condition: (M,); M if there is none."""
    return int(np.argmax(np.append(condition, True)))


def _columns(
    table: Table,
    sources: Mapping[str, ColumnSpec],
    t: Array,
    rows: slice | np.ndarray,
    spec: RecordingSpec,
) -> dict[str, Array]:
    """Converted columns of the rows that are used, by the name of the recording's column."""
    columns, numbers = {}, _places(rows, len(t))
    for name, source in sources.items():
        # Truth values may switch a control or a factor on and off.
        if not name.startswith(INPUT_PREFIXES):
            table.measurement(source.column)
        for raw in (source.column, *source.multiply_by):
            check_finite(f"{table.source}: column {raw!r}", table.column(raw)[rows], numbers)
        values = _converted(table.source, table.column, source)
        if name.startswith(INPUT_PREFIXES):
            # Empty rows hold the last value before them.
            last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), 0))
            values, age = values[last], t - t[last]
            kind = "control" if name.startswith("ctrl:") else "input"
            where = f"{table.source}: column {source.column!r} (the {kind} {name!r})"
            check_held(where, t[rows][:-1], values[rows][:-1], age[rows][:-1], spec.gap)
        # Finite raw numbers may become infinite by the conversion.
        columns[name] = values[rows]
        check_finite(f"{table.source}: column {name!r}", columns[name], numbers)
    return columns


def _converted(source: Path, column: Callable[[str], Array], spec: ColumnSpec) -> Array:
    """(M,) one column of a recording by equation (1), from the columns of a log."""
    raw = column(spec.column)
    if spec.signed is not None:
        raw = _signed(source, spec.column, raw, spec.signed)
    if spec.period is not None:
        raw = _unwrapped(raw, spec.period)

    value = spec.scale * (1.0 if spec.unit is None else UNIT_FACTORS[spec.unit]) * raw + spec.offset
    if spec.unwrap:
        value = _unwrapped(value, TURN)
    for name in spec.multiply_by:
        value = value * column(name)
    return value


def _signed(source: Path, name: str, raw: Array, bits: int) -> Array:
    """(M,) signed integers of bits from their two's complement raw: (M,)."""
    half = 2.0 ** (bits - 1)
    outside = (raw < -half) | (raw >= 2.0 * half)
    invalid = np.isfinite(raw) & (outside | (raw != np.rint(raw)))
    if invalid.any():
        row = np.argmax(invalid)
        raise RecordingError(
            f"{source}: column {name!r} holds {raw[row]:g} in data row {row + 1}, which is "
            f"not an integer of {bits} bits"
        )
    return np.where(raw >= half, raw - 2.0 * half, raw)


def _unwrapped(raw: Array, period: float) -> Array:
    """(M,) numbers without jumps of more than half a period, also across empty rows."""
    present = np.isfinite(raw)
    unwrapped = np.array(raw)
    unwrapped[present] = np.unwrap(raw[present], period=period)
    return unwrapped
