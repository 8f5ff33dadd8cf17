"""Reader of LeRobot datasets of formats v2.x and v3.0.

A dataset is a folder with `meta/info.json` and Parquet files, whose rows are the frames of all
episodes. One episode is one recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.files import read_json
from mjfim.recordings.formats.table import Table, one_line
from mjfim.recordings.spec import RecordingSpec

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
        try:
            schema = pyarrow.parquet.read_schema(file)
            parts.append(
                pyarrow.parquet.read_table(
                    file,
                    columns=[name for name in dict.fromkeys(names) if name in schema.names],
                    filters=[(EPISODE_COLUMN, "==", episode)],
                    partitioning=None,
                )
            )
        except DAMAGED as error:
            raise RecordingError(
                f"{file}: not a readable Parquet file (damaged or truncated?): {one_line(error)}"
            ) from None

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
