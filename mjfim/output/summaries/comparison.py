"""A comparison of methods in words and tables."""

from __future__ import annotations

from pathlib import PurePath

import numpy as np

from mjfim.output.summaries.accuracy import BEST_CASE
from mjfim.output.summary_parts import (
    Cell,
    Emphasis,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.comparison import DESIGN, Comparison, MethodResult

# Relative difference above which a factor is easier to read than percent.
LARGE_DIFFERENCE = 10.0


def describe_comparison(comparison: Comparison) -> Summary:
    """Describe the result of each method with equal budgets, and which is the best.

    Methods are in the order in which they ran.

    Args:
        comparison: The comparison.
    """
    parts: list[Part] = [Paragraph(text=sentence) for sentence in comparison.verdict[1:]]
    parts.append(_method_table(comparison))

    for row in comparison.rows:
        remarks = [] if row.sound else [row.outcome.value]
        remarks += [row.note] if row.note else []
        if remarks:
            parts.append(Paragraph(text=f"{row.title}: {'; '.join(remarks)}"))

    legend = (
        "worst σ: standard deviation of the worst combination of parameters, relative to their "
        "scales; worst margin: smallest margin of all limits, in percent of half of the range."
    )
    parts.append(Paragraph(text=f"{legend} {BEST_CASE}", emphasis=Emphasis.WEAK))
    parts.append(_method_accuracy_table(comparison))
    return Summary(
        title=f"{PurePath(comparison.source).name}: each method with {budget_in_words(comparison)}",
        outcome=comparison.verdict[0],
        parts=tuple(parts),
    )


def budget_in_words(comparison: Comparison) -> str:
    """Return the time that each method had.

    Args:
        comparison: The comparison.
    """
    return f"{comparison.seconds:g} s"


def _method_table(comparison: Comparison) -> SummaryTable:
    """Tabulate cost, criterion, worst standard deviation, effort and margin of each method."""
    headings = ["method"]
    if comparison.weighted:
        headings.append("J")
    headings += [f"φ ({comparison.criterion})", "J against design", "worst σ"]
    headings += ["time", "steps", "worst margin"]
    return SummaryTable(
        key="methods",
        title=f"{PurePath(comparison.source).name}: each method with {budget_in_words(comparison)}",
        columns=columns(*headings, details=["time", "steps"]),
        rows=tuple(
            Row(cells=_method_cells(comparison, row), emphasis=_method_emphasis(comparison, row))
            for row in comparison.rows
        ),
    )


def _method_cells(comparison: Comparison, row: MethodResult) -> tuple[Cell, ...]:
    """Return the cells of one method."""
    design, (kind, relative_margin) = comparison.design, row.tightest

    against_design = ""
    if design is not None and row is not design and not np.isnan(row.cost):
        against_design = _difference(-comparison.gain(row, design))
    margin = "-"
    if kind and np.isfinite(relative_margin):
        margin = f"{100.0 * relative_margin:.2g} % {kind.replace('_', ' ')}"

    costs = [Quantity(value=row.criterion, digits=4)]
    if comparison.weighted:
        costs.insert(0, Quantity(value=row.cost, digits=4))
    return (
        _method_title(comparison, row),
        *costs,
        against_design,
        Quantity(value=row.worst_relative_std),
        f"{row.seconds:.1f} s",
        f"{row.steps / 1e6:.2f} M",
        margin,
    )


def _difference(share: float) -> str:
    """Return by how much a cost is larger, in percent or, where it is far larger, as a factor."""
    return f"× {1.0 + share:.3g}" if share >= LARGE_DIFFERENCE else f"{100.0 * share:+.3g} %"


def _method_accuracy_table(comparison: Comparison) -> SummaryTable:
    """Tabulate the standard deviation of every parameter with every method."""
    rows = []
    for j in comparison.wanted:
        name = Name(name=comparison.parameters[j], unit=comparison.units[j])
        cells = [Quantity(value=float(row.std[j])) for row in comparison.rows]
        rows.append(Row(cells=(name, *cells)))

    return SummaryTable(
        key="accuracy",
        title="σ of each parameter",
        columns=columns("parameter", *(row.title for row in comparison.rows)),
        rows=tuple(rows),
        detail=True,
    )


def _method_title(comparison: Comparison, row: MethodResult) -> str:
    """Return a method's title; the best method has an arrow."""
    return ("▶ " if row is comparison.best else "  ") + row.title


def _method_emphasis(comparison: Comparison, row: MethodResult) -> Emphasis:
    """Return the emphasis of a method.

    It is strong for the design, a warning for better methods, and weak for unusable results.
    """
    if not row.sound:
        return Emphasis.WEAK
    if row.method == DESIGN:
        return Emphasis.STRONG
    return Emphasis.WARNING if row in comparison.beating else Emphasis.NORMAL
