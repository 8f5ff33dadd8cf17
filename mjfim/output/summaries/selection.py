"""The selection of terms in words and a table."""

from __future__ import annotations

from collections.abc import Iterator

from mjfim.errors import listed
from mjfim.output.experiment_tables import table_text
from mjfim.output.summary_parts import (
    Emphasis,
    Listing,
    Paragraph,
    Part,
    Quantity,
    Row,
    SummaryTable,
    columns,
)
from mjfim.records.terms import Decision, HeldOutRefit, Selection, SelectionStep

# What each decision is called in the table.
WORDS = {
    Decision.BEGUN: "stated model",
    Decision.ADDED: "added",
    Decision.REJECTED: "not better",
    Decision.UNHELPFUL: "no better fit",
    Decision.REMOVED: "not needed",
    Decision.POOLED: "pooled",
    Decision.HELD: "held at the guess",
    Decision.KEPT: "kept apart",
    Decision.SHORTENED: "predicted over segments",
}


def describe_selection(selection: Selection) -> list[Part]:
    """Describe which terms were added, the steps that led to them, and what they depend on.

    Args:
        selection: The selection.
    """
    parts: list[Part] = [Paragraph(text=str(selection)), _table(selection)]
    kept = {term.path for term in selection.terms}
    for step in selection.steps:
        if step.alternatives and step.path in kept:
            text = _describe_alternatives(step)
            parts.append(Paragraph(text=text, emphasis=Emphasis.WARNING))
    if selection.refit is not None:
        parts.append(_describe_refit(selection.refit))
    tables = tuple(_tables_to_keep(selection))
    if tables:
        title = "To keep this model, put these tables into the experiment file"
        parts.append(Listing(title=title, items=tables, emphasis=Emphasis.WEAK, code=True))
    return parts


def _tables_to_keep(selection: Selection) -> Iterator[str]:
    """Yield the tables of the experiment file that state the selected model, as TOML."""
    for name, table in selection.library_terms.items():
        yield table_text(("terms", name), table)
    for name, table in selection.parameters.items():
        yield table_text(("parameters", name), table)

    for pool in selection.pooled:
        members = listed([f"[parameters.{member}]" for member in pool.members])
        yield table_text(("parameters", pool.name), pool.table, f"in place of {members}")
    if selection.fit_table:
        yield table_text(("fit",), selection.fit_table, "beside the other keys of this table")


def _describe_refit(refit: HeldOutRefit) -> Paragraph:
    """Say whether the held-out recordings alone give the same parameters."""
    text = (
        "The held-out recordings took no part in the selection. Fitted to them alone, the selected "
        "model has "
    )
    if not refit.differs:
        return Paragraph(text=text + "the same parameters within the intervals.")
    text += (
        f"other values of {listed(refit.differs)}, by more than both intervals explain; the "
        "intervals are widened to hold both."
    )
    return Paragraph(text=text, emphasis=Emphasis.WARNING)


def _describe_alternatives(step: SelectionStep) -> str:
    """Say which terms the data do not tell apart, and what the parameters would be with each."""
    names = listed([alternative.description for alternative in step.alternatives])
    text = (
        f"The recordings do not tell {step.description} apart from {names}: "
        "the prediction is as good with either."
    )
    for alternative in step.alternatives:
        values = listed([f"{name} = {value:.4g}" for name, value in alternative.values.items()])
        text += f" With {alternative.description}, {values}."
    return text


def _table(selection: Selection) -> SummaryTable:
    """Tabulate the steps."""
    return SummaryTable(
        key="selection",
        title="Terms that were tried: error of data that were left out of the fit",
        columns=columns(
            "term",
            "decision",
            "terms",
            "error [σ]",
            "reduction [σ²]",
            "± standard error",
            left=["decision"],
            details=["terms"],
        ),
        rows=tuple(_row(step) for step in selection.steps),
    )


def _row(step: SelectionStep) -> Row:
    """Row of a step."""
    is_begin = step.decision in (Decision.BEGUN, Decision.SHORTENED)
    is_compared = not is_begin and step.decision is not Decision.UNHELPFUL
    reduction = "" if not is_compared else Quantity(value=step.reduction, digits=2)
    error = "" if not is_compared else Quantity(value=step.standard_error, digits=2)
    is_change = step.is_kept and not is_begin
    is_other = step.decision is Decision.REJECTED and step.reduction > step.standard_error
    return Row(
        cells=(
            step.description or "as stated",
            "another is better" if is_other else WORDS[step.decision],
            str(step.count),
            Quantity(value=step.error, digits=4),
            reduction,
            error,
        ),
        emphasis=Emphasis.STRONG if is_change else Emphasis.NORMAL,
    )
