"""Pages on a terminal: a screen of text at most, or all tables and sentences."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import Any

from rich.cells import cell_len
from rich.console import Console, Group
from rich.padding import Padding
from rich.segment import Segment
from rich.style import Style
from rich.text import Text as Styled

from mjfim.output.page import Emphasis, Listing, Page, Row, Table, Text
from mjfim.records.base import Level

# Largest number of remarks of each weight that the short form shows.
MOST = {"Fix first": 1, "Warning": 2, "Detail": 0}

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

# Rich style of every verdict.
VERDICT_STYLES = {Level.GOOD: "bold", Level.DOUBTFUL: "bold yellow", Level.BAD: "bold red"}


def laid_out(
    page: Page,
    console: Console,
    *,
    verbose: bool = False,
    more: str = "--verbose shows everything",
) -> Group:
    """Lay out a page for the width of the console that prints it.

    Args:
        page: The page.
        console: The console.
        verbose: True for all tables and sentences, False for a screen of text at most.
        more: What shows those that are left out.
    """
    parts: list[Shown] = []
    width, hidden = console.width, 0
    for weight, sentences in page.remarks.items():
        kept = sentences if verbose else sentences[: MOST[weight]]
        emphasis = Emphasis.WARNING if MOST[weight] else Emphasis.WEAK
        parts += (Text(f"{weight}: {sentence}", emphasis) for sentence in kept)
        hidden += len(sentences) - len(kept)
    parts += (part for part in page.parts if verbose or not part.detail)
    parts += (Text(f"Next: {step}") for step in page.next_steps[:1])
    verdict = page.verdict.sentence
    if not verbose:
        lines = MAX_LINES - _height(Text(verdict), width) - bool(hidden)
        parts, left = _shortened(parts, width, lines)
        hidden += left

    shown: list[Any] = []
    if verdict:
        shown.append(_styled(verdict, VERDICT_STYLES[page.verdict.level]))
    for part in parts:
        if verbose and not isinstance(part, Text):
            shown.append(Styled())
        shown += _rendered(part, width, console, verbose=verbose)
    if hidden:
        rows = "1 row or sentence" if hidden == 1 else f"{hidden} rows and sentences"
        shown.append(_styled(f"Not shown here: {rows}; {more}", "dim"))
    return Group(*shown)


def text_of(page: Page, width: int = 80) -> str:
    """The short form of a page as plain text, for `print` in Python."""
    console = Console(width=width, file=io.StringIO(), force_jupyter=False, color_system=None)
    with console.capture() as captured:
        console.print(laid_out(page, console, more="a notebook and the report show everything"))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())


def _styled(text: str, style: str) -> Styled:
    """A text of one style, which is folded and never cut."""
    return Styled(text, style=style, overflow="fold", no_wrap=False)


# ---- short form


def _shortened(parts: Sequence[Shown], width: int, lines: int) -> tuple[list[Shown], int]:
    """Leave out explanations, and then rows, until the parts have few enough lines."""
    shown = list(parts)

    def height() -> int:
        return sum(_height(part, width) for part in shown)

    for part in parts:
        is_explanation = isinstance(part, Text) and part.emphasis is Emphasis.WEAK
        if is_explanation and height() > lines:
            shown.remove(part)
    results = next((i for i, part in enumerate(shown) if isinstance(part, Table)), -1)
    hidden = 0
    while height() > lines - bool(hidden):
        spare = [
            _count(part) - (FEWEST_RESULTS if i == results else FEWEST)
            for i, part in enumerate(shown)
        ]
        most = max(spare, default=0)
        if most <= 0:
            break
        longest = spare.index(most)
        shown[longest] = _without_last(shown[longest])
        hidden += 1
    return shown, len(parts) - len(shown) + hidden


def _count(part: Shown) -> int:
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
    part: Shown, width: int, console: Console, *, verbose: bool
) -> Iterator[Styled | Padding | Segment]:
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
        yield from _grid(part, shown, widths, console)
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


def _grid(
    table: Table, shown: Sequence[int], widths: Sequence[int], console: Console
) -> Iterator[Styled | Segment]:
    """The lines of a table whose columns have these widths.

    A table of Rich itself takes minutes for the rows of a large model.
    """
    head = Row(table.columns, Emphasis.WEAK)
    aligned = [str.ljust if table.is_left(k) else str.rjust for k in shown]
    for row in (head, *table.rows):
        cells = [
            _folded(row.cells[k], size, console) for k, size in zip(shown, widths, strict=True)
        ]
        for parts in zip_longest(*cells, fillvalue=""):
            # Some characters take two places.
            line = (" " * GAP).join(
                align(part, size + len(part) - cell_len(part))
                for align, part, size in zip(aligned, parts, widths, strict=True)
            )
            yield Segment(f"{line.rstrip()}\n", Style.parse(STYLES[row.emphasis]))
        if row is head:
            yield Segment("─" * (sum(widths) + GAP * (len(widths) - 1)) + "\n")


def _folded(text: str, width: int, console: Console) -> list[str]:
    if cell_len(text) <= width:
        return [text]
    return [line.plain for line in _styled(text, "").wrap(console, width)]


def _paragraphs(table: Table, shown: Sequence[int]) -> Iterator[Styled | Padding]:
    """Each row as a paragraph: its name, and below it the other cells with their headings."""
    for row in table.rows:
        style = STYLES[row.emphasis]
        cells = [f"{table.columns[k]} {row.cells[k]}" for k in shown[1:] if row.cells[k]]
        yield _styled(row.cells[0], style)
        yield Padding(_styled(", ".join(cells), style), (0, 0, 0, GAP), expand=False)
