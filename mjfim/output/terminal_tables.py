"""Tables of text that fit into the width of a terminal, without a cell that is cut.

A table that is too wide first folds its headings and its columns of text. If this is not enough,
its columns become its rows; if this is not enough either, each of its rows becomes a paragraph.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rich.cells import cell_len, chop_cells

from mjfim.output.summary_parts import Cell, Column, Emphasis, Name, SummaryTable
from mjfim.output.vocabulary import shown_word

# Space between two columns [characters].
GAP = "  "

# Width to which a column of text may be folded [characters].
FOLDED_WIDTH = 12

# Largest number of rows of a table whose columns may become its rows.
MAX_TRANSPOSED = 4

# Indentation of the numbers below a name, where each row is a paragraph.
INDENTATION = "  "

# Heading of the column with units.
UNIT = "unit"

# Words, each with the numbers before it and the spaces behind it.
WORD = re.compile(r"(?:\(?[\d.,]+ )*\S+\s*")

# Parts of names and sentences, behind each of which a line may end.
FOLDED_PART = re.compile(r"[^\s_/:.,-]*[\s_/:.,-]?")


@dataclass(frozen=True, kw_only=True)
class TableRow:
    """A row of a table as text.

    Attributes:
        lines: Its lines.
        emphasis: How strongly it stands out.
    """

    lines: tuple[str, ...]
    emphasis: Emphasis


@dataclass(frozen=True, kw_only=True)
class TableText:
    """A table as text.

    Attributes:
        head: Lines with the headings; empty where each row is a paragraph.
        rows: The rows.
        left_out: Headings of optional columns that are not shown.
    """

    head: tuple[str, ...]
    rows: tuple[TableRow, ...]
    left_out: tuple[str, ...] = ()

    def as_one(self) -> TableText:
        """The table with all its rows as one, none of which can be left out."""
        lines = tuple(line for row in self.rows for line in row.lines)
        return TableText(head=self.head, rows=(TableRow(lines=lines, emphasis=Emphasis.NORMAL),))


def table_text(
    table: SummaryTable, width: int, *, verbose: bool, rule: str = "─", narrow: bool = False
) -> TableText:
    """Lay out a table.

    Args:
        table: The table.
        width: Width of the terminal [characters].
        verbose: Whether details are shown, too.
        rule: Character of the line below the headings.
        narrow: Whether optional columns are left out where names would be folded otherwise.
    """
    shown = [k for k, column in enumerate(table.columns) if verbose or not column.detail]
    left_out: tuple[str, ...] = ()
    if narrow:
        shown, left_out = _without_optional(table, shown, width)

    grid = _Grid.of(table, shown)
    widths = grid.widths(width)
    if widths is not None:
        return replace(grid.laid_out(widths, rule), left_out=left_out)

    if len(grid.rows) <= MAX_TRANSPOSED:
        transposed = grid.transposed()
        widths = transposed.widths(width)
        if widths is not None:
            return replace(transposed.laid_out(widths, rule).as_one(), left_out=left_out)
    return TableText(head=(), rows=grid.paragraphs(width), left_out=left_out)


def _without_optional(
    table: SummaryTable, shown: Sequence[int], width: int
) -> tuple[list[int], tuple[str, ...]]:
    """Leave out optional columns, the last one first, while names are folded.

    Args:
        table: The table.
        shown: Indices of the columns that the short form shows.
        width: Width of the terminal [characters].

    Returns:
        Indices of the columns, and the headings of those that are left out.
    """
    kept = list(shown)
    left_out: list[str] = []
    for k in reversed(shown):
        if not table.columns[k].optional:
            continue
        if not _Grid.of(table, kept).folds_text(width):
            break
        kept.remove(k)
        left_out.append(_heading(table, k))
    return kept, tuple(reversed(left_out))


@dataclass(frozen=True, kw_only=True)
class _Grid:
    """A table whose cells are text.

    Attributes:
        headings: Heading of every column.
        is_left: Whether a column is text, which is aligned to the left and may be folded.
        rows: Cells of every row.
        emphases: Emphasis of every row.
    """

    headings: tuple[str, ...]
    is_left: tuple[bool, ...]
    rows: tuple[tuple[str, ...], ...]
    emphases: tuple[Emphasis, ...]

    @classmethod
    def of(cls, table: SummaryTable, shown: Sequence[int]) -> _Grid:
        """The columns `shown` of a table; units have a column of their own."""
        headings: list[str] = []
        is_left: list[bool] = []
        for k in shown:
            column = table.columns[k]
            headings.append(_heading(table, k))
            is_left.append(column.left)
            if _has_units(table, k, column):
                headings.append(UNIT)
                is_left.append(True)

        rows = []
        for row in table.rows:
            cells: list[str] = []
            for k in shown:
                cells += _texts(row.cells[k], has_unit=_has_units(table, k, table.columns[k]))
            rows.append(tuple(cells))
        return cls(
            headings=tuple(headings),
            is_left=tuple(is_left),
            rows=tuple(rows),
            emphases=tuple(row.emphasis for row in table.rows),
        )

    def widths(self, available: int) -> list[int] | None:
        """Find a width of each column; None if the table is too wide.

        Args:
            available: Width of the terminal [characters].
        """
        count = len(self.headings)
        room = available - len(GAP) * (count - 1)
        cells = [max((cell_len(row[k]) for row in self.rows), default=0) for k in range(count)]
        natural = [max(cells[k], cell_len(self.headings[k])) for k in range(count)]
        words = [max(map(cell_len, heading.split()), default=0) for heading in self.headings]

        least = [max(cells[k], words[k]) for k in range(count)]
        for k in range(count):
            if self.is_left[k]:
                folded = max(FOLDED_WIDTH, words[k])
                least[k] = min(natural[k], folded)
        if sum(least) > room:
            return None

        # Text receives its full width first, so that headings are folded before names are.
        widths = least
        for k in sorted(range(count), key=lambda k: not self.is_left[k]):
            spare = room - sum(widths)
            widths[k] += min(natural[k] - widths[k], spare)
        return widths

    def folds_text(self, available: int) -> bool:
        """Whether cells do not fit into one line each.

        Args:
            available: Width of the terminal [characters].
        """
        widths = self.widths(available)
        if widths is None:
            return True
        cells = [
            max((cell_len(row[k]) for row in self.rows), default=0) for k in range(len(widths))
        ]
        return any(width < cell for width, cell in zip(widths, cells, strict=True))

    def transposed(self) -> _Grid:
        """The table with its columns as rows; the first cells become headings."""
        return _Grid(
            headings=(self.headings[0], *(row[0] for row in self.rows)),
            is_left=(True, *(False for _ in self.rows)),
            rows=tuple(
                (self.headings[k], *(row[k] for row in self.rows))
                for k in range(1, len(self.headings))
            ),
            emphases=tuple(Emphasis.NORMAL for _ in self.headings[1:]),
        )

    def laid_out(self, widths: Sequence[int], rule: str) -> TableText:
        """The table as text, with columns of these widths."""
        total = sum(widths) + len(GAP) * (len(widths) - 1)
        head = (*self._lines(self.headings, widths, from_below=True), rule * total)
        rows = tuple(
            TableRow(lines=self._lines(row, widths), emphasis=emphasis)
            for row, emphasis in zip(self.rows, self.emphases, strict=True)
        )
        return TableText(head=head, rows=rows)

    def _lines(
        self, cells: Sequence[str], widths: Sequence[int], *, from_below: bool = False
    ) -> tuple[str, ...]:
        """The lines of one row; `from_below` aligns its cells at their last lines."""
        folded = [fold(cell, width) for cell, width in zip(cells, widths, strict=True)]
        height = max(len(lines) for lines in folded)
        lines = []
        for i in range(height):
            parts = []
            for k, of_cell in enumerate(folded):
                place = i - (height - len(of_cell)) if from_below else i
                text = of_cell[place] if 0 <= place < len(of_cell) else ""
                parts.append(_padded(text, widths[k], left=self.is_left[k]))
            lines.append(GAP.join(parts).rstrip())
        return tuple(lines)

    def paragraphs(self, width: int) -> tuple[TableRow, ...]:
        """Each row as a paragraph: its name, and below it the other cells with their headings."""
        rows = []
        for row, emphasis in zip(self.rows, self.emphases, strict=True):
            is_unit = len(self.headings) > 1 and self.headings[1] == UNIT
            name = f"{row[0]} ({row[1]})" if is_unit and row[1] else row[0]
            begin = 2 if is_unit else 1
            numbers = ", ".join(
                f"{heading} {cell}"
                for heading, cell in zip(self.headings[begin:], row[begin:], strict=True)
                if cell
            )
            below = fold(numbers, width - len(INDENTATION))
            lines = (*fold(name, width), *(f"{INDENTATION}{line}" for line in below))
            rows.append(TableRow(lines=lines, emphasis=emphasis))
        return tuple(rows)


def fold(text: str, width: int) -> list[str]:
    """Break a text into lines, behind spaces and the usual separators of names.

    Args:
        text: The text; its line breaks are kept.
        width: Width of the lines [characters].
    """
    lines = []
    for paragraph in text.split("\n"):
        lines += _folded(paragraph, width)
    return lines


def _folded(text: str, width: int) -> list[str]:
    """Break one paragraph into lines."""
    if cell_len(text) <= width:
        return [text]

    # Spaces are better places than the separators within a name. Numbers keep their units.
    words = WORD.findall(text)
    parts: list[str] = []
    for word in words:
        if cell_len(word.rstrip()) <= width:
            parts.append(word)
            continue
        for part in FOLDED_PART.findall(word):
            parts += [part] if cell_len(part) <= width else chop_cells(part, width)

    lines = [""]
    for part in parts:
        if lines[-1] and cell_len(f"{lines[-1]}{part}".rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return [line.rstrip() for line in lines]


def _heading(table: SummaryTable, k: int) -> str:
    """Heading of a column, behind the trajectory to which it belongs."""
    heading = str(table.columns[k].heading)
    for group in table.groups:
        if group.first <= k <= group.last:
            return f"{shown_word(group.trajectory)} {heading}"
    return heading


def _has_units(table: SummaryTable, k: int, column: Column) -> bool:
    """Whether the names in a column have units."""
    cells = [row.cells[k] for row in table.rows]
    return column.left and any(isinstance(cell, Name) and cell.unit for cell in cells)


def _texts(cell: Cell, *, has_unit: bool) -> list[str]:
    """A cell as text, and its unit where there is a column for it."""
    if not has_unit:
        return [str(cell)]
    return [cell.name, cell.unit] if isinstance(cell, Name) else [str(cell), ""]


def _padded(text: str, width: int, *, left: bool) -> str:
    """A text with spaces behind it, or before it."""
    spaces = " " * (width - cell_len(text))
    return f"{text}{spaces}" if left else f"{spaces}{text}"
