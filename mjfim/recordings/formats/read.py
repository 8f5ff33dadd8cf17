"""Log files of every format as columns of numbers; CSV and Parquet here, the others in modules of their own."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.csv
import pyarrow.parquet

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.recordings.formats import table as limits
from mjfim.recordings.formats.json_records import read_nested
from mjfim.recordings.formats.npz import read_arrays
from mjfim.recordings.formats.ros2_bag import read_bag
from mjfim.recordings.formats.table import Table, chosen, refuse_bomb, said
from mjfim.recordings.spec import RecordingSpec

BROKEN = (pyarrow.ArrowException, OSError, EOFError, UnicodeDecodeError, zlib.error)
TEXT = "is not numeric"


def read_columns(path: Path, spec: RecordingSpec) -> Table:
    """Columns of a log, in whatever format its ending says. Raises RecordingError naming the file and the fault."""
    if not path.exists():
        raise RecordingError(f"{path}: no such file")
    if path.is_dir():
        if not (path / "metadata.yaml").is_file():
            raise RecordingError(
                f"{path}: a folder without metadata.yaml is no ROS 2 bag; name a file"
            )
        return read_bag(path, spec)
    reader = next(
        (read for ending, read in READERS.items() if path.name.lower().endswith(ending)), None
    )
    if reader is None:
        raise RecordingError(
            f"{path}: not a known kind of log; valid endings: {', '.join(READERS)}; or a bag's folder"
        )
    if path.stat().st_size == 0:
        raise RecordingError(f"{path}: the file is empty")
    return reader(path, spec)


def read_table(path: Path) -> dict[str, Array]:
    """Columns of a numeric CSV file (gzip by its ending). Raises RecordingError naming file, column and row."""
    table = _read_csv(path, RecordingSpec())
    for name in table.faults:
        table.column(name)
    return table.columns


def _read_csv(path: Path, spec: RecordingSpec) -> Table:
    try:
        with _unpacked(path) as source, pyarrow.csv.open_csv(source) as head:
            names = list(head.schema.names)
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise RecordingError(f"{path}: column {twice!r} stands there more than once")
        wanted = chosen(names, spec)
        try:
            table = _rows(path, wanted, {name: pyarrow.float64() for name in wanted})
        except pyarrow.ArrowInvalid as error:
            if "conversion error" not in str(error):
                raise
            table = _rows(path, wanted, {})  # slower, but says which columns hold text
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except BROKEN as error:
        raise RecordingError(f"{path}: not a readable CSV table: {said(error)}") from None
    return _table(path, table, tuple(name for name in names if name not in wanted))


def _rows(path: Path, wanted: list[str], types: dict[str, Any]) -> Any:
    """The wanted columns; those without a stated type have that of their content."""
    options = pyarrow.csv.ConvertOptions(include_columns=wanted, column_types=types)
    with _unpacked(path) as source:
        return pyarrow.csv.read_csv(source, convert_options=options)


@contextmanager
def _unpacked(path: Path) -> Iterator[Any]:
    """The file, or its content as it unpacks."""
    if path.suffix.lower() != ".gz":
        yield str(path)
        return
    with path.open("rb") as packed, gzip.GzipFile(fileobj=packed) as stream:
        yield _Counted(path, packed, stream)


class _Counted(io.RawIOBase):
    """Unpacks no more than is sensible."""

    def __init__(self, path: Path, packed: io.BufferedReader, stream: gzip.GzipFile) -> None:
        self._path, self._packed, self._stream = path, packed, stream
        self._count = 0

    def readable(self) -> bool:
        return True

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(size if size >= 0 else 1 << 20)
        self._count += len(data)
        refuse_bomb(self._path, self._packed.tell(), self._count)
        return data


def _read_parquet(path: Path, spec: RecordingSpec) -> Table:
    try:
        with pyarrow.parquet.ParquetFile(path) as file:
            names = list(file.schema_arrow.names)
            wanted = chosen(names, spec)
            if file.metadata.num_rows * len(wanted) * 8 > limits.LARGEST:
                raise RecordingError(
                    f"{path}: {file.metadata.num_rows} rows of {len(wanted)} columns are more than "
                    f"{limits.LARGEST / 2**30:.3g} GiB, the most that is read; name fewer in [recording.columns]"
                )
            table = file.read(columns=wanted)
    except BROKEN as error:
        raise RecordingError(
            f"{path}: not a readable Parquet file (damaged or truncated?): {said(error)}"
        ) from None
    return _table(path, table, tuple(name for name in names if name not in wanted))


def _table(path: Path, table: Any, unread: tuple[str, ...]) -> Table:
    """Arrow's columns as float64, one after the other so that no two copies of all are held."""
    columns, faults = dict[str, Array](), dict[str, str]()
    while table.num_columns:
        name, column = table.column_names[0], table.column(0)
        table = table.remove_column(0)
        try:
            whole = (
                column.cast(pyarrow.float64(), safe=False) if not _is_text(column.type) else None
            )
        except (pyarrow.ArrowInvalid, pyarrow.ArrowNotImplementedError):
            whole = None
        if whole is None:
            faults[name] = TEXT
        else:
            columns[name] = whole.to_numpy(zero_copy_only=False)
    return Table(path, columns, faults, unread)


def _is_text(kind: Any) -> bool:
    """Text is no number, even where it reads like one in every row."""
    return bool(pyarrow.types.is_string(kind) or pyarrow.types.is_large_string(kind))


Reader = Callable[[Path, RecordingSpec], Table]
READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".csv.gz": _read_csv,
    ".parquet": _read_parquet,
    ".npz": read_arrays,
    ".json": read_nested,
    ".mcap": read_bag,
    ".db3": read_bag,
}
