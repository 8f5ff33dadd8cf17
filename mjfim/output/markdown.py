"""Tables of results as Markdown, for the text panel of the viewer."""

from __future__ import annotations

import re
from collections.abc import Iterable

from mjfim.output.summary_parts import Cell, Column, SummaryTable
from mjfim.output.vocabulary import shown_word

# Characters that Markdown would take for its own marks; an underscore only at the edge of a word.
MARKS = re.compile(r"[\\|*`<>\[\]~]|(?<!\w)_|_(?!\w)")


def render_table(table: SummaryTable, *, details_last: bool = False) -> str:
    """Render a table; Markdown has no headings above several columns, so each column names them.

    Args:
        table: The table.
        details_last: True to move the columns that a short form leaves out to the right.
    """
    shown = list(range(len(table.columns)))
    if details_last:
        shown.sort(key=lambda i: table.columns[i].detail)
    headings = [_heading(table, i, table.columns[i]) for i in shown]
    rules = [":--" if table.columns[i].left else "--:" for i in shown]
    rows = [[_text(row.cells[i]) for i in shown] for row in table.rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rules, *rows))


def render_list(sentences: Iterable[str]) -> str:
    """Render sentences as a list.

    Args:
        sentences: The sentences.
    """
    return "\n".join(f"- {escape(sentence)}" for sentence in sentences)


def escape(text: str) -> str:
    """Return a text on one line, without a character that Markdown takes for a mark.

    Args:
        text: The text.
    """
    return MARKS.sub(lambda mark: f"\\{mark[0]}", " ".join(text.split()))


def _heading(table: SummaryTable, index: int, column: Column) -> str:
    """Return the heading of a column behind that of its group."""
    heading = _text(column.heading)
    for group in table.groups:
        if group.first <= index <= group.last:
            return f"{escape(shown_word(group.trajectory))}: {heading}"
    return heading


def _text(cell: Cell) -> str:
    """Return the text of a cell."""
    return escape(str(cell))
