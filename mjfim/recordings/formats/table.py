"""Columns of numbers of a log file by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed
from mjfim.recordings.spec import INPUT_PREFIXES, RecordingSpec

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
        unit_hint: How to state the units of columns of this format; empty without a special rule.
    """

    source: Path
    columns: dict[str, Array]
    faults: dict[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    truth_values: frozenset[str] = frozenset()
    unit_hint: str = ""

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

        found = listed(self.names)
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
        and all columns that may be a control, or what a law reads, under its default name.
    """
    sources = spec.sources
    if all(key.startswith(INPUT_PREFIXES) for key in sources):
        return list(names)

    stated = {spec.time}
    for source in sources.values():
        stated.update((source.column, *source.multiply_by))

    inputs = ("ctrl", *INPUT_PREFIXES)
    return [name for name in names if name in stated or name.startswith(inputs)]


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
