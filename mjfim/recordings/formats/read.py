"""Reader of log files of all formats.

The ending of the name says the format; folders are ROS 2 bags or LeRobot datasets.
"""

from __future__ import annotations

import gzip
import json
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown
from mjfim.files import read_arrays
from mjfim.recordings.formats.lerobot import is_lerobot_dataset, lerobot_episode, read_lerobot
from mjfim.recordings.formats.ros2_bag import read_bag
from mjfim.recordings.formats.table import Table, leaves, one_line
from mjfim.recordings.spec import RecordingSpec

Records = Sequence[Mapping[str, Any]]


def read_json(path: Path, spec: RecordingSpec) -> Table:
    """Read the records of a JSON file; without records, its lists of numbers are the columns.

    Values beside the list of records are constants, which hold for all rows.

    Raises:
        RecordingError: The file is damaged, or it holds no records, or several lists of them.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise RecordingError(
            f"{path}: not readable JSON (damaged or truncated?): {one_line(error)}"
        ) from None

    lists = dict(_lists_of_records(content))
    outside = dict(leaves(content)) if isinstance(content, Mapping) else {}
    if not lists and any(isinstance(value, list) for value in outside.values()):
        return Table.of(path, outside, spec)
    records = _chosen(path, lists, spec.records)
    rows = [dict(leaves(record)) for record in records]
    names = dict.fromkeys(name for row in rows for name in row)
    constants = {n: value for n, value in outside.items() if not isinstance(value, list)}
    return Table.of(path, constants | {n: [row.get(n) for row in rows] for n in names}, spec)


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


# Errors that pyarrow and gzip raise for a damaged file.
DAMAGED = (pyarrow.ArrowException, OSError, EOFError, UnicodeDecodeError, zlib.error)


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
        if not (path / "metadata.yaml").is_file():
            raise RecordingError(
                f"{path}: a folder without metadata.yaml is not a ROS 2 bag, and one without "
                "meta/info.json is not a LeRobot dataset; name a file"
            )
        return read_bag(path, spec)

    name = path.name.lower()
    reader = next((read for ending, read in READERS.items() if name.endswith(ending)), None)
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
        RecordingError: There is no such file, or it is damaged, or a column is not numeric.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    table = _read_csv(path, RecordingSpec())
    return {name: table.column(name) for name in table.names}


def _read_csv(path: Path, spec: RecordingSpec) -> Table:
    """Read a CSV file."""
    try:
        packed = path.suffix.lower() == ".gz"
        # A thread of pyarrow that reads from Python can abort the process at its end.
        source = pyarrow.BufferReader(gzip.decompress(path.read_bytes())) if packed else str(path)
        return _table(path, pyarrow.csv.read_csv(source), spec)
    except DAMAGED as error:
        raise RecordingError(f"{path}: not a readable CSV table: {one_line(error)}") from None


def _read_parquet(path: Path, spec: RecordingSpec) -> Table:
    """Read a Parquet file."""
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            return _table(path, file.read(), spec)
    except DAMAGED as error:
        raise RecordingError(
            f"{path}: not a readable Parquet file (damaged or truncated?): {one_line(error)}"
        ) from None


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
    contents: dict[str, Any] = {}
    for name, array in read_arrays(path, "log").items():
        if array.ndim == 2 and array.size:
            flat = pyarrow.array(array.ravel())
            contents[name] = pyarrow.FixedSizeListArray.from_arrays(flat, array.shape[1])
        elif array.ndim < 2:
            contents[name] = array if array.ndim else array.item()
    return Table.of(path, contents, spec)


Reader = Callable[[Path, RecordingSpec], Table]

# Reader of a log file by the ending of its name in lower case.
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".npz": _read_npz,
    ".json": read_json,
    ".mcap": read_bag,
    ".db3": read_bag,
}
