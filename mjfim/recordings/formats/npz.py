"""Reader of NPZ archives, whose vectors and columns of matrices are the columns of the log."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed
from mjfim.files import read_arrays
from mjfim.recordings.formats.table import NOT_NUMERIC, Table, columns_to_read, length_fault
from mjfim.recordings.spec import INPUT_PREFIXES, RecordingSpec

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
    arrays = read_arrays(path, "log")
    for name, array in arrays.items():
        if array.ndim == 2 and array.shape[1] > MAX_COLUMNS:
            raise RecordingError(
                f"{path}: array {name!r} of shape {array.shape} has too many columns; each row "
                "must hold the values of one time"
            )

    labels = {name: _labels(name, array) for name, array in arrays.items() if array.ndim <= 2}
    time = arrays.get(spec.time)
    if time is None or time.ndim != 1:
        fault = "is missing" if time is None else f"has shape {time.shape}; times are a vector"
        raise RecordingError(f"{path}: array {spec.time!r} {fault}; found: {listed([*labels])}")

    rows = len(time)
    needed = set(columns_to_read(itertools.chain.from_iterable(labels.values()), spec))
    controls = {s.column for key, s in spec.sources.items() if key.startswith(INPUT_PREFIXES)}

    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    unread: list[str] = []
    truth_values: set[str] = set()
    for name, parts in labels.items():
        array = arrays[name]
        is_control = name.startswith(("ctrl", *INPUT_PREFIXES)) or not controls.isdisjoint(parts)

        if array.dtype.kind == "b":
            truth_values.update(parts)

        if array.dtype.kind not in "fiub":
            faults.update(dict.fromkeys(parts, NOT_NUMERIC))
        elif not _fits(array.shape, rows, is_control):
            faults.update(dict.fromkeys(parts, length_fault(len(array), spec.time, rows)))
        elif needed.isdisjoint(parts):
            unread += parts
        else:
            columns.update(zip(parts, _values(array, rows).T, strict=True))

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


def _labels(name: str, array: np.ndarray) -> list[str]:
    """Names of the columns that a number, a vector or a matrix becomes."""
    return [name] if array.ndim < 2 else [f"{name}[{i}]" for i in range(array.shape[1])]


def _values(array: np.ndarray, rows: int) -> Array:
    """(rows, k) numbers of one array; a missing last row is NaN."""
    values = np.asarray(array, dtype=np.float64)
    if values.ndim == 0:
        return np.full((rows, 1), float(values))
    if len(values) == rows - 1:
        values = np.concatenate([values, np.full((1, *values.shape[1:]), np.nan)])
    return values.reshape(rows, -1)
