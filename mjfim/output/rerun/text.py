"""Summaries of designs and estimates as Markdown, for the text panel of Rerun recordings."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.output import vocabulary
from mjfim.output.markdown import escape, render_list, render_table
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
    """Render a summary as Markdown: outcome, first table, warnings, then all other parts.

    The panel of the viewer is narrow: columns with details are on the right of a table, which can
    be scrolled, and the colours come last.

    Args:
        summary: The summary.
        legend: Sentences that explain the colours of the recording, in Markdown.
        addition: Markdown to append.
    """
    paragraphs = [
        f"### {escape(summary.title)}",
        f"**{escape(capitalised(summary.outcome))}**",
    ]
    parts = [_rendered(part) for part in summary.parts]
    if summary.warnings:
        parts[1:1] = ["**Warnings**", render_list(summary.warnings)]
    paragraphs += parts
    return "\n\n".join(text for text in (*paragraphs, legend, addition) if text)


def _rendered(part: Part) -> str:
    """Render one part of a summary."""
    if isinstance(part, SummaryTable):
        title = f"**{escape(part.title)}**\n\n" if part.title else ""
        note = f"\n\n{escape(part.note)}" if part.note else ""
        return f"{title}{render_table(part, details_last=True)}{note}"
    if isinstance(part, Listing) and part.code:
        blocks = [f"```toml\n{item}\n```" for item in part.items]
        return "\n\n".join([f"**{escape(part.title)}**", *blocks])
    if isinstance(part, Listing):
        return f"**{escape(part.title)}**\n\n{render_list(part.items)}"
    if part.emphasis in (Emphasis.STRONG, Emphasis.STRONG_WARNING):
        return f"**{escape(part.text)}**"
    return escape(part.text)
