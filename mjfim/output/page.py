"""The page of a result: its verdict, its sentences and its tables, for every place that shows it.

The terminal, the report, notebooks and the Rerun viewer are written from the same page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import zip_longest
from typing import NamedTuple


class Emphasis(StrEnum):
    """How much a row or a sentence stands out; the value is the class in HTML."""

    NORMAL = ""
    STRONG = "strong"
    WEAK = "weak"
    """An explanation, which is left out first where there is no room."""
    WARNING = "warning"
    DERIVED = "derived"
    """Computed from several rows of the table."""


class Level(StrEnum):
    """How good a result is."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    BAD = "bad"


class Verdict(NamedTuple):
    """The result of a verb in one sentence."""

    text: str
    level: Level


class Row(NamedTuple):
    """One row of a table, with a cell for each column."""

    cells: tuple[str, ...]
    emphasis: Emphasis = Emphasis.NORMAL


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of results.

    Attributes:
        title: Its title; may be empty.
        columns: Headings; the first column holds names.
        rows: Its rows.
        spare: Headings of columns that are left out where there is no room, the last one first.
        note: Sentence below the table; may be empty.
        detail: Whether a short form leaves it out.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[Row, ...]
    spare: tuple[str, ...] = ()
    note: str = ""
    detail: bool = False

    def is_left(self, column: int) -> bool:
        """Whether a column holds names or words, which stand to the left."""
        words = [row.cells[column][:1] for row in self.rows if row.cells[column]]
        return column == 0 or (bool(words) and all(letter.isalpha() for letter in words))


@dataclass(frozen=True)
class Text:
    """A sentence or two; a short form leaves details out."""

    text: str
    emphasis: Emphasis = Emphasis.NORMAL
    detail: bool = False


@dataclass(frozen=True)
class Listing:
    """Sentences under a heading, which may be empty; `code` are lines to be copied."""

    title: str
    items: tuple[str, ...]
    emphasis: Emphasis = Emphasis.NORMAL
    code: bool = False
    detail: bool = False


@dataclass(frozen=True)
class Plot:
    """The pictures of the record whose names begin like this, as `fit`, or `fit_1` and `fit_2`."""

    name: str


Part = Table | Text | Listing | Plot


@dataclass(frozen=True)
class Section:
    """Parts under a heading."""

    title: str
    parts: Sequence[Part]


@dataclass(frozen=True, kw_only=True)
class Page:
    """A result in words, tables and names of pictures.

    Attributes:
        kind: What kind of result it is.
        verdict: The result in one sentence.
        next_steps: What the reader can do next, the most useful step first.
        warnings: What limits the result.
        facts: Short facts by their names.
        sections: Sections, the main results first.
    """

    kind: str
    verdict: Verdict
    next_steps: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Sequence[Section] = ()

    @property
    def every_part(self) -> Iterator[Part]:
        """All parts, in their order."""
        for section in self.sections:
            yield from section.parts

    @property
    def parts(self) -> Iterator[Table | Text | Listing]:
        """All tables and sentences, in their order."""
        return (part for part in self.every_part if not isinstance(part, Plot))

    @property
    def tables(self) -> tuple[Table, ...]:
        """All tables, in their order."""
        return tuple(part for part in self.parts if isinstance(part, Table))


def number(value: float, digits: int = 3, suffix: str = "", infinite: str = "∞") -> str:
    """Write a number.

    Args:
        value: The number.
        digits: Significant digits.
        suffix: Text behind a finite number, such as " %".
        infinite: Text for an infinite number.

    Returns:
        The number; "-" where it is unknown.
    """
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return infinite if value > 0.0 else f"-{infinite}"
    return f"{value:.{digits}g}{suffix}"


def numbers(
    values: Iterable[float], digits: int = 3, suffix: str = "", infinite: str = "∞"
) -> list[str]:
    """Write numbers as `number` does."""
    return [number(value, digits, suffix, infinite) for value in values]


def named(name: str, unit: str) -> str:
    """Write a name with its unit."""
    return f"{name} ({unit})" if unit else name


def tabulated(
    title: str,
    columns: Mapping[str, Sequence[str]],
    emphases: Iterable[Emphasis] = (),
    *,
    spare: tuple[str, ...] = (),
    note: str = "",
    detail: bool = False,
) -> Table:
    """Return a table of columns.

    Args:
        title: Its title.
        columns: The cells of each column, by its heading.
        emphases: Emphasis of every row; none for normal rows.
        spare: See `Table`.
        note: See `Table`.
        detail: See `Table`.
    """
    cells = zip(*columns.values(), strict=True)
    marked = zip_longest(cells, emphases, fillvalue=Emphasis.NORMAL)
    return Table(
        title=title,
        columns=tuple(columns),
        rows=tuple(Row(tuple(row), emphasis) for row, emphasis in marked),
        spare=spare,
        note=note,
        detail=detail,
    )


def warned(are_odd: Iterable[bool]) -> list[Emphasis]:
    """Return the emphasis of rows, some of which are a warning."""
    return [Emphasis.WARNING if is_odd else Emphasis.NORMAL for is_odd in are_odd]


def capitalised(sentence: str) -> str:
    """Begin a sentence with a capital letter; symbols and paths stay as they are."""
    first = sentence.partition(" ")[0].rstrip(":;,.")
    if not (first.isascii() and first.isalpha()):
        return sentence
    return sentence[:1].upper() + sentence[1:]


def as_sentence(text: str) -> str:
    """Begin a text with a capital letter, and end it with a full stop."""
    return capitalised(text) + ("" if text.endswith((".", "!", "?")) else ".")
