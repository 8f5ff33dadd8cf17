"""Summaries of designs and estimates as Markdown, for the text panel of Rerun recordings."""

from __future__ import annotations

import re
from collections.abc import Iterable

from mjfim.output import vocabulary
from mjfim.output.page import Emphasis, Listing, Page, Table, Text
from mjfim.output.pages import page_of
from mjfim.output.vocabulary import Term
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate

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


def _colours(*meanings: tuple[Term, str]) -> str:
    """Return a sentence for each colour."""
    return " ".join(f"{term.colour_name.capitalize()}: {meaning}." for term, meaning in meanings)


# Sentences that explain the colours of the recordings.
DESIGN_COLOURS = (
    _colours(
        (vocabulary.INITIAL, "the initial trajectory"),
        (vocabulary.DESIGNED, "the designed trajectory"),
    )
    + " Grey lines: limits. Space bar: play or pause. The timeline `iteration` shows the search: "
    "its iterates in place of the designed trajectory. The plots of ψ show sensitivities: how much "
    "a position (→) and its velocity (↑) change per unit of a parameter."
)
ESTIMATE_COLOURS = (
    _colours(
        (vocabulary.IDENTIFIED, "the identified model"),
        (vocabulary.MEASURED, "the measurements"),
        (vocabulary.NOMINAL, "the nominal model, for data that were not fitted"),
    )
    + " Grey lines: twice the standard deviation of the noise."
)


def design_text(design: Design, addition: str = "") -> str:
    """Render a design as Markdown.

    Args:
        design: The design.
        addition: A paragraph below it; may be empty.
    """
    return as_markdown(page_of(design), DESIGN_COLOURS, addition)


def estimate_text(estimate: Estimate, addition: str = "") -> str:
    """Render an estimate as Markdown.

    Args:
        estimate: The estimate.
        addition: A paragraph below it; may be empty.
    """
    return as_markdown(page_of(estimate), ESTIMATE_COLOURS, addition)
