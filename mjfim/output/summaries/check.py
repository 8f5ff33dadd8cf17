"""A check of an experiment in words and tables."""

from __future__ import annotations

import numpy as np

from mjfim.output.summaries.accuracy import BEST_CASE, NOT_ALONE, relative, size_sentence
from mjfim.output.summary_parts import (
    Emphasis,
    Listing,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.check import Check, ParameterCheck, ParameterGroup

# Largest number of eigenvalues that a sentence lists; of more, the smallest four and the largest
# two are listed.
MAX_LISTED_EIGENVALUES = 8


def describe_check(check: Check) -> Summary:
    """Describe the verdict, predicted standard deviations, and inseparable parameters.

    Args:
        check: The check.
    """
    parts: list[Part] = []
    if len(check.verdict) > 1:
        emphasis = Emphasis.NORMAL if check.ok else Emphasis.WARNING
        sentences = tuple(f"• {sentence}" for sentence in check.verdict[1:])
        parts.append(Listing(title="Further findings", items=sentences, emphasis=emphasis))
    parts.append(_check_table(check))

    for title, groups in (
        (
            "Identifiable only in combination, with this control and with random ones",
            check.not_separable,
        ),
        ("Not excited by this control, but by another one", check.not_excited),
    ):
        if groups:
            items = tuple(_group_lines(group, check) for group in groups)
            parts.append(Listing(title=f"{title}:", items=items, emphasis=Emphasis.DERIVED))

    of_size = size_sentence([row.value for row in check.rows], [row.size for row in check.rows])
    if of_size:
        parts.append(Paragraph(text=of_size, emphasis=Emphasis.WEAK))
    parts.append(Paragraph(text=BEST_CASE, emphasis=Emphasis.WEAK))
    parts.append(Paragraph(text=_eigenvalue_sentence(check), detail=True))
    parts.append(Paragraph(text=_self_test_sentence(check), detail=True))
    return Summary(
        title=f"Check of {check.source}",
        outcome=check.verdict[0] if check.verdict else "",
        parts=tuple(parts),
    )


def _check_table(check: Check) -> SummaryTable:
    """Tabulate predicted and wanted standard deviations, and the repetitions that reach them."""
    return SummaryTable(
        key="accuracy",
        title=f"Accuracy that {check.source} ({check.horizon:g} s) can give",
        columns=columns(
            "parameter",
            "value",
            "σ",
            "relative σ",
            "wanted σ",
            "repetitions",
            "time",
            details=["time"],
            optional=["value", "wanted σ"],
        ),
        rows=tuple(_check_row(row) for row in check.rows),
    )


def _check_row(row: ParameterCheck) -> Row:
    """Return the row of one parameter."""
    name = Name(name=row.name, unit=row.unit)
    value = Quantity(value=row.value, digits=4)
    if row.nuisance:
        return Row(cells=(name, value, "nuisance", "", "", "", ""), emphasis=Emphasis.WEAK)

    alone = bool(np.isfinite(row.std))
    cells = (
        name,
        value,
        Quantity(value=row.std, infinite=NOT_ALONE),
        relative(row.std, row.size),
        f"{row.wanted:.3g}{'' if row.stated else ' (5 %)'}",
        f"{row.repetitions:,}" if row.repetitions else "-",
        f"{row.seconds:,.0f} s" if row.repetitions else "-",
    )
    return Row(cells=cells, emphasis=Emphasis.NORMAL if alone else Emphasis.WARNING)


def _group_lines(group: ParameterGroup, check: Check) -> str:
    """Return the members of a group, and a line per combination with its value and its σ."""
    if not group.combinations:
        return str(group)

    accuracy_of = {c.expression: f" = {c.value:.4g} ± {c.std_final:.2g}" for c in check.combined}
    members = ", ".join(group.members)
    lines = [
        f"  {combination}{accuracy_of.get(str(combination), '')}"
        for combination in group.combinations
    ]
    return "\n".join([f"{members} only as", *lines])


def _eigenvalue_sentence(check: Check) -> str:
    """Return the eigenvalues of the information, of many the smallest and the largest ones."""
    values, selection = check.eigenvalues, ""
    if len(values) > MAX_LISTED_EIGENVALUES:
        values = np.concatenate([values[:4], values[-2:]])
        selection = " (smallest four, largest two)"
    listed = ", ".join(f"{value:.3g}" for value in values)
    return f"eigenvalues{selection}: {listed}; condition {check.condition:.3g}"


def _self_test_sentence(check: Check) -> str:
    """Return the result of the derivative self-test."""
    test = check.self_test
    if not test.finished:
        return "derivative self-test not finished, because the check was interrupted"

    passed = "passed" if test.passed else "FAILED"
    agreement = "agree" if test.roughness is None else "disagree"
    return (
        f"derivative self-test {passed}: relative error of psi {test.recursion:.1e}, of the slope "
        f"{test.slope:.1e}; two step sizes {agreement}"
    )
