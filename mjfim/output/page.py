"""What is shown of a result, in every place: words, colours, names of files, and the page.

A page has a verdict, sentences and tables. The terminal, which is here, the report, notebooks and
the Rerun viewer are written from it. There is one word and one colour for each thing. The keys of
JSON files and arrays are part of the file formats and stay as they are; `SHOWN_WORDS` translates
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
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import zip_longest
from typing import NamedTuple

from rich import box
from rich import table as rich_table
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.padding import Padding
from rich.text import Text as Styled

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

    def files(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of files, where all pictures have this format.

        Args:
            names: Names of files; those of pictures end in .png.
        """
        return tuple(
            name.removesuffix("png") + self.value if name.endswith(".png") else name
            for name in names
        )


@dataclass(frozen=True, kw_only=True)
class Term:
    """A thing that is shown, and how.

    The colours differ also for readers who cannot tell red from green, and can be read on white and
    on dark grey.

    Attributes:
        word: The word for it.
        colour: Its colour, as `#rrggbb`.
        colour_on_dark: A brighter shade of it, for thin lines and text on a dark page.
        colour_name: The word for its colour.
    """

    word: str
    colour: str
    colour_on_dark: str
    colour_name: str

    @property
    def rgb(self) -> tuple[int, int, int]:
        """Its colour as red, green and blue from 0 to 255."""
        red, green, blue = bytes.fromhex(self.colour.removeprefix("#"))
        return red, green, blue


INITIAL = Term(word="initial", colour="#0077bb", colour_on_dark="#4fb0f0", colour_name="blue")
DESIGNED = Term(word="designed", colour="#cc3311", colour_on_dark="#ff7f66", colour_name="red")
NOMINAL = Term(word="nominal", colour="#ee7733", colour_on_dark="#f7a55c", colour_name="orange")
MEASURED = Term(word="measured", colour="#009988", colour_on_dark="#2fc9b5", colour_name="teal")
IDENTIFIED = Term(
    word="identified", colour="#aa3377", colour_on_dark="#e884bd", colour_name="purple"
)

# What is beside the five, such as a baseline.
OTHER = Term(word="other", colour="#8a6d3b", colour_on_dark="#cdb07a", colour_name="brown")

TERMS = (INITIAL, DESIGNED, NOMINAL, MEASURED, IDENTIFIED)

# The terms of the two trajectories of a design or study, by their key in the records and files.
TRAJECTORY_TERMS: dict[str, Term] = {"initial": INITIAL, "final": DESIGNED}

# Words that are shown for keys of records and files; other keys are shown as they are.
SHOWN_WORDS: dict[str, str] = {key: term.word for key, term in TRAJECTORY_TERMS.items()}


def shown_word(key: str) -> str:
    """Return the word that is shown for a key.

    Args:
        key: Key of a record or file, such as `final`.
    """
    return SHOWN_WORDS.get(key, key)


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
        verbose: Whether a terminal shows all of it, or a screen of text at most.
    """

    kind: str
    verdict: Verdict
    next_steps: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Sequence[Section] = ()
    verbose: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Lay out the page for the width of the terminal which shows it."""
        verdict = capitalised(self.verdict.text)
        if verdict:
            is_good = self.verdict.level is Level.GOOD
            yield _styled(verdict, "bold" if is_good else "bold yellow")
        parts: list[Shown] = [
            *(Text(f"warning: {warning}", Emphasis.WARNING) for warning in self.warnings),
            *(part for part in self.parts if self.verbose or not part.detail),
            *(Text(f"Next: {step}") for step in self.next_steps[:1]),
        ]
        width, hidden = options.max_width, 0
        if not self.verbose:
            parts, hidden = _shortened(parts, width, MAX_LINES - _height(Text(verdict), width))
        for part in parts:
            if self.verbose and not isinstance(part, Text):
                yield Styled()
            yield from _rendered(part, width, verbose=self.verbose)
        if hidden:
            rows = "1 row or sentence" if hidden == 1 else f"{hidden} rows and sentences"
            yield _styled(f"Not shown here: {rows}; --verbose shows everything", "dim")

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


# Largest number of lines of the short form, if its most important rows have the room.
MAX_LINES = 20

# Fewest rows of the first table, and of further tables and lists, that the short form shows.
FEWEST_RESULTS, FEWEST = 10, 2

# Space between two columns, and least width of a column of text [characters].
GAP, FOLDED_WIDTH = 2, 12

# Parts that a terminal shows.
Shown = Table | Text | Listing

# Rich style of every emphasis.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "bold",
    Emphasis.WEAK: "dim",
    Emphasis.WARNING: "yellow",
    Emphasis.DERIVED: "cyan",
}


def render(page: Page, *, verbose: bool = False) -> Page:
    """Choose what a Rich console prints of a page.

    Args:
        page: The page.
        verbose: True for all tables and sentences, False for a screen of text at most.
    """
    return replace(page, verbose=verbose)


def _styled(text: str, style: str) -> Styled:
    """A text of one style, which is folded and never cut."""
    return Styled(text, style=style, overflow="fold")


# ---- short form


