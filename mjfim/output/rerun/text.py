"""Summaries of designs and estimates as Markdown, for the text panel of Rerun recordings."""

from __future__ import annotations

from mjfim.output import vocabulary
from mjfim.output.markdown import as_markdown
from mjfim.output.pages import page_of
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
