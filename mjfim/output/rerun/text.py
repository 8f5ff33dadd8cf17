"""Summaries of designs and estimates as Markdown, for the text panel of Rerun recordings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from mjfim.output import vocabulary
from mjfim.output.summaries.design import describe_design
from mjfim.output.summaries.estimate import describe_estimate
from mjfim.output.summary_parts import Emphasis, Listing, Part, Summary, SummaryTable, capitalised
from mjfim.output.vocabulary import Term
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate


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


def design_text(design: Design, units: Sequence[str], addition: str = "") -> str:
    """Render a design as Markdown.

    Args:
        design: The design.
        units: Unit of each of the p parameters.
        addition: Markdown to append.
    """
    return render(describe_design(design, units), DESIGN_COLOURS, addition)


def estimate_text(estimate: Estimate, addition: str = "") -> str:
    """Render an estimate as Markdown.

    Args:
        estimate: The estimate.
        addition: Markdown to append.
    """
    return render(describe_estimate(estimate), ESTIMATE_COLOURS, addition)


def render(summary: Summary, legend: str = "", addition: str = "") -> str:
    """Render a summary as Markdown: outcome and warnings first, then tables and sentences.

    Args:
        summary: The summary.
        legend: Sentences that explain the colours of the recording.
        addition: Markdown to append.
    """
    paragraphs = [f"## {summary.title}", f"**{capitalised(summary.outcome)}**", legend]
    if summary.warnings:
        paragraphs += ["#### Warnings", _bullets(summary.warnings)]
    paragraphs += [_rendered(part) for part in summary.parts]
    return "\n\n".join(paragraph for paragraph in (*paragraphs, addition) if paragraph)


def _rendered(part: Part) -> str:
    """Render one part of a summary."""
    if isinstance(part, SummaryTable):
        title = f"#### {part.title}\n\n" if part.title else ""
        note = f"\n\n{part.note}" if part.note else ""
        header = [str(column.heading) for column in part.columns]
        rows = [[str(cell) for cell in row.cells] for row in part.rows]
        return f"{title}{_table(header, rows)}{note}"
    if isinstance(part, Listing):
        return f"**{part.title}**\n\n{_bullets(part.items)}"
    if part.emphasis in (Emphasis.STRONG, Emphasis.STRONG_WARNING):
        return f"**{part.text}**"
    return part.text


def _bullets(sentences: Iterable[str]) -> str:
    """Return sentences as a Markdown list."""
    return "\n".join(f"- {sentence}" for sentence in sentences)


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    rendered = []
    for cells in lines:
        escaped = " | ".join(cell.replace("|", "\\|") for cell in cells)
        rendered.append(f"| {escaped} |")
    return "\n".join(rendered)
