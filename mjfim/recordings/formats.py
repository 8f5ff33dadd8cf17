"""Reader of log files of all formats: their columns by name, which become numbers when needed.

The ending of the name says the format; folders are ROS 2 bags or LeRobot datasets. No content of a
file is executed.

A LeRobot dataset of format v2.x or v3.0 is a folder with `meta/info.json` and Parquet files, whose
rows are the frames of all episodes. One episode is one recording.

The libraries rosbags and mcap are an optional extra (`pip install 'mjfim[ros]'`); no installation
of ROS is needed. Messages of several topics or publishers are merged by their time stamps.
"""

from __future__ import annotations

import csv
import json
import math
import pickletools
import re
import zipfile
import zlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.compute
import pyarrow.parquet
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import RecordingError, listed, shortened, unknown
from mjfim.files import read_arrays, read_json
from mjfim.recordings.delimited import read_delimited
from mjfim.recordings.quantities import Unit, name_and_unit
from mjfim.recordings.section import INPUT_PREFIXES, RecordingSpec

# File that makes a folder a dataset, and the column that says to which episode a frame belongs.
INFO_FILE = "meta/info.json"
EPISODE_COLUMN = "episode_index"

# Name of an episode of a dataset.
EPISODE_NAME = re.compile(r"episode_(\d{6,9})")

# Places of the data files by the first number of the version. The places that info.json states are
# not used: they are patterns, which could lead to other files.
DATA_FILES = {2: "data/chunk-*/episode_{episode:06d}.parquet", 3: "data/chunk-*/file-*.parquet"}

# Kinds of features that hold no numbers, and may be large.
NO_NUMBERS = ("image", "video", "string")

# Errors that libraries raise for a damaged file.
UNREADABLE = (
    pyarrow.ArrowException,
    OSError,
    EOFError,
    ValueError,
    RecursionError,
    zlib.error,
)

# What a Parquet file should be, in words.
PARQUET = "a readable Parquet file (damaged or truncated?)"

# Rounding of a time stamp in single precision, relative to the time.
SINGLE_PRECISION = 2.0 * np.finfo(np.float32).eps

# How to state the units of a dataset, which its files do not name.
UNIT_HINT = (
    "LeRobot robots store degrees, or -100 to 100 over the calibrated range of each joint: "
    'state unit = "deg" for degrees, or for the range scale = (rad per unit) and '
    "offset = (rad at 0), for the positions and for the actions"
)


def is_lerobot_dataset(path: Path) -> bool:
    """Whether a path is the folder of a LeRobot dataset."""
    return (path / INFO_FILE).is_file()


def lerobot_episode(path: Path) -> tuple[Path, int] | None:
    """Dataset and number of the episode that a path such as `set/episode_000003` names, or None."""
    named = EPISODE_NAME.fullmatch(path.name)
    if named is None or path.exists() or not is_lerobot_dataset(path.parent):
        return None
    return path.parent, int(named[1])


def lerobot_episodes(path: Path, spec: RecordingSpec) -> list[Path]:
    """Names of the episodes of a dataset that are to be read.

    Raises:
        RecordingError: The dataset is damaged, or has no such episode.
    """
    count = read_json(path / INFO_FILE).get("total_episodes")
    if not isinstance(count, int) or count < 1:
        raise RecordingError(
            f"{path}: {INFO_FILE}: total_episodes is {count!r}; expected at least 1"
        )

    for episode in spec.episodes:
        if episode >= count:
            raise RecordingError(
                f"{path}: recording.episodes: there is no episode {episode}; the dataset has the "
                f"episodes 0 to {count - 1}"
            )
    return [path / f"episode_{episode:06d}" for episode in spec.episodes or range(count)]


def read_lerobot(path: Path, spec: RecordingSpec) -> Table:
    """Read one episode of a LeRobot dataset.

    Args:
        path: Name of an episode, or the folder of a dataset of which one episode is to be read.
        spec: Table `[recording]`.

    Raises:
        RecordingError: The dataset is damaged or of another version, or has no such episode.
    """
    if spec.time_unit != "s":
        raise RecordingError(
            f"{path}: recording.time_unit: the time of a LeRobot dataset is in seconds; leave this "
            "key out"
        )
    folder, episode = lerobot_episode(path) or _only_episode(path, spec)
    info = read_json(folder / INFO_FILE)
    features = info.get("features")
    if not isinstance(features, Mapping):
        raise RecordingError(f"{folder}: {INFO_FILE}: has no table of features")

    described = {name: each for name, each in features.items() if isinstance(each, Mapping)}
    held = [name for name, each in described.items() if each.get("dtype") not in NO_NUMBERS]
    rows = _frames(folder, info, episode, [EPISODE_COLUMN, "timestamp", "frame_index", *held])
    contents = {name: rows.column(name) for name in held if name in rows.column_names}
    contents["t"] = _times(folder, info, rows)
    labels = {name: _labels(name, described[name]) for name in held}
    return Table.of(path, contents, RecordingSpec(time="t"), labels=labels, unit_hint=UNIT_HINT)


def _only_episode(path: Path, spec: RecordingSpec) -> tuple[Path, int]:
    """The dataset, and the number of the only episode that is to be read."""
    episodes = lerobot_episodes(path, spec)
    if len(episodes) != 1:
        raise RecordingError(
            f"{path}: has {len(episodes)} episodes; name one, as in {episodes[0].name}, or choose "
            "one by recording.episodes"
        )
    return path, int(episodes[0].name.rpartition("_")[2])


