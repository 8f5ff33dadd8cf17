"""The summary of a selection: the table, what is not told apart, and the tables to keep."""

from __future__ import annotations

from mjfim.output.summaries.selection import describe_selection
from mjfim.output.summary_parts import Paragraph
from mjfim.records.selection import (
    AlternativeTerm,
    Decision,
    SelectedTerm,
    Selection,
    SelectionStep,
)

FRICTION = SelectedTerm(
    name="slide_frictionloss",
    description="dry friction of slide",
    path="joint/slide:frictionloss",
    unit="N",
    scale=0.5,
)
BEGUN = SelectionStep(decision=Decision.BEGUN, error=2.0)


def texts_of(selection: Selection) -> str:
    """All paragraphs of the summary."""
    parts = describe_selection(selection)
    return "\n".join(part.text for part in parts if isinstance(part, Paragraph))


def test_alternatives_of_a_removed_term_are_not_named() -> None:
    other = AlternativeTerm(description="a spring", path="joint/slide:stiffness", values={"m": 2.0})
    added = SelectionStep(
        decision=Decision.ADDED,
        description=FRICTION.description,
        path=FRICTION.path,
        count=1,
        error=1.0,
        alternatives=(other,),
    )
    steps = (BEGUN, added)
    kept = Selection(terms=(FRICTION,), steps=steps, ending="No further term.")
    assert "do not tell dry friction of slide apart from a spring" in texts_of(kept)
    removed = Selection(terms=(), steps=steps, ending="No further term.")
    assert "do not tell" not in texts_of(removed)
