"""Reader of LeRobot datasets of formats v2.x and v3.0.

A dataset is a folder with `meta/info.json` and the frames in Parquet files. Each episode is one
recording; its name is the folder of the dataset followed by `episode_` and six digits, although
there is no such file. Images and videos are not read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.files import check_unpacked_size, read_json
from mjfim.recordings.formats.table import NOT_NUMERIC, Table, one_line
from mjfim.recordings.spec import RecordingSpec

# File that makes a folder a dataset, and the column that says to which episode a frame belongs.
INFO_FILE = "meta/info.json"
EPISODE_COLUMN = "episode_index"

# Name of an episode of a dataset.
EPISODE_NAME = re.compile(r"episode_(\d{6,9})")

# Places of the data files by the first number of the version. The places that info.json states are
# not used: they are patterns, which could lead to other files.
DATA_FILES = {2: "data/chunk-*/episode_{episode:06d}.parquet", 3: "data/chunk-*/file-*.parquet"}

# Types of features that hold numbers.
NUMERIC = re.compile(r"(float|int|uint)(8|16|32|64)|bool")

# Largest number of names in a list of a feature; more are not components of a state.
MAX_COMPONENTS = 4096

# Largest number of episodes that are listed without a choice; more would take days to fit.
MAX_EPISODES = 10_000

# Deepest nesting of the lists of names.
MAX_DEPTH = 3

# Errors that pyarrow raises for a damaged file.
DAMAGED = (pyarrow.ArrowException, OSError, EOFError, ValueError)

# Rounding of a time stamp in single precision, relative to the time.
SINGLE_PRECISION = 2.0 * float(np.finfo(np.float32).eps)

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
    """Dataset and number of the episode that a path names; None if it names none.

    Args:
        path: A path such as `DATASET/episode_000003`.
    """
    named = EPISODE_NAME.fullmatch(path.name)
    if named is None or path.exists() or not is_lerobot_dataset(path.parent):
        return None
    return path.parent, int(named[1])


def lerobot_episodes(path: Path, spec: RecordingSpec) -> list[Path]:
    """Names of the episodes of a dataset that are to be read.

    Args:
        path: The folder of the dataset.
        spec: The `[recording]` table; its `episodes` chooses some.

    Returns:
        One path for each episode.

    Raises:
        RecordingError: The dataset cannot be read, or a chosen episode does not exist.
    """
    count = _count(path, _read_info(path), "total_episodes")
    for episode in spec.episodes:
        if episode >= count:
            raise RecordingError(
                f"{path}: recording.episodes: there is no episode {episode}; the dataset has the "
                f"episodes 0 to {count - 1}"
            )
    if not spec.episodes and count > MAX_EPISODES:
        raise RecordingError(
            f"{path}: has {count} episodes; choose some of them by recording.episodes"
        )
    return [path / f"episode_{episode:06d}" for episode in spec.episodes or range(count)]


def read_lerobot(path: Path, spec: RecordingSpec) -> Table:
    """Read one episode of a LeRobot dataset.

    The columns are `t` [s], and `<feature>:<name>` for each component of a feature with numbers,
    for example `observation.state:shoulder.pos` and `action:shoulder.pos`. Components without names
    are called `<feature>[i]`. The times are those of the frame numbers at the stated rate, as far
    as the time stamps, which are rounded to single precision, say the same.

    Args:
        path: An episode, such as `DATASET/episode_000003`, or a dataset with a single one.
        spec: The `[recording]` table.

    Returns:
        All columns.

    Raises:
        RecordingError: The dataset cannot be read, or it is not clear which episode is meant.
    """
    if spec.time_unit != "s":
        raise RecordingError(
            f"{path}: recording.time_unit: the time of a LeRobot dataset is in seconds; leave this "
            "key out"
        )

    named = lerobot_episode(path)
    folder, episode = named or (path, _only_episode(path, spec))
    info = _read_info(folder)
    features = _features(folder, info)
    wanted = [EPISODE_COLUMN, "timestamp", "frame_index", *features]
    rows = _episode_rows(folder, _version(folder, info), episode, wanted)
    if not rows.num_rows:
        raise RecordingError(f"{folder}: has no frame of episode {episode}")

    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    for feature, names in features.items():
        values = _matrix(rows, feature, len(names))
        if values is None:
            faults |= dict.fromkeys(names, f"{NOT_NUMERIC}, or not {len(names)} numbers per frame")
        else:
            columns |= dict(zip(names, values.T, strict=True))
    columns["t"] = _times(folder, info, rows)
    return Table(source=path, columns=columns, faults=faults, unit_hint=UNIT_HINT)


def _read_info(folder: Path) -> dict[str, Any]:
    """The contents of info.json."""
    try:
        return read_json(folder / INFO_FILE)
    except RecursionError:
        raise RecordingError(f"{folder}: {INFO_FILE}: nested too deeply") from None


def _only_episode(path: Path, spec: RecordingSpec) -> int:
    """Number of the only episode that is to be read."""
    episodes = lerobot_episodes(path, spec)
    if len(episodes) != 1:
        raise RecordingError(
            f"{path}: has {len(episodes)} episodes; name one, as in {episodes[0].name}, or choose "
            "one by recording.episodes"
        )
    return int(episodes[0].name.rpartition("_")[2])


def _version(folder: Path, info: Mapping[str, Any]) -> int:
    """First number of the version of a dataset."""
    stated = str(info.get("codebase_version"))
    found = re.fullmatch(r"v(\d)\.\d+", stated)
    version = int(found[1]) if found else 0
    if version not in DATA_FILES:
        raise RecordingError(
            f"{folder}: LeRobot format {stated!r}; the formats v2.0, v2.1 and v3.0 are read"
        )
    return version


def _count(folder: Path, info: Mapping[str, Any], key: str) -> int:
    """A number of info.json that counts something."""
    value = info.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise RecordingError(f"{folder}: {INFO_FILE}: {key} is {value!r}; expected at least 1")
    return value


def _features(folder: Path, info: Mapping[str, Any]) -> dict[str, list[str]]:
    """Names of the columns of each feature that holds numbers."""
    stated = info.get("features")
    if not isinstance(stated, Mapping):
        raise RecordingError(f"{folder}: {INFO_FILE}: has no table of features")

    found = {}
    for feature, described in stated.items():
        width = _width(described)
        if 0 < width <= MAX_COMPONENTS:
            found[feature] = _names(feature, described.get("names"), width)
    return found


def _width(described: Any) -> int:
    """Number of components of a feature; 0 if it holds no numbers, or more than a vector."""
    if not isinstance(described, Mapping) or not NUMERIC.fullmatch(str(described.get("dtype"))):
        return 0

    shape = described.get("shape")
    width = shape[0] if isinstance(shape, list) and len(shape) == 1 else 0
    return width if isinstance(width, int) else 0


def _names(feature: str, stated: Any, count: int) -> list[str]:
    """Names of the columns of a feature, from its names in any of the forms that are in use."""
    names = list(_flat(stated))
    are_usable = len(names) == len(set(names)) == count
    if are_usable:
        return [f"{feature}:{name}" for name in names]

    if count == 1:
        return [feature]
    return [f"{feature}[{i}]" for i in range(count)]


def _flat(stated: Any, depth: int = 0) -> Iterator[str]:
    """Names inside lists, and inside the lists of a table such as `{motors = [...]}`."""
    if depth > MAX_DEPTH:
        return
    if isinstance(stated, str):
        yield stated
    elif isinstance(stated, list):
        for part in stated:
            yield from _flat(part, depth + 1)
    elif isinstance(stated, Mapping):
        # A table of numbers gives the place of each name.
        is_places = all(isinstance(value, int) for value in stated.values())
        inner = sorted(stated, key=stated.__getitem__) if is_places else [*stated.values()]
        yield from _flat(inner, depth + 1)


def _episode_rows(folder: Path, version: int, episode: int, names: Sequence[str]) -> Any:
    """Rows of an episode as an arrow table; the other row groups of a file are not read."""
    files = sorted(folder.glob(DATA_FILES[version].format(episode=episode)))
    if not files:
        raise RecordingError(f"{folder}: has no data file of episode {episode}")

    parts = []
    for file in files:
        try:
            parts.append(_rows_of_file(file, episode, names))
        except DAMAGED as error:
            raise RecordingError(
                f"{file}: not a readable Parquet file (damaged or truncated?): {one_line(error)}"
            ) from None
    return pyarrow.concat_tables(parts, promote_options="default")


def _rows_of_file(file: Path, episode: int, names: Sequence[str]) -> Any:
    """Rows of an episode in one file."""
    schema = pyarrow.parquet.read_schema(file)
    if EPISODE_COLUMN not in schema.names:
        raise RecordingError(f"{file}: column {EPISODE_COLUMN!r} is missing")

    held = [name for name in dict.fromkeys(names) if name in schema.names]
    rows = pyarrow.parquet.read_metadata(file).num_rows
    check_unpacked_size(file, 8 * rows * len(held))
    return pyarrow.parquet.read_table(
        file, columns=held, filters=[(EPISODE_COLUMN, "==", episode)], partitioning=None
    )


def _matrix(rows: Any, feature: str, width: int) -> Array | None:
    """(M, width) numbers of a feature; None if a frame has other contents."""
    if feature not in rows.column_names:
        return None

    column = rows.column(feature).combine_chunks()
    is_list = any(
        is_kind(column.type)
        for is_kind in (
            pyarrow.types.is_list,
            pyarrow.types.is_large_list,
            pyarrow.types.is_fixed_size_list,
        )
    )
    try:
        numbers = (column.flatten() if is_list else column).cast(pyarrow.float64(), safe=False)
    except pyarrow.ArrowException:
        return None

    values = np.asarray(numbers.to_numpy(zero_copy_only=False), dtype=np.float64)
    if values.size != rows.num_rows * width or (is_list and column.null_count):
        return None
    return values.reshape(rows.num_rows, width)


def _times(folder: Path, info: Mapping[str, Any], rows: Any) -> Array:
    """(M,) times of the frames [s]."""
    stamps = _matrix(rows, "timestamp", 1)
    numbers = _matrix(rows, "frame_index", 1)
    fps = info.get("fps")
    if not isinstance(fps, (int, float)) or not 0.0 < fps < np.inf:
        raise RecordingError(f"{folder}: {INFO_FILE}: fps is {fps!r}; expected a positive number")
    if numbers is None and stamps is None:
        raise RecordingError(f"{folder}: the frames have neither 'timestamp' nor 'frame_index'")
    if numbers is None:
        return np.asarray(stamps).ravel()

    # Time stamps in single precision would make a jitter that the log does not have.
    exact = numbers[:, 0] / fps
    rounding = SINGLE_PRECISION * np.abs(exact).max()
    if stamps is None or (np.abs(stamps[:, 0] - exact) <= rounding).all():
        return np.asarray(exact)
    return np.asarray(stamps[:, 0])