def _labels(feature: str, described: Mapping[str, Any]) -> list[str]:
    """Names of the columns of a feature; one that has no names and one component keeps its own."""
    names = list(_flat(described.get("names")))
    if len(names) == len(set(names)) and [len(names)] == described.get("shape"):
        return [f"{feature}:{name}" for name in names]
    return [feature]


def _flat(stated: Any) -> Iterator[str]:
    """Names inside lists, and inside the lists of a table such as `{motors = [...]}`."""
    if isinstance(stated, str):
        yield stated
    elif isinstance(stated, Mapping) and all(isinstance(v, int) for v in stated.values()):
        # A table of numbers gives the place of each name.
        yield from sorted(stated, key=stated.__getitem__)
    elif isinstance(stated, (list, Mapping)):
        for part in stated.values() if isinstance(stated, Mapping) else stated:
            yield from _flat(part)


def _frames(folder: Path, info: Mapping[str, Any], episode: int, names: list[str]) -> Any:
    """Rows of an episode as an arrow table; the other row groups of a file are not read."""
    stated = str(info.get("codebase_version"))
    pattern = DATA_FILES.get(int(stated[1]) if re.fullmatch(r"v\d\.\d+", stated) else 0)
    if pattern is None:
        raise RecordingError(
            f"{folder}: LeRobot format {stated!r}; the formats v2.0, v2.1 and v3.0 are read"
        )
    files = sorted(folder.glob(pattern.format(episode=episode)))
    if not files:
        raise RecordingError(f"{folder}: has no data file of episode {episode}")

    parts = []
    for file in files:
        with _reading(file, PARQUET):
            schema = pyarrow.parquet.read_schema(file)
            parts.append(
                pyarrow.parquet.read_table(
                    file,
                    columns=[name for name in dict.fromkeys(names) if name in schema.names],
                    filters=[(EPISODE_COLUMN, "==", episode)],
                    partitioning=None,
                )
            )

    rows = pyarrow.concat_tables(parts, promote_options="default")
    if not rows.num_rows:
        raise RecordingError(f"{folder}: has no frame of episode {episode}")
    return rows


def _times(folder: Path, info: Mapping[str, Any], rows: Any) -> Array:
    """(M,) times of the frames [s]."""
    fps = info.get("fps")
    if not isinstance(fps, (int, float)) or not 0.0 < fps < np.inf:
        raise RecordingError(f"{folder}: {INFO_FILE}: fps is {fps!r}; expected a positive number")

    held = {"timestamp", "frame_index"} & set(rows.column_names)
    table = Table.of(folder, {name: rows.column(name) for name in held}, RecordingSpec())
    if "frame_index" not in held:
        return table.column("timestamp")
    exact = table.column("frame_index") / fps
    if "timestamp" not in held:
        return exact
    # Time stamps in single precision would make a jitter that the log does not have.
    stamps = table.column("timestamp")
    rounding = SINGLE_PRECISION * np.abs(exact).max()
    return exact if (np.abs(stamps - exact) <= rounding).all() else stamps


# Longest quotation of another library's error message [characters].
MAX_QUOTATION = 200

# Largest number of rows of a column of text in which one is looked for that is no number.
MAX_SEARCHED_ROWS = 100_000

# Seconds per unit of time, and the seconds after which a clock begins again.
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
DAY = 86400.0

# A time of day, also with a fraction of a second, which pyarrow does not know.
CLOCK = r"^\s*(?P<h>\d\d):(?P<m>\d\d):(?P<s>\d\d(?:\.\d+)?)\s*$"

# Fault of a column that holds text or objects.
NOT_NUMERIC = "is not numeric"

types = pyarrow.types
NUMERIC = (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean, types.is_null)
LISTS = (types.is_list, types.is_large_list, types.is_fixed_size_list)


