"""Reader of NPZ archives, whose vectors and columns of matrices are the columns of the log."""

from __future__ import annotations

import itertools
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed
from mjfim.recordings.formats.table import (
    NOT_NUMERIC,
    Table,
    columns_to_read,
    length_fault,
    one_line,
)
from mjfim.recordings.spec import INPUT_PREFIXES, RecordingSpec
from mjfim.records.unpacked_size import (
    DAMAGED_ARCHIVE,
    Header,
    array_headers,
    check_is_archive,
)

# Largest number of columns of one matrix. If a matrix has more, its rows are probably not times.
MAX_COLUMNS = 4096


def read_npz(path: Path, spec: RecordingSpec) -> Table:
    """Read the one- and two-dimensional arrays of an archive; nothing is unpickled.

    A single number holds for all rows. A control may have one row less than the time.

    Args:
        path: The archive.
        spec: The `[recording]` table; its time is one of the arrays.

    Returns:
        The columns `name` of vectors and `name[i]` of matrices.

    Raises:
        RecordingError: The archive is damaged or too large, holds pickled objects, or has no time.
    """
    check_is_archive(path, "log")
    try:
        with zipfile.ZipFile(path) as archive:
            headers = array_headers(path, archive)
            for name, (shape, dtype) in headers.items():
                _check_array(path, name, shape, dtype)
            return _table(path, archive, headers, spec)
    except DAMAGED_ARCHIVE as error:
        raise RecordingError(
            f"{path}: not a readable npz archive (damaged or truncated?): {one_line(error)}"
        ) from None


def _check_array(path: Path, name: str, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Refuse pickled objects, and matrices whose rows are probably not times."""
    if dtype.hasobject:
        raise RecordingError(
            f"{path}: array {name!r} holds pickled objects, which are never read; save it as "
            "numbers"
        )

    if len(shape) == 2 and shape[1] > MAX_COLUMNS:
        raise RecordingError(
            f"{path}: array {name!r} of shape {shape} has too many columns; each row must hold the "
            "values of one time"
        )


def _table(
    path: Path,
    archive: zipfile.ZipFile,
    headers: Mapping[str, Header],
    spec: RecordingSpec,
) -> Table:
    """Read the arrays that are needed; headers: shape and type of each array by its name."""
    labels = {name: _labels(name, shape) for name, (shape, _) in headers.items() if len(shape) <= 2}
    time = headers[spec.time][0] if spec.time in headers else None
    if time is None or len(time) != 1:
        fault = "is missing" if time is None else f"has shape {time}; times are a vector"
        found = listed([*labels])
        raise RecordingError(f"{path}: array {spec.time!r} {fault}; found: {found}")

    rows = time[0]
    needed = set(columns_to_read(itertools.chain.from_iterable(labels.values()), spec))
    controls = {s.column for key, s in spec.sources.items() if key.startswith(INPUT_PREFIXES)}

    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    unread: list[str] = []
    truth_values: set[str] = set()
    for name, parts in labels.items():
        shape, dtype = headers[name]
        is_control = name.startswith(("ctrl", *INPUT_PREFIXES)) or not controls.isdisjoint(parts)

        if dtype.kind == "b":
            truth_values.update(parts)

        if dtype.kind not in "fiub":
            faults.update(dict.fromkeys(parts, NOT_NUMERIC))
        elif not _fits(shape, rows, is_control):
            faults.update(dict.fromkeys(parts, length_fault(shape[0], spec.time, rows)))
        elif needed.isdisjoint(parts):
            unread += parts
        else:
            columns.update(zip(parts, _values(archive, name, rows).T, strict=True))

    return Table(
        source=path,
        columns=columns,
        faults=faults,
        unread=tuple(unread),
        truth_values=frozenset(truth_values),
    )


def _fits(shape: tuple[int, ...], rows: int, is_control: bool) -> bool:
    """Whether an array of this shape has a value for every row, or is a number for all rows."""
    if not shape:
        return True

    # A control is held from each row to the next one, so the last row may have no control.
    return shape[0] == rows or (is_control and shape[0] == rows - 1)


def _labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """Names of the columns that a number, a vector or a matrix becomes."""
    return [name] if len(shape) < 2 else [f"{name}[{i}]" for i in range(shape[1])]


def _values(archive: zipfile.ZipFile, name: str, rows: int) -> Array:
    """(rows, k) numbers of one array; a missing last row is NaN."""
    with archive.open(f"{name}.npy") as stream:
        values = np.asarray(np.lib.format.read_array(stream, allow_pickle=False), dtype=np.float64)

    if values.ndim == 0:
        return np.full((rows, 1), float(values))
    if len(values) == rows - 1:
        values = np.concatenate([values, np.full((1, *values.shape[1:]), np.nan)])
    return values.reshape(rows, -1)
