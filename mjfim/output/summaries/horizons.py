"""Fits over segments of several lengths, in words and a table."""

from __future__ import annotations

from mjfim.output.summary_parts import (
    Emphasis,
    Paragraph,
    Part,
    Quantity,
    Row,
    SummaryTable,
    columns,
)
from mjfim.records.estimate import HorizonStudy


def describe_horizons(study: HorizonStudy) -> list[Part]:
    """Describe which length of segments was chosen, and which estimates depend on it.

    Args:
        study: The comparison.
    """
    parts: list[Part] = [Paragraph(text=f"{study.about_choice} {study.about_growth}")]
    cautions = study.findings if study.is_used else (study.about_use, *study.findings)
    parts += [Paragraph(text=text, emphasis=Emphasis.WARNING) for text in cautions]
    return [*parts, _table(study)]


def _mark(study: HorizonStudy) -> str:
    """Return the mark of the chosen length."""
    return " (chosen)" if study.is_used else " (chosen, but not used)"


def _table(study: HorizonStudy) -> SummaryTable:
    """Tabulate the errors of each fit over each horizon."""
    horizons = [f"over {length:.2g} s" for length in study.lengths]
    rows = []
    for i, errors in enumerate(study.errors):
        mark = _mark(study) if i == study.chosen else ""
        cells = [Quantity(value=float(error), digits=3) for error in errors]
        rows.append(Row(cells=(study.name_of(i) + mark, *cells)))
    return SummaryTable(
        key="horizons",
        title="Error of data that were left out of the fit [σ], by the time that is predicted",
        columns=columns("fit over", *horizons),
        rows=tuple(rows),
        detail=True,
    )