@record
class Table:
    """Columns of one file, all with M rows.

    Attributes:
        source: The file, for messages.
        contents: What the file holds by the name of a column: an arrow array, or the words that
            say why it cannot be used.
        units: Units of the columns whose titles state one, such as `q [deg]`; their names are `q`.
        unit_hint: How to state units that the file does not name; it ends messages about them.
        is_file: Whether they come from a file; Python may give arrays in place of one.
    """

    source: Path
    contents: dict[str, Any]
    units: dict[str, str]
    unit_hint: str = ""
    is_file: bool = True

    @classmethod
    def of(
        cls,
        source: Path,
        contents: Mapping[str, Any],
        spec: RecordingSpec,
        *,
        labels: Mapping[str, Sequence[str]] | None = None,
        unit_hint: str = "",
    ) -> Table:
        """Make columns of vectors, of matrices, and of single values, which hold for all rows.

        Args:
            source: The file.
            contents: Arrow arrays, NumPy vectors, lists or single values by name. A list of lists
                is a matrix, whose columns are called `name[0]`, `name[1]` and so on.
            spec: Table `[recording]`, which names the time. All columns have as many rows.
            labels: Names of the columns of a matrix that has other ones.
            unit_hint: See the attribute.
        """
        inputs = {s.column for key, s in spec.sources.items() if key.startswith(INPUT_PREFIXES)}
        rows = _rows(contents, spec.time)
        columns = {}
        for key, values in contents.items():
            parts = _parts(values if _has_rows(values) else [values] * rows)
            names = (labels or {}).get(key, ())
            if len(names) != len(parts):
                names = [f"{key}{suffix}" for suffix in parts]

            for name, part in zip(names, parts.values(), strict=True):
                # A control is held from each row to the next one, so the last row may have none.
                is_input = name in inputs or key.startswith(("ctrl", *INPUT_PREFIXES))
                columns[name] = _of_length(part, rows, spec.time, is_input)

        # Columns that differ in their units alone keep their titles as names.
        titles = {title: name_and_unit(title) for title in columns}
        count = Counter(name for name, _ in titles.values())
        keys = {title: name if count[name] == 1 else title for title, (name, _) in titles.items()}
        return cls(
            source=source,
            contents={keys[title]: values for title, values in columns.items()},
            units={keys[title]: unit for title, (_, unit) in titles.items() if unit},
            unit_hint=unit_hint,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns of the file, also of those that hold no numbers."""
        return tuple(self.contents)

    def column(self, name: str) -> Array:
        """Return one column.

        Args:
            name: Its name, or its title with the unit.

        Returns:
            (M,) numbers, NaN where the file holds none.

        Raises:
            RecordingError: There is no such column, or it holds no numbers.
        """
        values = self._values(name)
        fault = values if isinstance(values, str) else _fault(values)
        if fault:
            raise RecordingError(f"{self.source}: column {name!r} {fault}")
        return np.asarray(values.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False))

    def measurement(self, name: str) -> Array:
        """Return one column that holds times or measured numbers.

        Raises:
            RecordingError: As `column`, or the column holds truth values.
        """
        values = self._values(name)
        if not isinstance(values, str) and types.is_boolean(_kind(values)):
            raise RecordingError(
                f"{self.source}: column {name!r} holds truth values (true and false), which are no "
                "measurement; name a column of numbers, or write 1 and 0 if these are the numbers"
            )
        return self.column(name)

    def seconds(self, name: str, unit: str | None) -> Array:
        """Return one column of time stamps.

        Args:
            name: Its name, or its title with the unit.
            unit: Unit of the stamps, as a key of `SECONDS`; None for that in the title, or seconds.

        Returns:
            (M,) times [s]. Integers, and times of a calendar or of a clock, count from the first
            row; the clock may pass midnight.

        Raises:
            RecordingError: As `measurement`.
        """
        values = self._values(name)
        factor = 1.0 if unit is None else SECONDS[unit]
        stated = self.unit(name)
        if unit is None and stated and Unit.parse(stated).measures(Unit.parse("s")):
            factor = Unit.parse(stated).factor
        if not isinstance(values, str) and types.is_string(values.type):
            values = _stamps(values)
        if isinstance(values, str) or not (
            types.is_integer(values.type) or types.is_temporal(values.type)
        ):
            return factor * self.measurement(name)

        is_clock = types.is_time(values.type)
        if not types.is_integer(values.type):
            zone = getattr(values.type, "tz", None)
            kind = pyarrow.time64("ns") if is_clock else pyarrow.timestamp("ns", zone)
            values, factor = values.cast(kind), SECONDS["ns"]
        # A float64 does not hold nanoseconds since 1970 exactly.
        integers = values.cast(pyarrow.int64(), safe=False)
        if len(integers):
            integers = pyarrow.compute.subtract(integers, integers[0])
        times = factor * integers.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False)
        return np.unwrap(times, period=DAY) if is_clock else times

    def unit(self, name: str) -> str:
        """Unit that the title of a column states; empty without one."""
        return self.units.get(self.key(name), "")

    def key(self, name: str) -> str:
        """Name of a column that is called by its name or by its title with the unit."""
        return name if name in self.contents else name_and_unit(name)[0]

    def _values(self, name: str) -> Any:
        """What the file holds of a column."""
        if self.key(name) not in self.contents:
            found = listed(self.names)
            raise RecordingError(f"{self.source}: column {name!r} is missing; found: {found}")
        return self.contents[self.key(name)]


def _stamps(values: Any) -> Any:
    """Texts as times of a calendar (ISO 8601) or of a clock; other texts stay."""
    texts = pyarrow.compute.replace_substring(values, ",", ".")
    parts = pyarrow.compute.extract_regex(texts, CLOCK)
    if parts.null_count < len(values):
        hours, minutes, seconds = (
            pyarrow.compute.struct_field(parts, [i]).cast(pyarrow.float64()).to_numpy()
            for i in range(3)
        )
        nanoseconds = np.rint(NANOSECONDS * (3600.0 * hours + 60.0 * minutes + seconds))
        return pyarrow.array(nanoseconds, pyarrow.int64(), from_pandas=True).cast(
            pyarrow.time64("ns")
        )
    for zone in (None, "UTC"):
        with suppress(pyarrow.ArrowInvalid):
            return texts.cast(pyarrow.timestamp("ns", zone))
    return values


def _has_rows(values: Any) -> bool:
    """Whether a value of a file has rows, and does not hold for all of them."""
    return not isinstance(values, (str, int, float, type(None)))


def _rows(contents: Mapping[str, Any], time: str) -> int:
    """Number of rows of a file: that of the time; without one, of the longest column."""
    lengths = {name: len(values) for name, values in contents.items() if _has_rows(values)}
    return lengths.get(time, max(lengths.values(), default=0))


def _parts(values: Any) -> dict[str, Any]:
    """Arrow arrays of a vector or of the columns of a matrix by the ends of their names."""
    if isinstance(values, (list, np.ndarray)):
        try:
            values = pyarrow.array(values)
        except (pyarrow.ArrowException, OverflowError):
            return {"": NOT_NUMERIC}

    first = values[0].as_py() if types.is_string(values.type) and len(values) else None
    if first is not None and first.lstrip().startswith("["):
        # Lists in the cells of a CSV table.
        with suppress(ValueError, pyarrow.ArrowException, RecursionError):
            cells = ",".join(cell or "null" for cell in values.to_pylist())
            values = pyarrow.array(json.loads(f"[{cells}]"))
    if not any(is_list(values.type) for is_list in LISTS):
        return {"": values}
    column = values.combine_chunks() if isinstance(values, pyarrow.ChunkedArray) else values
    width = len(column[0]) if len(column) and column[0].is_valid else 0
    numbers = column.flatten()
    lengths = pyarrow.compute.list_value_length(column).to_numpy(zero_copy_only=False)
    if (lengths == width).all():
        return {f"[{i}]": numbers[i::width] for i in range(width)}
    row = np.argmax(lengths != width) + 1
    fault = f"is ragged: row {row} does not have {width} numbers, as the first row has"
    return {f"[{i}]": fault for i in range(max(width, 1))}


def _of_length(values: Any, rows: int, time: str, is_input: bool) -> Any:
    """Values with as many rows as the time has; the last row of an input may be missing."""
    if isinstance(values, str) or len(values) == rows:
        return values
    if is_input and len(values) == rows - 1:
        return pyarrow.concat_arrays([values, pyarrow.nulls(1, values.type)])
    return (
        f"has {len(values)} rows, but {time!r} has {rows}; all columns need equal numbers of rows"
    )


def _kind(values: Any) -> Any:
    """Type of the values of an arrow array; a dictionary holds what its values are."""
    kind = getattr(values, "type", pyarrow.null())
    return kind.value_type if types.is_dictionary(kind) else kind


def _fault(values: Any) -> str:
    """Fault of an arrow array without numbers, with the first text that is none; else empty."""
    if any(is_number(_kind(values)) for is_number in NUMERIC):
        return ""
    texts = enumerate(values[:MAX_SEARCHED_ROWS].to_pylist(), start=1)
    row, text = next(((row, text) for row, text in texts if _is_text(text)), (0, ""))
    return f"{NOT_NUMERIC}: row {row} holds {shortened(repr(text))}" if row else NOT_NUMERIC


def _is_text(value: object) -> bool:
    """Whether a value is a text that does not look like a number."""
    try:
        return isinstance(value, str) and bool(value) and float(value) is None
    except ValueError:
        return True


@contextmanager
def _reading(
    path: Path, kind: str, errors: tuple[type[Exception], ...] = UNREADABLE
) -> Iterator[None]:
    """Say that a file is damaged where a library cannot read it.

    Args:
        path: The file.
        kind: What it should be, in words.
        errors: Errors that the library raises for a damaged file.
    """
    try:
        yield
    except RecordingError:
        raise
    except errors as error:
        raise RecordingError(f"{path}: not {kind}: {one_line(error)}") from None


def one_line(error: Exception) -> str:
    """Quote another library's error message in one short line."""
    # A damaged file may hold control sequences of a terminal, which must not be printed.
    printable = "".join(c if c.isprintable() or c.isspace() else "?" for c in str(error))
    line = " ".join(printable.split()) or type(error).__name__
    return line if len(line) <= MAX_QUOTATION else f"{line[:MAX_QUOTATION]}..."


def leaves(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested objects; every value that is not an object is yielded."""
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from leaves(inner, f"{prefix}{key}.")
        else:
            yield prefix + key, inner


# Type of the messages that are read; all other messages are ignored.
JOINT_STATE = "sensor_msgs/msg/JointState"

# Topic of the controls that were sent: joint states that have the names of the controls, and the
# controls as efforts. mjfim writes it, and a program that plays a design may publish it.
CONTROL_TOPIC = "/mjfim/control"

# Fields of a joint state that become columns.
QUANTITIES = ("position", "velocity", "effort")

# Nanoseconds per second.
NANOSECONDS = 1_000_000_000

# Time stamps [ns] and numbers of every column, by topic, quantity and joint.
Samples = dict[tuple[str, str, str], "tuple[array[int], array[float]]"]


def read_bag(path: Path, spec: RecordingSpec) -> Table:
    """Read the joint states of a ROS 2 bag.

    Args:
        path: Folder of the bag, or the file in it.
        spec: Table `[recording]`, which may choose topics.

    Returns:
        The time `t` since the first message [s], and `<quantity>:<joint>` for every quantity in
        `QUANTITIES`; with several topics `<topic>:<quantity>:<joint>`. Controls are `ctrl:<name>`.

    Raises:
        RecordingError: The bag is damaged, has no joint states, or has several topics of them and
            none is chosen.
    """
    _require_seconds(path, spec)
    rosbag2 = module_of_extra(path, "rosbags.rosbag2")
    typesys = module_of_extra(path, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    # The reader assumes an intact bag; a damaged one can cause any exception inside it.
    kind = "a readable ROS 2 bag (damaged or truncated?)"
    with _reading(path, kind, (Exception,)), rosbag2.Reader(path) as reader:
        connections = _connections(path, reader.connections, spec.topics)
        samples = _samples(path, reader, connections, store)

    if not samples:
        topics = listed([connection.topic for connection in connections])
        raise RecordingError(f"{path}: topic {topics} has no message")
    measured = {topic for topic in spec.topics if topic != CONTROL_TOPIC}
    return _merged(path, samples, with_topic=len(measured) > 1)


def _require_seconds(path: Path, spec: RecordingSpec) -> None:
    """Refuse a unit of the time, where the stamps of messages are the time."""
    if spec.time_unit != "s":
        raise RecordingError(
            f"{path}: recording.time_unit: the time of a bag is in seconds; leave this key out"
        )


def module_of_extra(path: Path, name: str) -> Any:
    """Import a module of a library of the extra `ros`.

    Args:
        path: The log, for the message.
        name: Name of the module.

    Raises:
        RecordingError: The library is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise RecordingError(
            f"{path}: this log needs the library {name.partition('.')[0]}; pip install 'mjfim[ros]'"
        ) from None


def _connections(path: Path, connections: Iterable[Any], topics: tuple[str, ...]) -> list[Any]:
    """Connections of the stated topics, or of the only topic with joint states."""
    connections = list(connections)
    states = [c for c in connections if c.msgtype == JOINT_STATE]
    available = sorted({c.topic for c in states})
    if not available:
        others = sorted({f"{c.topic} ({c.msgtype})" for c in connections})
        raise RecordingError(
            f"{path}: no topic of {JOINT_STATE}, the only type of message that is read; "
            f"found: {listed(others)}"
        )
    for topic in topics:
        if topic not in available:
            raise RecordingError(f"{path}: recording.topics: {unknown('topic', topic, available)}")
    measured = [topic for topic in available if topic != CONTROL_TOPIC]
    if len(measured) > 1 and not topics:
        raise RecordingError(
            f"{path}: several topics of joint states: {listed(measured)}; select one by "
            "recording.topics"
        )
    return [c for c in states if c.topic in (topics or available)]


def _samples(path: Path, reader: Any, connections: list[Any], store: Any) -> Samples:
    """Read all messages, and collect their numbers by column."""
    samples: Samples = defaultdict(lambda: (array("q"), array("d")))
    for number, (connection, received, raw) in enumerate(reader.messages(connections=connections)):
        message = store.deserialize_cdr(raw, JOINT_STATE)
        # A message without a stamp has the time at which it was received.
        stamp = message.header.stamp.sec * NANOSECONDS + message.header.stamp.nanosec or received
        for quantity in QUANTITIES:
            values = getattr(message, quantity).tolist()
            if values and len(values) != len(message.name):
                raise RecordingError(
                    f"{path}: topic {connection.topic!r}, message {number + 1}: a field does not "
                    f"have one value for each of the {len(message.name)} joints"
                )
            for joint, value in zip(message.name, values, strict=False):
                stamps, numbers = samples[connection.topic, quantity, joint]
                stamps.append(stamp)
                numbers.append(value)
    return samples


def _merged(path: Path, samples: Samples, with_topic: bool) -> Table:
    """Merge all columns into one table with one row per stamp."""
    all_stamps = [np.frombuffer(stamps, dtype=np.int64) for stamps, _ in samples.values()]
    stamps = np.unique(np.concatenate(all_stamps))
    # Subtract integers first: a float64 cannot hold nanoseconds since 1970 exactly.
    columns = {"t": (stamps - stamps[0]).astype(np.float64) / NANOSECONDS}
    for ((topic, quantity, joint), (_, numbers)), own in zip(
        samples.items(), all_stamps, strict=True
    ):
        _require_increasing(own, f"{path}: topic {topic!r}: {quantity} of {joint!r}")
        is_control = topic == CONTROL_TOPIC
        prefix = f"{topic}:" if with_topic or is_control else ""
        label = "ctrl" if is_control and quantity == "effort" else f"{prefix}{quantity}"
        column = np.full(len(stamps), np.nan)
        column[np.searchsorted(stamps, own)] = np.frombuffer(numbers, dtype=np.float64)
        columns[f"{label}:{joint}"] = column
    return Table.of(path, columns, RecordingSpec(time="t"))


def _require_increasing(stamps: np.ndarray, where: str) -> None:
    """Refuse messages whose time stamps [ns] do not increase."""
    steps = np.diff(stamps)
    if np.any(steps <= 0):
        row = np.argmax(steps <= 0)
        raise RecordingError(
            f"{where}, message {row + 2} is {steps[row] / NANOSECONDS:g} s after the previous one; "
            "time must increase"
        )


def _read_mcap(path: Path, spec: RecordingSpec) -> Table:
    """Read the JSON messages of an MCAP file; without any, its joint states of ROS 2.

    Columns are `<topic>.<field>`, with the name of a joint or the number of an entry for lists, and
    the time `t` at which messages were logged, since the first one [s].
    """
    reader = module_of_extra(path, "mcap.reader")
    with (
        _reading(path, "a readable MCAP file (damaged or truncated?)", (Exception,)),
        path.open("rb") as file,
    ):
        log = reader.make_reader(file)
        topics = [
            channel.topic
            for channel in log.get_summary().channels.values()
            if channel.message_encoding == "json"
        ]
        wanted = {*topics} & {*(spec.topics or topics)}
        messages = [
            (channel.topic, message.log_time, json.loads(message.data))
            for _, channel, message in log.iter_messages(wanted)
        ]
    if not topics:
        return read_bag(path, spec)
    _require_seconds(path, spec)
    if not messages:
        raise RecordingError(
            f"{path}: recording.topics: no message of {listed(spec.topics or topics)}; found: "
            f"{listed(topics)}"
        )
    begin = messages[0][1]
    rows = [
        {"t": (stamp - begin) / NANOSECONDS, **dict(_numbers(content, topic))}
        for topic, stamp, content in messages
    ]
    return Table.of(path, _columns_of_rows(rows), RecordingSpec(time="t"))


def _columns_of_rows(rows: Records) -> dict[str, list[Any]]:
    """Columns by name; None where a row does not have the name."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Names and values of all numbers inside a JSON message."""
    if isinstance(value, Mapping):
        labels = value.get("name")
        for key, inner in value.items():
            # A joint state has a list of names beside its lists of numbers.
            is_parallel = isinstance(labels, list) and isinstance(inner, list)
            entries = (
                dict(zip(map(str, labels or ()), inner, strict=False)) if is_parallel else inner
            )
            yield from _numbers(entries, f"{name}.{key}")
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            label = inner.get("name", number) if isinstance(inner, Mapping) else number
            yield from _numbers(inner, f"{name}.{label}")
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield name, float(value)


Reader = Callable[[Path, RecordingSpec], Table]
Records = Sequence[Mapping[str, Any]]


def _read_json(path: Path, spec: RecordingSpec) -> Table:
    """Read the records of a JSON file; without records, its lists of numbers are the columns.

    Values beside the list of records are constants, which hold for all rows.

    Raises:
        RecordingError: The file is damaged, or it holds no records, or several lists of them.
    """
    with _reading(path, "readable JSON (damaged or truncated?)"):
        text = path.read_text(encoding="utf-8")
        if path.suffix.lower() == ".jsonl":
            text = f"[{','.join(line for line in text.split(chr(10)) if line.strip())}]"
        content = json.loads(text)

    lists = dict(_lists_of_records(content))
    outside = dict(leaves(content)) if isinstance(content, Mapping) else {}
    if not lists and any(isinstance(value, list) for value in outside.values()):
        return Table.of(path, outside, spec)
    rows = [dict(leaves(record)) for record in _chosen(path, lists, spec.records)]
    constants = {n: value for n, value in outside.items() if not isinstance(value, list)}
    return Table.of(path, constants | _columns_of_rows(rows), spec)


def _lists_of_records(value: Any, place: str = "") -> Iterator[tuple[str, Records]]:
    """Dotted name and contents of every list of objects inside a value."""
    if isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value):
        yield place, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _lists_of_records(inner, f"{place}.{key}" if place else key)


def _chosen(path: Path, lists: Mapping[str, Records], stated: str | None) -> Records:
    """The list of records that the experiment file names, or the only one."""
    if stated is not None and stated not in lists:
        fault = unknown("list of records", stated, lists)
        raise RecordingError(f"{path}: recording.records: {fault}")
    if stated is not None:
        return lists[stated]
    if len(lists) > 1:
        raise RecordingError(
            f"{path}: several lists of records: {listed([*lists])}; select one by recording.records"
        )
    if not lists:
        raise RecordingError(
            f"{path}: holds no list of records (objects); a log is such a list, or an object that "
            "holds one"
        )
    return next(iter(lists.values()))


def read_columns(path: Path, spec: RecordingSpec) -> Table:
    """Read the columns of a log.

    Args:
        path: A file whose ending is in `READERS`, the folder of a ROS 2 bag, or the folder or the
            name of an episode of a LeRobot dataset.
        spec: Table `[recording]` of the experiment file.

    Raises:
        RecordingError: There is no such file, or it is damaged, empty, or of an unknown format.
    """
    if lerobot_episode(path) is not None or is_lerobot_dataset(path):
        return read_lerobot(path, spec)
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if _reader(file) is _read_csv]
        if files and not (path / "metadata.yaml").is_file():
            return _read_folder(path, files, spec)
        if not (path / "metadata.yaml").is_file():
            raise RecordingError(
                f"{path}: a folder without metadata.yaml is not a ROS 2 bag, and one without "
                "meta/info.json is not a LeRobot dataset; name a file"
            )
        return read_bag(path, spec)

    reader = _reader(path)
    if reader is None:
        raise RecordingError(
            f"{path}: unknown format; a log is a file that ends in {', '.join(READERS)}, or the "
            "folder of a ROS 2 bag or of a LeRobot dataset"
        )
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty")
    return reader(path, spec)


