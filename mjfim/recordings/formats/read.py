"""Reader of log files of all formats.

CSV and Parquet files are read here; each of the other formats has a module.
"""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.recordings.formats.json_records import read_json
from mjfim.recordings.formats.npz import read_npz
from mjfim.recordings.formats.ros2_bag import read_bag
from mjfim.recordings.formats.table import (
    NOT_NUMERIC,
    Table,
    check_column_size,
    check_unpacked_size,
    columns_to_read,
    one_line,
)
from mjfim.recordings.spec import RecordingSpec

# Errors that pyarrow and gzip raise for a damaged file.
DAMAGED = (pyarrow.ArrowException, OSError, EOFError, UnicodeDecodeError, zlib.error)

# Number of bytes that are unpacked at once if the reader requests no number.
CHUNK = 1 << 20


def read_columns(path: Path, spec: RecordingSpec) -> Table:
    """Read the columns of a log.

    Args:
        path: A file whose ending determines its format, or the folder of a ROS 2 bag.
        spec: The `[recording]` table; it determines which columns are needed.

    Returns:
        The columns that are needed, and the names of the others.

    Raises:
        RecordingError: The file is missing, of an unknown format, or damaged.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such file")

    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise RecordingError(
                f"{path}: a folder without metadata.yaml is not a ROS 2 bag; name a file"
            )
        return read_bag(path, spec)

    name = path.name.lower()
    reader = next((read for ending, read in READERS.items() if name.endswith(ending)), None)
    if reader is None:
        raise RecordingError(
            f"{path}: unknown format; a log is a file that ends in {', '.join(READERS)}, or the "
            "folder of a ROS 2 bag"
        )
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty")

    return reader(path, spec)


def read_table(path: Path) -> dict[str, Array]:
    """Read all columns of a numeric CSV file, packed by gzip if it ends in `.gz`.

    Args:
        path: The file.

    Returns:
        (M,) numbers by column name, NaN where a field is empty.

    Raises:
        RecordingError: The file is missing or damaged, or a column is not numeric.
    """
    table = _read_csv(path, RecordingSpec())

    # The look-up of a faulty column raises the error that explains its fault.
    for name in table.faults:
        table.column(name)

    return table.columns


def _read_csv(path: Path, spec: RecordingSpec) -> Table:
    """Read the needed columns of a CSV file."""
    try:
        with _opened(path) as source, pyarrow.csv.open_csv(source) as head:
            names = list(head.schema.names)

        duplicate = next((name for name in names if names.count(name) > 1), None)
        if duplicate is not None:
            raise RecordingError(f"{path}: more than one column is named {duplicate!r}")

        needed = columns_to_read(names, spec)
        table = _parse_csv(path, needed)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except DAMAGED as error:
        raise RecordingError(f"{path}: not a readable CSV table: {one_line(error)}") from None

    return _from_arrow(path, table, tuple(name for name in names if name not in needed))


def _parse_csv(path: Path, names: list[str]) -> Any:
    """Parse columns as an arrow table of numbers.

    If a column holds text, the type of every column is inferred from its content.
    """
    try:
        return _parse_csv_as(path, names, {name: pyarrow.float64() for name in names})
    except pyarrow.ArrowInvalid as error:
        if "conversion error" not in str(error):
            raise

    # This is slower, but it shows which columns hold text.
    return _parse_csv_as(path, names, {})


def _parse_csv_as(path: Path, names: list[str], types: dict[str, Any]) -> Any:
    """Parse columns; the type of a column without a stated type is inferred from its content."""
    options = pyarrow.csv.ConvertOptions(include_columns=names, column_types=types)
    with _opened(path) as source:
        return pyarrow.csv.read_csv(source, convert_options=options)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a source for pyarrow: the file, or its unpacked content if it ends in `.gz`."""
    if path.suffix.lower() != ".gz":
        yield str(path)
        return

    with path.open("rb") as packed, gzip.GzipFile(fileobj=packed) as stream:
        yield _SizeCheckedStream(path, packed, stream)


class _SizeCheckedStream(io.RawIOBase):
    """Stream of the content of a gzip file, which refuses to unpack a decompression bomb."""

    def __init__(self, path: Path, packed: io.BufferedReader, stream: gzip.GzipFile) -> None:
        self._path = path
        self._packed = packed
        self._stream = stream
        self._unpacked_size = 0

    def readable(self) -> bool:
        """Return True, because this stream can be read."""
        return True

    def read(self, size: int = -1) -> bytes:
        """Read the next bytes of the content; fewer than `size` at its end."""
        data = self._stream.read(size if size >= 0 else CHUNK)

        self._unpacked_size += len(data)
        check_unpacked_size(self._path, self._packed.tell(), self._unpacked_size)
        return data


def _read_parquet(path: Path, spec: RecordingSpec) -> Table:
    """Read the needed columns of a Parquet file."""
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            names = list(file.schema_arrow.names)
            needed = columns_to_read(names, spec)
            check_column_size(path, file.metadata.num_rows, len(needed))
            table = file.read(columns=needed)
    except DAMAGED as error:
        raise RecordingError(
            f"{path}: not a readable Parquet file (damaged or truncated?): {one_line(error)}"
        ) from None

    return _from_arrow(path, table, tuple(name for name in names if name not in needed))


def _from_arrow(path: Path, table: Any, unread: tuple[str, ...]) -> Table:
    """Convert the columns of an arrow table to float64."""
    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}

    # Each column is dropped after its conversion, so that memory never holds two copies of the
    # whole table.
    while table.num_columns:
        name = table.column_names[0]
        column = table.column(0)
        table = table.remove_column(0)

        numbers = _as_numbers(column)
        if numbers is None:
            faults[name] = NOT_NUMERIC
        else:
            columns[name] = numbers

    return Table(source=path, columns=columns, faults=faults, unread=unread)


def _as_numbers(column: Any) -> Array | None:
    """(M,) numbers of an arrow column; None for text, even if every field looks like a number."""
    kind = column.type
    if pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind):
        return None

    try:
        numbers = column.cast(pyarrow.float64(), safe=False)
    except (pyarrow.ArrowInvalid, pyarrow.ArrowNotImplementedError):
        return None
    return np.asarray(numbers.to_numpy(zero_copy_only=False))


Reader = Callable[[Path, RecordingSpec], Table]

# Reader of a log file by the ending of its name in lower case.
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".npz": read_npz,
    ".json": read_json,
    ".mcap": read_bag,
    ".db3": read_bag,
}
