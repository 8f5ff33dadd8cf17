"""Tables, lists and paragraphs of a summary, independent of how they are shown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, auto


class Emphasis(Enum):
    """Visual emphasis of a row or a sentence."""

    NORMAL = auto()
    STRONG = auto()
    WEAK = auto()
    WARNING = auto()
    STRONG_WARNING = auto()
    DERIVED = auto()  # computed from several other rows


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number in a table; every renderer chooses the notation.

    Attributes:
        value: The number.
        digits: Significant digits.
        suffix: Text behind it, with its space: " %", " s", " ×".
        infinite: Words for a positive infinite value, where words are wanted.
    """

    value: float
    digits: int = 3
    suffix: str = ""
    infinite: str = "∞"

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "-"
        if math.isinf(self.value):
            return self.infinite if self.value > 0.0 else f"-{self.infinite}"
        return f"{self.value:.{self.digits}g}{self.suffix}"


@dataclass(frozen=True, kw_only=True)
class Name:
    """A name with its unit, in a table or at the head of a column.

    Attributes:
        name: The name.
        unit: Its unit; may be empty.
    """

    name: str
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.name} ({self.unit})" if self.unit else self.name


Cell = str | Quantity | Name


@dataclass(frozen=True, kw_only=True)
class Column:
    """Head of a column.

    Attributes:
        heading: Its heading.
        left: True for text that is aligned to the left.
        detail: True where a short form leaves it out.
        optional: True where a short form leaves it out if names would be folded otherwise.
    """

    heading: str | Name
    left: bool = False
    detail: bool = False
    optional: bool = False


@dataclass(frozen=True, kw_only=True)
class Row:
    """One row of a table.

    Attributes:
        cells: A cell for every column.
        emphasis: How strongly it stands out.
        trajectory: "initial" or "final" where the row belongs to one of the two trajectories; else
            empty.
    """

    cells: tuple[Cell, ...]
    emphasis: Emphasis = Emphasis.NORMAL
    trajectory: str = ""


@dataclass(frozen=True, kw_only=True)
class ColumnGroup:
    """A heading above several columns.

    Attributes:
        trajectory: Name of the trajectory to which the columns belong.
        first: Index of its first column.
        last: Index of its last column.
    """

    trajectory: str
    first: int
    last: int


@dataclass(frozen=True, kw_only=True)
class SummaryTable:
    """A table of results.

    Attributes:
        key: Name by which a renderer finds it.
        title: Title above it.
        columns: Heads of the columns.
        rows: Its rows.
        groups: Headings above several columns.
        note: Remark below it; may be empty.
        detail: True where a short form leaves it out.
    """

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    groups: tuple[ColumnGroup, ...] = ()
    note: str = ""
    detail: bool = False


@dataclass(frozen=True, kw_only=True)
class Paragraph:
    """A sentence or two.

    Attributes:
        text: The text.
        emphasis: How strongly it stands out.
        detail: True where a short form leaves it out.
    """

    text: str
    emphasis: Emphasis = Emphasis.NORMAL
    detail: bool = False


@dataclass(frozen=True, kw_only=True)
class Listing:
    """Sentences under a heading.

    Attributes:
        title: The heading.
        items: The sentences; further lines of one sentence are separated by line breaks.
        emphasis: How strongly the sentences stand out.
        detail: True where a short form leaves it out.
        code: True for items that are lines of a file to be copied.
    """

    title: str
    items: tuple[str, ...]
    emphasis: Emphasis = Emphasis.NORMAL
    detail: bool = False
    code: bool = False


Part = SummaryTable | Paragraph | Listing


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Results in words and tables.

    Attributes:
        title: Title of the whole.
        outcome: One sentence that says how the work ended.
        parts: Tables, paragraphs and lists, the important one first.
        warnings: Sentences that the user must not overlook.
        emphasis: How strongly the outcome stands out.
    """

    title: str
    outcome: str
    parts: tuple[Part, ...]
    warnings: tuple[str, ...] = ()
    emphasis: Emphasis = Emphasis.STRONG

    def table(self, key: str) -> SummaryTable:
        """Return the table of a name."""
        return next(part for part in self.tables if part.key == key)

    @property
    def tables(self) -> tuple[SummaryTable, ...]:
        """All tables, in their order."""
        return tuple(part for part in self.parts if isinstance(part, SummaryTable))


def columns(
    *headings: str | Name,
    left: Sequence[str] = (),
    details: Sequence[str] = (),
    optional: Sequence[str] = (),
) -> tuple[Column, ...]:
    """Return the heads of columns.

    Args:
        headings: Heading of each column; the first column holds text.
        left: Headings of further columns that hold text.
        details: Headings of columns that a short form leaves out.
        optional: Headings of columns that a short form leaves out if names would be folded
            otherwise.
    """
    return tuple(
        Column(
            heading=heading,
            left=i == 0 or heading in left,
            detail=heading in details,
            optional=heading in optional,
        )
        for i, heading in enumerate(headings)
    )


def capitalised(sentence: str) -> str:
    """Return a sentence with a capital first letter; symbols and paths stay as they are.

    Args:
        sentence: The sentence.
    """
    first = sentence.partition(" ")[0].rstrip(":;,.")
    if not (first.isascii() and first.isalpha()):
        return sentence
    return sentence[:1].upper() + sentence[1:]
