"""Summaries of results as HTML, for notebooks.

The HTML is plain: tables, lists and paragraphs. It states no colours of text or background, so that
it can be read in light and in dark themes. All names and sentences are escaped, because they may
come from files of others.
"""

from __future__ import annotations

import re
from html import escape as escape_characters

from mjfim.output.summary_parts import (
    Column,
    Emphasis,
    Listing,
    Paragraph,
    Part,
    Row,
    Summary,
    SummaryTable,
    capitalised,
)

# Style of every emphasis.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "font-weight: bold",
    Emphasis.WEAK: "opacity: 0.7",
    Emphasis.WARNING: "border-left: 0.25em solid #cc8800; padding-left: 0.5em",
    Emphasis.STRONG_WARNING: (
        "border-left: 0.25em solid #cc8800; padding-left: 0.5em; font-weight: bold"
    ),
    Emphasis.DERIVED: "font-style: italic",
}


# Names of commands, keys and files in sentences.
CODE = re.compile(r"`([^`\n]+)`")


def escape(text: str) -> str:
    """Return a text as HTML; words in backquotes are code."""
    return CODE.sub(r"<code>\1</code>", escape_characters(text))


def render(summary: Summary) -> str:
    """Render a summary: title, outcome and warnings first, then its parts.

    Details can be unfolded.

    Args:
        summary: The summary.
    """
    elements = []
    if summary.title:
        elements.append(_element("p", escape(summary.title), "font-weight: bold"))
    if summary.outcome:
        elements.append(_element("p", escape(capitalised(summary.outcome))))

    warning_style = STYLES[Emphasis.WARNING]
    elements += [
        _element("p", f"Warning: {escape(warning)}", warning_style) for warning in summary.warnings
    ]
    elements += [_folded(part) for part in summary.parts]
    body = "\n".join(elements)
    return f"<div>\n{body}\n</div>"


def _folded(part: Part) -> str:
    """Render a part; a table that a short form leaves out is folded."""
    if isinstance(part, SummaryTable) and part.detail:
        heading = f"<summary>{escape(part.title)}</summary>"
        return f"<details>{heading}\n{_table(part, title='')}\n</details>"
    return _rendered(part)


def _rendered(part: Part) -> str:
    """Render one part of a summary."""
    if isinstance(part, SummaryTable):
        return _table(part, title=part.title)
    if isinstance(part, Paragraph):
        return _element("p", escape(part.text), STYLES[part.emphasis])
    return _listing(part)


def _listing(listing: Listing) -> str:
    """Render sentences under a heading."""
    heading = _element("p", escape(listing.title), "font-weight: bold")
    if listing.code:
        blocks = [_element("pre", escape(item)) for item in listing.items]
        return "\n".join([heading, *blocks])

    items = [_element("li", _lines(item)) for item in listing.items]
    return f"{heading}\n{_element('ul', ''.join(items), STYLES[listing.emphasis])}"


def _lines(text: str) -> str:
    """Escape a text, and keep its line breaks; the list itself has the bullets."""
    return "<br/>".join(escape(line) for line in text.removeprefix("• ").split("\n"))


def _table(table: SummaryTable, *, title: str) -> str:
    """Render a table with its title and its note."""
    caption_style = "caption-side: top; text-align: left; font-weight: bold"
    caption = _element("caption", escape(title), caption_style) if title else ""

    headings = [_cell("th", str(column.heading), column, "") for column in table.columns]
    rows = [_row(row, table.columns) for row in table.rows]
    head = f"<thead><tr>{''.join(headings)}</tr></thead>"
    body = f"<tbody>{''.join(rows)}</tbody>"
    note = _element("p", escape(table.note), STYLES[Emphasis.WEAK]) if table.note else ""
    return f"<table>{caption}{head}{body}</table>{note}"


def _row(row: Row, columns: tuple[Column, ...]) -> str:
    """Render a row of a table; the first cell carries the mark of a warning."""
    marked = STYLES[row.emphasis] if row.emphasis is not Emphasis.NORMAL else ""
    is_warning = row.emphasis in (Emphasis.WARNING, Emphasis.STRONG_WARNING)
    cells = [
        _cell("td", str(cell), column, "" if is_warning and i else marked)
        for i, (cell, column) in enumerate(zip(row.cells, columns, strict=True))
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _cell(tag: str, text: str, column: Column, style: str) -> str:
    """Render a cell: text to the left, numbers to the right."""
    alignment = f"text-align: {'left' if column.left else 'right'}"
    return _element(tag, escape(text), f"{alignment}; {style}" if style else alignment)


def _element(tag: str, content: str, style: str = "") -> str:
    """Return an element whose content is HTML already."""
    attribute = f' style="{style}"' if style else ""
    return f"<{tag}{attribute}>{content}</{tag}>"
