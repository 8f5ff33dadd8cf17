"""What a log file holds before anyone knows what it means: columns of numbers by name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.recordings.spec import RecordingSpec

# What a file may unpack to [bytes]: never more than LARGEST, nor SUSPECT at more than RATIO times its own size.
LARGEST = 4 * 2**30
SUSPECT = 64 * 2**20
RATIO = 200.0
LONGEST = 200  # characters of a library's message


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of one file, all of M rows.

    columns: (M,) float64 by name, NaN where empty
    faults: why a column that is there cannot be used, by name (`is not numeric`);  unread: names of columns left out
    """

    source: Path
    columns: dict[str, Array]
    faults: dict[str, str] = field(default_factory=dict)
    unread: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Everything that the file holds."""
        return (*self.columns, *self.faults, *self.unread)

    def column(self, name: str) -> Array:
        """(M,) Raises RecordingError where it is not there or cannot be used."""
        if name in self.columns:
            return self.columns[name]
        if name in self.faults:
            raise RecordingError(f"{self.source}: column {name!r} {self.faults[name]}")
        raise RecordingError(
            f"{self.source}: column {name!r} is missing; found: {', '.join(self.names) or 'none'}"
        )


def chosen(names: Iterable[str], spec: RecordingSpec) -> list[str]:
    """Columns that have to be read: all, unless the recording says which; controls may always stand by their own name."""
    sources = spec.sources
    if all(key.startswith("ctrl:") for key in sources):
        return list(names)
    wanted = {spec.time}.union(*({s.column, *s.multiply_by} for s in sources.values()))
    return [name for name in names if name in wanted or name.startswith("ctrl")]


def refuse_bomb(path: Path, packed: int, unpacked: int) -> None:
    """Raise RecordingError where packed bytes unpack to too many."""
    if unpacked > LARGEST:
        raise RecordingError(
            f"{path}: unpacks to more than {LARGEST / 2**30:.3g} GiB, the most that is read; split the file"
        )
    if unpacked > SUSPECT and unpacked > RATIO * packed:
        raise RecordingError(
            f"{path}: unpacks to more than {RATIO:g} times its size, as logs do not; unpack it yourself if it is one"
        )


def said(error: Exception) -> str:
    """What a library says, in one line that is not too long."""
    printable = "".join(
        c if c.isprintable() or c.isspace() else "?" for c in str(error)
    )  # it may quote the file
    line = " ".join(printable.split()) or type(error).__name__
    return line if len(line) <= LONGEST else f"{line[:LONGEST]}..."
