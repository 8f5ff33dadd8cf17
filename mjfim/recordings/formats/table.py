"""Columns of numbers of a log file by name, and limits of its size."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.recordings.spec import RecordingSpec

# Largest size of a file's unpacked content, and of the columns read from it [bytes].
MAX_UNPACKED_SIZE = 4 * 2**30

# Unpacked size below which the packing ratio of a file is not checked [bytes].
UNSUSPICIOUS_SIZE = 64 * 2**20

# Largest plausible ratio of unpacked to packed size of a log.
MAX_PACKING_RATIO = 200.0

# Longest quotation of another library's error message [characters].
MAX_QUOTATION = 200

# Fault of a column that holds text or objects.
NOT_NUMERIC = "is not numeric"


@dataclass(frozen=True, kw_only=True, eq=False)
class Table:
    """Columns of one file, all with M rows.

    Attributes:
        source: The file.
        columns: (M,) float64 numbers by column name, NaN where a field is empty.
        faults: Reasons why columns cannot be used, by column name, each the end of a sentence that
            begins with the column, such as `is not numeric`.
        unread: Names of the columns that were not read because they were not requested.
        truth_values: Names of the columns that hold true and false in the file, which are 1 and 0
            in `columns`. They may switch a control, but they are no measurement.
    """

    source: Path
    columns: dict[str, Array]
    faults: dict[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    truth_values: frozenset[str] = frozenset()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns of the file: usable, faulty and unread ones."""
        return (*self.columns, *self.faults, *self.unread)

    def column(self, name: str) -> Array:
        """Return one column.

        Args:
            name: Name of the column in the file.

        Returns:
            (M,) numbers, NaN where a field is empty.

        Raises:
            RecordingError: The column is missing or cannot be used.
        """
        if name in self.columns:
            return self.columns[name]

        if name in self.faults:
            raise RecordingError(f"{self.source}: column {name!r} {self.faults[name]}")

        found = ", ".join(self.names) or "none"
        raise RecordingError(f"{self.source}: column {name!r} is missing; found: {found}")

    def measurement(self, name: str) -> Array:
        """Return one column that holds times or measured numbers.

        Args:
            name: Name of the column in the file.

        Returns:
            (M,) numbers, NaN where a field is empty.

        Raises:
            RecordingError: The column is missing, cannot be used, or holds truth values.
        """
        if name in self.truth_values:
            raise RecordingError(
                f"{self.source}: column {name!r} holds truth values (true and false), which are no "
                "measurement; name a column of numbers, or write 1 and 0 if these are the numbers"
            )
        return self.column(name)


def check_names(path: Path, names: Sequence[str]) -> None:
    """Refuse a name that several columns have, because it is not clear which one is meant.

    Args:
        path: The file, for the message.
        names: Names of all columns of the file.

    Raises:
        RecordingError: A name occurs more than once.
    """
    name, count = Counter(names).most_common(1)[0] if names else ("", 0)
    if count > 1:
        raise RecordingError(
            f"{path}: more than one column is named {name!r}; every column needs a name of its own"
        )


def columns_to_read(names: Iterable[str], spec: RecordingSpec) -> list[str]:
    """Select the columns of a file that a recording needs.

    Args:
        names: Names of all columns of the file.
        spec: The `[recording]` table.

    Returns:
        All names if the table states no measured column. Otherwise the stated columns, the time,
        and all columns that may be a control under its default name.
    """
    sources = spec.sources
    if all(key.startswith("ctrl:") for key in sources):
        return list(names)

    stated = {spec.time}
    for source in sources.values():
        stated.update((source.column, *source.multiply_by))

    return [name for name in names if name in stated or name.startswith("ctrl")]


def check_unpacked_size(path: Path, packed: int, unpacked: int) -> None:
    """Refuse a decompression bomb.

    Args:
        path: The file, for messages.
        packed: Size of the packed content [bytes].
        unpacked: Size of the unpacked content so far, or as the file declares it [bytes].

    Raises:
        RecordingError: The unpacked content is too large, or far larger than the packed one.
    """
    if unpacked > MAX_UNPACKED_SIZE:
        raise RecordingError(
            f"{path}: unpacks to more than {MAX_UNPACKED_SIZE / 2**30:.3g} GiB, the largest size "
            "that is read; split the file"
        )

    if unpacked > UNSUSPICIOUS_SIZE and unpacked > MAX_PACKING_RATIO * packed:
        raise RecordingError(
            f"{path}: unpacks to more than {MAX_PACKING_RATIO:g} times its size, which is unusual "
            "for a log; if it is a log, unpack it first"
        )


def check_column_size(path: Path, rows: int, columns: int) -> None:
    """Refuse columns that would not fit into memory.

    Args:
        path: The file, for messages.
        rows: Number of rows of the file.
        columns: Number of columns that are to be read.

    Raises:
        RecordingError: The columns are too large as float64 numbers.
    """
    if rows * columns * 8 > MAX_UNPACKED_SIZE:
        raise RecordingError(
            f"{path}: {rows} rows of {columns} columns are more than "
            f"{MAX_UNPACKED_SIZE / 2**30:.3g} GiB, the largest size that is read; name fewer "
            "columns in [recording.columns]"
        )


def length_fault(length: int, time: str, rows: int) -> str:
    """Describe the fault of a column whose length differs from that of the time.

    Args:
        length: Number of rows of the column.
        time: Name of the column of times.
        rows: Number of times.

    Returns:
        The end of a sentence that begins with the column's name.
    """
    return f"has {length} rows, but {time!r} has {rows}; all columns need equal numbers of rows"


def one_line(error: Exception) -> str:
    """Quote another library's error message in one short line.

    Args:
        error: An error, whose message may quote content of a damaged file.

    Returns:
        The message without line breaks and control characters, at most `MAX_QUOTATION` characters.
    """
    # A damaged file may hold control sequences of a terminal, which must not be printed.
    printable = "".join(c if c.isprintable() or c.isspace() else "?" for c in str(error))

    line = " ".join(printable.split()) or type(error).__name__
    return line if len(line) <= MAX_QUOTATION else f"{line[:MAX_QUOTATION]}..."