def read_table(path: Path) -> dict[str, Array]:
    """Read all columns of a numeric CSV file, packed by gzip if it ends in `.gz`.

    Raises:
        RecordingError: There is no such file, or it is of another format or damaged, or a column
            is not numeric.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    if not path.is_file():
        raise RecordingError(f"{path}: this is no file; save the table in a CSV file")
    if READERS.get(path.suffix.lower(), _read_csv) is not _read_csv:
        raise RecordingError(f"{path}: not a CSV table; a design keeps its control in design.csv")
    table = _read_csv(path, RecordingSpec())
    columns = {name: table.column(name) for name in table.names}
    return columns | {n: Unit.parse(unit).factor * columns[n] for n, unit in table.units.items()}


def _reader(path: Path) -> Reader | None:
    """Reader of a file by the ending of its name."""
    name = path.name.lower()
    return next((read for ending, read in READERS.items() if name.endswith(ending)), None)


def _numbers_of_files(
    files: Sequence[Path], spec: RecordingSpec
) -> Iterator[tuple[str, dict[str, Array]]]:
    """Stems of the tables that have two or more columns of numbers, and these columns."""
    for file in files:
        table = _read_csv(file, spec)
        numbers = {n: table.column(n) for n in table.names if not _fault(table.contents[n])}
        if len(numbers) > 1:
            yield file.name.partition(".")[0], numbers


def _read_folder(path: Path, files: Sequence[Path], spec: RecordingSpec) -> Table:
    """Read tables of one clock, such as one for commands and one for states, as one table.

    The column that all of them have is the time; the others are called `<file>:<column>`.
    """
    columns = dict(_numbers_of_files(files, spec))
    shared = [
        name
        for name in next(iter(columns.values()), {})
        if all(name in c for c in columns.values())
    ]
    time = spec.time if spec.time in shared else next(iter(shared), "")
    if not time:
        raise RecordingError(
            f"{path}: the tables in this folder have no column in common, which would be the time; "
            "name a file"
        )

    stamps = np.unique(np.concatenate([numbers[time] for numbers in columns.values()]))
    joined = {time: stamps}
    for stem, numbers in columns.items():
        rows = np.searchsorted(stamps, numbers.pop(time))
        for name, values in numbers.items():
            joined[f"{stem}:{name}"] = np.full(len(stamps), np.nan)
            joined[f"{stem}:{name}"][rows] = values
    return Table.of(path, joined, spec)


def _read_csv(path: Path, spec: RecordingSpec) -> Table:
    with _reading(path, "a readable CSV table", (*UNREADABLE, csv.Error)):
        return _table(path, read_delimited(path), spec)


def _read_parquet(path: Path, spec: RecordingSpec) -> Table:
    with _reading(path, PARQUET), pyarrow.parquet.ParquetFile(path) as file:
        return _table(path, file.read(), spec)


def _table(path: Path, rows: Any, spec: RecordingSpec) -> Table:
    """Columns of an arrow table; one name for several of them is refused."""
    name, count = Counter(rows.column_names).most_common(1)[0] if rows.num_columns else ("", 0)
    if count > 1:
        raise RecordingError(
            f"{path}: more than one column is named {name!r}; every column needs a name of its own"
        )
    return Table.of(path, dict(zip(rows.column_names, rows.columns, strict=True)), spec)


def _read_npz(path: Path, spec: RecordingSpec) -> Table:
    """Read the numbers, vectors and matrices of an archive; nothing is unpickled."""
    return table_of_arrays(path, read_arrays(path, "log"), spec)


def _read_npy(path: Path, spec: RecordingSpec) -> Table:
    """Read a matrix, whose columns are called `[0]`, `[1]` and so on, or an array with fields."""
    # A damaged header can cause any exception in the reader.
    with _reading(path, "a readable array of numbers (npy without pickles)", (Exception,)):
        values = np.load(path, allow_pickle=False)
        fields = values.dtype.names
        arrays = (
            {name: values[name] for name in fields} if fields else {"": np.atleast_2d(values.T).T}
        )
        return table_of_arrays(path, arrays, spec)


def _read_mat(path: Path, spec: RecordingSpec) -> Table:
    """Read the numbers, vectors, matrices and structures of a MATLAB file."""
    kind = "a readable MATLAB file (damaged? Save it by '-v7', because '-v7.3' is HDF5)"
    # The reader assumes an intact file; a damaged one can cause any exception inside it.
    with _reading(path, kind, (Exception,)):
        contents = scipy.io.loadmat(path, simplify_cells=True)
        own = {name: values for name, values in contents.items() if name[:2] != "__"}
        return table_of_arrays(path, own, spec)


def table_of_arrays(path: Path, arrays: Mapping[str, Any], spec: RecordingSpec) -> Table:
    """Columns of numbers, vectors, and matrices, which may lie on their side.

    Args:
        path: The file.
        arrays: Arrays, or tables of arrays, whose names are joined by dots.
        spec: Table `[recording]`, which names the time.
    """
    found = {name: np.asarray(values) for name, values in leaves(arrays)}
    count = found[spec.time].size if spec.time in found else None
    contents: dict[str, Any] = {}
    for name, values in found.items():
        if values.ndim == 2 and values.size and values.dtype != object:
            upright = values.T if values.shape[1] == count != values.shape[0] else values
            flat = pyarrow.array(upright.ravel())
            contents[name] = pyarrow.FixedSizeListArray.from_arrays(flat, upright.shape[1])
        elif values.ndim < 2:
            contents[name] = values if values.ndim else values.item()
    return Table.of(path, contents, spec)


class _TensorReader:
    """Reader of the table of tensors in a torch archive, whose instructions are read as data.

    Nothing is made but numbers, texts, containers and what stands for `TORCH_NAMES`.
    """

    def __init__(self, archive: zipfile.ZipFile) -> None:
        """Find the table; the archive must be stored without packing, as torch does."""
        if any(each.compress_type for each in archive.infolist()):
            raise ValueError("its files are packed")
        self._archive = archive
        tables = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        self._name = next(tables, "data.pkl")
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def read(self) -> Any:
        """Follow the instructions."""
        put = self._stack.append
        values = ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "NONE")
        instructions: dict[str, Callable[[Any], object]] = {
            **dict.fromkeys(values, put),
            "PROTO": lambda version: version,
            "NEWTRUE": lambda _: put(True),
            "NEWFALSE": lambda _: put(False),
            "GLOBAL": lambda name: put(_meaning(name)),
            "BINPUT": lambda place: self._memo.update({place: self._stack[-1]}),
            "BINGET": lambda place: put(self._memo[place]),
            "EMPTY_DICT": lambda _: put({}),
            "EMPTY_LIST": lambda _: put([]),
            "EMPTY_TUPLE": lambda _: put(()),
            "MARK": lambda _: self._marks.append(len(self._stack)),
            "TUPLE": lambda _: put(tuple(self._marked())),
            "TUPLE1": lambda _: put(tuple(self._last(1))),
            "TUPLE2": lambda _: put(tuple(self._last(2))),
            "TUPLE3": lambda _: put(tuple(self._last(3))),
            "SETITEM": lambda _: self._enter(self._last(2)),
            "SETITEMS": lambda _: self._enter(self._marked()),
            "APPEND": lambda _: self._stack[-1].extend(self._last(1)),
            "APPENDS": lambda _: self._stack[-1].extend(self._marked()),
            "BINPERSID": lambda _: put(self._storage(*self._last(1))),
            "REDUCE": lambda _: put(_made(*self._last(2))),
        }
        for operation, value, _ in pickletools.genops(self._archive.read(self._name)):
            if operation.name == "STOP":
                break
            instruction = instructions.get(operation.name.removeprefix("LONG_"))
            if instruction is None:
                raise ValueError(f"no table of tensors has the instruction {operation.name}")
            instruction(value)
        (table,) = self._stack
        return table

    def _last(self, count: int) -> list[Any]:
        """The last values, which leave the stack."""
        begin = len(self._stack) - count
        if begin < 0:
            raise ValueError("a value is missing")
        values = self._stack[begin:]
        del self._stack[begin:]
        return values

    def _marked(self) -> list[Any]:
        """The values that follow the last mark."""
        return self._last(len(self._stack) - self._marks.pop())

    def _enter(self, values: list[Any]) -> None:
        """Add keys and values to the table before them."""
        self._stack[-1].update(zip(values[::2], values[1::2], strict=True))

    def _storage(self, place: Any) -> Array:
        """The numbers of a storage."""
        folder = self._name.removesuffix(".pkl")
        return np.frombuffer(self._archive.read(f"{folder}/{place[2]}"), dtype=place[1])


def _meaning(name: str) -> Any:
    """Function or type that a name of a table of tensors stands for."""
    if name not in TORCH_NAMES:
        raise ValueError(f"it holds {name.replace(' ', '.')}, which is no table of tensors")
    return TORCH_NAMES[name]


def _made(kind: Callable[..., Any], values: tuple[Any, ...]) -> Any:
    """A tensor or a table."""
    return kind(*values)


def _tensor(storage: Array, offset: int, size: Any, stride: Any, *_: Any) -> Array:
    """A tensor that lies in a storage."""
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if min(offset, *size, *stride) < 0 or last >= len(storage) or math.prod(size) > len(storage):
        raise ValueError("a tensor is larger than its storage")
    steps = [step * storage.itemsize for step in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps, writeable=False)


# What stands for the names in a table of tensors; a storage stands for the type of its numbers.
TORCH_NAMES: dict[str, Any] = {
    "torch._utils _rebuild_tensor_v2": _tensor,
    "collections OrderedDict": dict,
    "torch DoubleStorage": "<f8",
    "torch FloatStorage": "<f4",
    "torch HalfStorage": "<f2",
    "torch LongStorage": "<i8",
    "torch IntStorage": "<i4",
    "torch ShortStorage": "<i2",
    "torch ByteStorage": "u1",
    "torch BoolStorage": "?",
}


def _read_torch(path: Path, spec: RecordingSpec) -> Table:
    """Read a table of tensors, as `torch.save` writes it; nothing of the file is executed."""
    kind = "a table of tensors as torch.save writes it (a zip archive)"
    with _reading(path, kind, (Exception,)), zipfile.ZipFile(path) as archive:
        tensors = _TensorReader(archive).read()
        arrays = tensors if isinstance(tensors, Mapping) else {"": tensors}
        return table_of_arrays(path, arrays, spec)


# Further endings of tables that are written as text.
TEXT = ("tsv", "txt", "dat")

# Reader of a log file by the ending of its name in lower case.
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".npz": _read_npz,
    ".json": _read_json,
    ".jsonl": _read_json,
    ".npy": _read_npy,
    ".mat": _read_mat,
    ".pt": _read_torch,
    ".mcap": _read_mcap,
    ".db3": read_bag,
    **dict.fromkeys((f".{kind}{packed}" for kind in TEXT for packed in ("", ".gz")), _read_csv),
}
