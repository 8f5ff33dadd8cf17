"""Pages as Markdown, for the text panel of the viewer."""

from __future__ import annotations

import re
from collections.abc import Iterable

from mjfim.output.page import Emphasis, Listing, Page, Table, Text

# Characters that Markdown would take for its own marks; an underscore only at the edge of a word.
MARKS = re.compile(r"[\\|*`<>\[\]~]|(?<!\w)_|_(?!\w)")


def as_markdown(page: Page, *further: str) -> str:
    """Write a page: verdict, first part, warnings, then all other parts, and further sentences."""
    parts = [_rendered(part) for part in page.parts]
    if page.warnings:
        parts[1:1] = ["**Warnings**", _list(page.warnings)]
    texts = (f"### {escape(page.kind)}", f"**{escape(page.verdict.text)}**", *parts, *further)
    return "\n\n".join(text for text in texts if text)


def escape(text: str) -> str:
    """Return a text on one line, without a character that Markdown takes for a mark."""
    return MARKS.sub(lambda mark: f"\\{mark[0]}", " ".join(text.split()))


def _list(sentences: Iterable[str]) -> str:
    return "\n".join(f"- {escape(sentence)}" for sentence in sentences)


def _rendered(part: Table | Text | Listing) -> str:
    """One part of a page."""
    if isinstance(part, Text):
        text = escape(part.text)
        return f"**{text}**" if part.emphasis is Emphasis.STRONG else text
    title = f"**{escape(part.title)}**" if part.title else ""
    if isinstance(part, Table):
        rules = [":--" if part.is_left(k) else "--:" for k in range(len(part.columns))]
        rows = [part.columns, *(row.cells for row in part.rows)]
        lines = [f"| {' | '.join(escape(cell) for cell in cells)} |" for cells in rows]
        lines.insert(1, f"| {' | '.join(rules)} |")
        blocks = ["\n".join(lines), escape(part.note)]
    elif part.code:
        blocks = [f"```toml\n{item}\n```" for item in part.items]
    else:
        blocks = [_list(part.items)]
    return "\n\n".join(block for block in (title, *blocks) if block)
