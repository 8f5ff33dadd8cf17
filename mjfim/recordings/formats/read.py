"""Reader of log files of all formats.

CSV and Parquet files are read here; each of the other formats has a module.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError, shortened
from mjfim.files import check_unpacked_size
from mjfim.recordings.formats.json_records import read_json
from mjfim.recordings.formats.lerobot import (
    is_lerobot_dataset,
    lerobot_episode,
    read_lerobot,
)
from mjfim.recordings.formats.npz import read_npz
from mjfim.recordings.formats.ros2_bag import read_bag
from mjfim.recordings.formats.table import (
    NOT_NUMERIC,
    Table,
    check_names,
    columns_to_read,
    one_line,
)
from mjfim.recordings.spec import RecordingSpec

# Errors that pyarrow and gzip raise for a damaged file.
DAMAGED = (pyarrow.ArrowException, OSError, EOFError, UnicodeDecodeError, zlib.error)

# Explanation of pyarrow's error for a line that is longer than the blocks in which it reads.
LONG_LINE = "it has a line of about 1 MB or more; each row of the log needs a line of its own"

# Largest number of rows of a column of text in which one is looked for that is no number.
MAX_SEARCHED_ROWS = 100_000

# Number of bytes that are unpacked at once.
CHUNK = 1 << 20


def read_columns(path: Path, spec: RecordingSpec) -> Table:
    """Read the columns of a log.

    Args:
        path: A file whose ending determines its format, the folder of a ROS 2 bag, or an episode
            of a LeRobot dataset.
        spec: The `[recording]` table; it determines which columns are needed.

    Returns:
        The columns that are needed, and the names of the others.

    Raises:
        RecordingError: The file is missing, of an unknown format, or damaged.
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
        if _is_packed(path):
            _check_packed(path)

        with pyarrow.csv.open_csv(_source(path)) as head:
            names = list(head.schema.names)
        check_names(path, names)

        needed = columns_to_read(names, spec)
        unread = tuple(name for name in names if name not in needed)

        # Only the conversion holds the table, so that it can drop the columns one by one.
        return _from_arrow(path, _parse_csv(path, needed), unread)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except DAMAGED as error:
        fault = LONG_LINE if "straddling object" in str(error) else one_line(error)
        raise RecordingError(f"{path}: not a readable CSV table: {fault}") from None


def _parse_csv(path: Path, names: list[str]) -> Any:
    """Parse columns as an arrow table of numbers.

    If a column holds text, the type of every column is inferred from its content.
    """
    try:
        return _parse_numbers(path, names)
    except pyarrow.ArrowInvalid as error:
        if "conversion error" not in str(error):
            raise

    # This is slower, but it shows which columns hold text.
    options = pyarrow.csv.ConvertOptions(include_columns=names)
    return pyarrow.csv.read_csv(_source(path), convert_options=options)


def _parse_numbers(path: Path, names: list[str]) -> Any:
    """Parse columns of numbers block by block; the text of the file is never held in memory."""
    types = {name: pyarrow.float64() for name in names}
    options = pyarrow.csv.ConvertOptions(include_columns=names, column_types=types)
    with pyarrow.csv.open_csv(_source(path), convert_options=options) as blocks:
        return blocks.read_all()


def _is_packed(path: Path) -> bool:
    """Whether the name of a file says that it is packed by gzip."""
    return path.suffix.lower() == ".gz"


def _source(path: Path) -> Any:
    """Return what pyarrow reads: the file, or its content unpacked by pyarrow itself.

    After a faulty row, a thread of pyarrow may still read while the process ends. Therefore the
    source must not call Python, which would abort the process or let it hang.
    """
    if not _is_packed(path):
        return str(path)
    return pyarrow.input_stream(str(path), compression="gzip")


def _check_packed(path: Path) -> None:
    """Unpack a gzip file once without keeping it; refuse damage and a decompression bomb.

    pyarrow unpacks without limit, so the whole file is checked before pyarrow reads it.
    """
    unpacked = 0

    with path.open("rb") as packed, gzip.GzipFile(fileobj=packed) as stream:
        while chunk := stream.read(CHUNK):
            unpacked += len(chunk)
            check_unpacked_size(path, unpacked)


def _read_parquet(path: Path, spec: RecordingSpec) -> Table:
    """Read the needed columns of a Parquet file."""
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            names = list(file.schema_arrow.names)
            check_names(path, names)

            needed = columns_to_read(names, spec)
            check_unpacked_size(path, 8 * file.metadata.num_rows * len(needed))
            unread = tuple(name for name in names if name not in needed)
            return _from_arrow(path, file.read(columns=needed), unread)
    except DAMAGED as error:
        raise RecordingError(
            f"{path}: not a readable Parquet file (damaged or truncated?): {one_line(error)}"
        ) from None


def _from_arrow(path: Path, table: Any, unread: tuple[str, ...]) -> Table:
    """Convert the columns of an arrow table to float64."""
    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    truth_values: set[str] = set()

    # Each column is dropped after its conversion, so that memory never holds two copies of the
    # whole table.
    while table.num_columns:
        name = table.column_names[0]
        column = table.column(0)
        table = table.remove_column(0)

        # A dictionary holds what its values are.
        kind = column.type.value_type if pyarrow.types.is_dictionary(column.type) else column.type
        if pyarrow.types.is_boolean(kind):
            truth_values.add(name)

        fault = _fault_of_type(kind)
        if fault is None:
            numbers = column.cast(pyarrow.float64(), safe=False)
            columns[name] = np.array(numbers.to_numpy(zero_copy_only=False))
            del numbers
        else:
            faults[name] = fault + _first_text(column)

        # Arrow keeps freed memory for later tables, unless it is asked to give it back.
        del column
        pyarrow.default_memory_pool().release_unused()

    return Table(
        source=path,
        columns=columns,
        faults=faults,
        unread=unread,
        truth_values=frozenset(truth_values),
    )


def _first_text(column: Any) -> str:
    """Name the first text of an arrow column that is no number, to end the sentence of its fault.

    It is empty for a column of another type, and where the first rows hold no such text.
    """
    types = pyarrow.types
    if not (types.is_string(column.type) or types.is_large_string(column.type)):
        return ""

    for row, value in enumerate(column[:MAX_SEARCHED_ROWS].to_pylist(), start=1):
        if value and not _is_number(value):
            return f": row {row} holds {shortened(repr(value))}"
    return ""


def _is_number(text: str) -> bool:
    """Whether a text looks like a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _fault_of_type(kind: Any) -> str | None:
    """Reason why a column of this arrow type holds no numbers; None if it holds numbers.

    Text is refused even if every field looks like a number.
    """
    # A column without any value has the type null.
    types = pyarrow.types
    numeric = (
        types.is_integer,
        types.is_floating,
        types.is_decimal,
        types.is_boolean,
        types.is_null,
    )
    return None if any(is_kind(kind) for is_kind in numeric) else NOT_NUMERIC


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
