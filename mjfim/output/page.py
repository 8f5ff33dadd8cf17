"""What is shown of a result, in every place: words, colours, names of files, and the page.

A page has a verdict, sentences and tables. The terminal, the report, notebooks and the Rerun viewer
are written from it. There is one word and one colour for each thing. The keys of
JSON files and arrays are part of the file formats and stay as they are; `shown_word` translates
them.

| word       | meaning                                                           |
|------------|-------------------------------------------------------------------|
| initial    | the trajectory, or the control, with which the search begins      |
| designed   | the trajectory that the search found                              |
| nominal    | the model as its file states it, or a parameter's initial guess   |
| measured   | what a sensor of the robot recorded                               |
| identified | the model, or a parameter, with the estimate from the recordings  |
| σ          | the standard deviation of a parameter                             |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple, Self

if TYPE_CHECKING:
    from mjfim.records.base import Verdict

# Name of the report in a folder of results.
REPORT = "report.html"


class PictureFormat(StrEnum):
    """Format of pictures; the value is also the ending of their files."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"

    def file_of(self, picture: str) -> str:
        """Return the name of a picture's file.

        Args:
            picture: Name of the picture, without an ending.
        """
        return f"{picture}.{self.value}"


class Term(str):
    """The word for a thing that is shown, with its colours.

    The colours differ also for readers who cannot tell red from green, and can be read on white and
    on dark grey.

    Attributes:
        colour: Its colour, as `#rrggbb`.
        colour_on_dark: A brighter shade of it, for thin lines and text on a dark page.
        colour_name: The word for its colour.
    """

    __slots__ = ("colour", "colour_name", "colour_on_dark")
    colour: str
    colour_on_dark: str
    colour_name: str

    def __new__(cls, word: str, colour: str, colour_on_dark: str, colour_name: str) -> Self:
        """Return a word with its colours."""
        term = super().__new__(cls, word)
        term.colour, term.colour_on_dark, term.colour_name = colour, colour_on_dark, colour_name
        return term

    def __reduce__(self) -> tuple[type[Term], tuple[str, ...]]:
        """Parts of which a copy is made."""
        return Term, (str(self), self.colour, self.colour_on_dark, self.colour_name)

    @property
    def rgb(self) -> tuple[int, int, int]:
        """Its colour as red, green and blue from 0 to 255."""
        red, green, blue = bytes.fromhex(self.colour.removeprefix("#"))
        return red, green, blue


INITIAL = Term("initial", "#0077bb", "#4fb0f0", "blue")
DESIGNED = Term("designed", "#cc3311", "#ff7f66", "red")
NOMINAL = Term("nominal", "#ee7733", "#f7a55c", "orange")
MEASURED = Term("measured", "#009988", "#2fc9b5", "teal")
IDENTIFIED = Term("identified", "#aa3377", "#e884bd", "purple")

# What is beside the five, such as a baseline.
OTHER = Term("other", "#8a6d3b", "#cdb07a", "brown")

TERMS = (INITIAL, DESIGNED, NOMINAL, MEASURED, IDENTIFIED)

# The terms of the two trajectories of a design or study, by their key in the records and files.
TRAJECTORY_TERMS: dict[str, Term] = {"initial": INITIAL, "final": DESIGNED}


def shown_word(key: str) -> str:
    """Return the word that is shown for a key; other keys are shown as they are.

    Args:
        key: Key of a record or file, such as `final`.
    """
    return TRAJECTORY_TERMS.get(key, key)


class Emphasis(StrEnum):
    """Emphasis of a row or a sentence; the value is the class in HTML."""

    NORMAL = ""
    STRONG = "strong"
    WEAK = "weak"
    """An explanation, which is left out first where there is no room."""
    WARNING = "warning"
    DERIVED = "derived"
    """Computed from several rows of the table."""


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
    """The pictures of the record whose names begin like this, as `fit`, or `fit_1` and `fit_2`.

    Details are folded away.
    """

    name: str
    detail: bool = False


Part = Table | Text | Listing | Plot


@dataclass(frozen=True, kw_only=True)
class Page:
    """A result in words, tables and names of pictures.

    Attributes:
        kind: What kind of result it is.
        verdict: The result in one sentence; it takes reasons and steps from the page.
        next_steps: What the reader can do next, the most useful step first.
        causes: What is to be fixed first, each with its cure, the most probable cause first.
        warnings: What limits the result.
        details: Remarks that a short form leaves out.
        facts: Short facts by their names.
        sections: Parts by their headings, the main results first; those without parts go.
    """

    kind: str
    verdict: Verdict
    next_steps: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Mapping[str, Iterable[Part]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sections = {title: tuple(parts) for title, parts in self.sections.items()}
        kept = {title: parts for title, parts in sections.items() if parts}
        object.__setattr__(self, "sections", kept)
        verdict = self.verdict._replace(
            sentence=capitalised(self.verdict.sentence),
            reasons=(*self.causes, *self.warnings),
            next=self.next_steps,
        )
        object.__setattr__(self, "verdict", verdict)

    @property
    def remarks(self) -> Mapping[str, tuple[str, ...]]:
        """The sentences beside the result by their weight, the most serious ones first."""
        return {"Fix first": self.causes, "Warning": self.warnings, "Detail": self.details}

    @property
    def every_part(self) -> Iterator[Part]:
        """All parts, in their order."""
        for parts in self.sections.values():
            yield from parts

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


def parameter_names(
    of: Any, chosen: Iterable[int] | None = None, write: Callable[[str, str], str] = named
) -> list[str]:
    """Write the names of the parameters of a result with their units.

    Args:
        of: The result, with `parameters` and `units`.
        chosen: Numbers of the parameters; default: all.
        write: Writes a name with its unit.
    """
    every = list(map(write, of.parameters, of.units))
    return every if chosen is None else [every[j] for j in chosen]


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
    """Begin a text with a capital letter, and end it with a full stop, but no lines of a file."""
    has_end = text.endswith((".", "!", "?")) or "\n" in text
    return capitalised(text) + ("" if has_end else ".")
