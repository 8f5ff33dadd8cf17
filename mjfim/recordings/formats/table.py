"""Columns of a log file by name, which become numbers when they are used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.compute

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, shortened
from mjfim.recordings.spec import INPUT_PREFIXES, RecordingSpec

# Longest quotation of another library's error message [characters].
MAX_QUOTATION = 200

# Largest number of rows of a column of text in which one is looked for that is no number.
MAX_SEARCHED_ROWS = 100_000

# Fault of a column that holds text or objects.
NOT_NUMERIC = "is not numeric"

types = pyarrow.types
NUMERIC = (types.is_integer, types.is_floating, types.is_decimal, types.is_boolean, types.is_null)
LISTS = (types.is_list, types.is_large_list, types.is_fixed_size_list)


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Columns of one file, all with M rows.

    Attributes:
        source: The file, for messages.
        contents: What the file holds by the name of a column: an arrow array, or the words that
            say why it cannot be used.
        unit_hint: How to state units that the file does not name; it ends messages about them.
    """

    source: Path
    contents: dict[str, Any]
    unit_hint: str = ""

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
        return cls(source=source, contents=columns, unit_hint=unit_hint)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns of the file, also of those that hold no numbers."""
        return tuple(self.contents)

    def column(self, name: str) -> Array:
        """Return one column.

        Args:
            name: Its name.

        Returns:
            (M,) numbers, NaN where the file holds none.

        Raises:
            RecordingError: There is no such column, or it holds no numbers.
        """
        if name not in self.contents:
            found = listed(self.names)
            raise RecordingError(f"{self.source}: column {name!r} is missing; found: {found}")

        values = self.contents[name]
        fault = values if isinstance(values, str) else _fault(values)
        if fault:
            raise RecordingError(f"{self.source}: column {name!r} {fault}")
        numbers = values.cast(pyarrow.float64(), safe=False)
        return np.asarray(numbers.to_numpy(zero_copy_only=False))

    def measurement(self, name: str) -> Array:
        """Return one column that holds times or measured numbers.

        Raises:
            RecordingError: As `column`, or the column holds truth values.
        """
        values = self.contents.get(name)
        if not isinstance(values, str) and types.is_boolean(_kind(values)):
            raise RecordingError(
                f"{self.source}: column {name!r} holds truth values (true and false), which are no "
                "measurement; name a column of numbers, or write 1 and 0 if these are the numbers"
            )
        return self.column(name)


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

    if not _is_any(LISTS, values.type):
        return {"": values}
    column = values.combine_chunks() if isinstance(values, pyarrow.ChunkedArray) else values
    width = len(column[0]) if len(column) and column[0].is_valid else 0
    numbers = column.flatten()
    lengths = pyarrow.compute.list_value_length(column).to_numpy(zero_copy_only=False)
    if (lengths == width).all():
        return {f"[{i}]": numbers[i::width] for i in range(width)}
    row = int(np.argmax(lengths != width)) + 1
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


def _is_any(tests: Sequence[Any], kind: Any) -> bool:
    """Whether an arrow type passes one of several tests."""
    return any(test(kind) for test in tests)


def _fault(values: Any) -> str:
    """Why an arrow array holds no numbers, with its first text that is none; empty if it does."""
    if _is_any(NUMERIC, _kind(values)):
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