def _shortened(parts: Sequence[Shown], width: int, lines: int) -> tuple[list[Shown], int]:
    """Leave out explanations, and then rows, until the parts have few enough lines."""
    shown = list(parts)
    for part in parts:
        is_explanation = isinstance(part, Text) and part.emphasis is Emphasis.WEAK
        if is_explanation and sum(_height(each, width) for each in shown) > lines:
            shown.remove(part)
    results = next((i for i, part in enumerate(shown) if isinstance(part, Table)), -1)
    hidden = 0
    while sum(_height(part, width) for part in shown) > lines - bool(hidden):
        spare = [
            _count(part) - (FEWEST_RESULTS if i == results else FEWEST)
            for i, part in enumerate(shown)
        ]
        highest = max(range(len(shown)), key=spare.__getitem__, default=0)
        if not spare or spare[highest] <= 0:
            break
        shown[highest] = _without_last(shown[highest])
        hidden += 1
    return shown, len(parts) - len(shown) + hidden


def _count(part: Shown) -> int:
    """Number of rows or items of a part."""
    if isinstance(part, Text):
        return 1
    return len(part.rows if isinstance(part, Table) else part.items)


def _height(part: Shown, width: int) -> int:
    """Number of lines of a part; a long sentence may take one more."""
    if isinstance(part, Table):
        return (
            2 + bool(part.title) + len(part.rows) + (_lines(part.note, width) if part.note else 0)
        )
    if isinstance(part, Text):
        return _lines(part.text, width)
    return bool(part.title) + sum(_lines(item, width - GAP) for item in part.items)


def _lines(text: str, width: int) -> int:
    """Number of lines of a text."""
    return sum(-(-max(cell_len(line), 1) // width) for line in text.split("\n"))


def _without_last(part: Shown) -> Shown:
    """A part without its last row that does not stand out."""
    if isinstance(part, Table):
        plain = [row for row in part.rows if row.emphasis in (Emphasis.NORMAL, Emphasis.WEAK)]
        last = (plain or part.rows)[-1]
        return replace(part, rows=tuple(row for row in part.rows if row is not last))
    return replace(part, items=part.items[:-1]) if isinstance(part, Listing) else part


# ---- parts


def _rendered(
    part: Shown, width: int, *, verbose: bool
) -> Iterator[Styled | Padding | rich_table.Table]:
    """A part as what Rich prints."""
    if isinstance(part, Text):
        yield _styled(part.text, STYLES[part.emphasis])
        return
    if part.title:
        yield _styled(part.title, "bold")
    if isinstance(part, Listing):
        bullet = "" if part.code else "• "
        for item in part.items:
            text = _styled(f"{bullet}{item}", STYLES[part.emphasis])
            yield Padding(text, (0, 0, 0, GAP), expand=False)
        return
    shown = _columns(part, width, verbose=verbose)
    widths = _widths(part, shown, width)
    if widths is None:
        yield from _paragraphs(part, shown)
    else:
        yield _grid(part, shown, widths)
    if part.note:
        yield _styled(part.note, "dim")


def _columns(table: Table, width: int, *, verbose: bool) -> list[int]:
    """The numbers of the columns for which there is room."""
    shown = list(range(len(table.columns)))
    if verbose:
        return shown
    for heading in reversed(table.spare):
        if heading not in table.columns:
            continue
        names = max((cell_len(row.cells[0]) for row in table.rows), default=0)
        widths = _widths(table, shown, width)
        if widths is not None and widths[0] >= names:
            break
        shown.remove(table.columns.index(heading))
    return shown


def _widths(table: Table, shown: Sequence[int], available: int) -> list[int] | None:
    """The width of each column, so that no number is folded; None if the table is too wide."""
    least, natural = [], []
    for k in shown:
        heading = table.columns[k]
        cells = max((cell_len(row.cells[k]) for row in table.rows), default=0)
        words = max(map(cell_len, heading.split()), default=0)
        natural.append(max(cells, cell_len(heading)))
        is_folded = table.is_left(k)
        least.append(max(words, min(cells, FOLDED_WIDTH) if is_folded else cells))
    room = available - GAP * (len(shown) - 1) - sum(least)
    if room < 0:
        return None
    # Text receives its full width first, so that headings are folded before names are.
    for i in sorted(range(len(shown)), key=lambda i: not table.is_left(shown[i])):
        added = min(natural[i] - least[i], room)
        least[i] += added
        room -= added
    return least


def _grid(table: Table, shown: Sequence[int], widths: Sequence[int]) -> rich_table.Table:
    """A table whose columns have these widths."""
    grid = rich_table.Table(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, GAP - 1, 0, 0)
    )
    for k, width in zip(shown, widths, strict=True):
        grid.add_column(
            Styled(table.columns[k], style="dim"),
            justify="left" if table.is_left(k) else "right",
            vertical="top",
            overflow="fold",
            width=width,
        )
    for row in table.rows:
        style = STYLES[row.emphasis]
        grid.add_row(*(Styled(row.cells[k], style=style) for k in shown))
    return grid


def _paragraphs(table: Table, shown: Sequence[int]) -> Iterator[Styled | Padding]:
    """Each row as a paragraph: its name, and below it the other cells with their headings."""
    for row in table.rows:
        style = STYLES[row.emphasis]
        cells = [f"{table.columns[k]} {row.cells[k]}" for k in shown[1:] if row.cells[k]]
        yield _styled(row.cells[0], style)
        yield Padding(_styled(", ".join(cells), style), (0, 0, 0, GAP), expand=False)
