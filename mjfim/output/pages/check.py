"""The page of a check."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.output.page import (
    Emphasis,
    Level,
    Listing,
    Page,
    Part,
    Plot,
    Row,
    Section,
    Table,
    Text,
    Verdict,
    as_sentence,
    named,
    number,
)
from mjfim.output.pages.accuracy import BEST_CASE, NOT_ALONE, relative, size_sentence
from mjfim.records.check import Check, ParameterCheck, ParameterGroup

# Number of eigenvalues of which a sentence lists only the smallest four and the largest two.
MAX_LISTED_EIGENVALUES = 8


def check_page(check: Check) -> Page:
    """Describe predicted standard deviations, and inseparable parameters."""
    sections = [Section("Accuracy", list(_accuracy_parts(check)))]
    if check.violations:
        title = "The motion of the initial control violates limits; a design looks for one inside:"
        items = tuple(str(violation) for violation in check.violations)
        sections.append(Section("Limits", [Listing(title, items, detail=True)]))
    return Page(
        kind="Check of an experiment",
        verdict=_verdict(check),
        next_steps=tuple(_next_steps(check)),
        warnings=() if check.ok else tuple(as_sentence(each) for each in check.verdict[1:]),
        facts={
            "checked": check.source,
            "duration": f"{check.horizon:g} s",
            "parameters": str(len(check.rows)),
            "condition of the information": number(check.condition),
        },
        sections=sections,
    )


def _verdict(check: Check) -> Verdict:
    if check.ok:
        shares = {row.name: row.relative for row in check.rows if not row.nuisance}
        worst = max(shares, key=lambda name: shares[name])
        text = (
            f"All parameters can be identified with {check.source}; the least accurate is {worst} "
            f"with a σ of {relative(shares[worst], 1.0)}."
        )
        return Verdict(text, Level.GOOD)
    first = check.verdict[0] if check.verdict else "the check found a fault"
    return Verdict(as_sentence(first), Level.DOUBTFUL)


def _next_steps(check: Check) -> Iterator[str]:
    if check.refused or check.missing:
        return
    if check.not_separable:
        yield (
            "Remove or fix one parameter of each group that is identifiable only in combination, "
            "give it a prior, or measure another output."
        )
        return
    yield (
        "Design a motion that tells more: `mjfim design EXPERIMENT -o FOLDER`. A design that was "
        "made already is checked with `--design`."
    )


def _accuracy_parts(check: Check) -> Iterator[Part]:
    if check.ok:
        yield Listing("Findings", tuple(as_sentence(each) for each in check.verdict))
    yield Table(
        title=f"Accuracy that {check.source} ({check.horizon:g} s) can give",
        columns=("parameter", "value", "σ", "relative σ", "wanted σ", "repetitions", "time"),
        rows=tuple(_row(row) for row in check.rows),
        spare=("value", "wanted σ", "time"),
    )
    yield Plot("check")
    title = "Identifiable only in combination, with this control and with random ones"
    yield from _groups(title, check.not_separable, check)
    yield from _groups("Not excited by this control, but by another one", check.not_excited, check)
    of_size = size_sentence([row.value for row in check.rows], [row.size for row in check.rows])
    if of_size:
        yield Text(of_size, Emphasis.WEAK)
    yield Text(BEST_CASE, Emphasis.WEAK)
    yield Text(_about_eigenvalues(check), detail=True)
    yield Text(_about_self_test(check), detail=True)


def _row(row: ParameterCheck) -> Row:
    """The row of one parameter."""
    name, value = named(row.name, row.unit), number(row.value, 4)
    if row.nuisance:
        return Row((name, value, "nuisance", "", "", "", ""), Emphasis.WEAK)
    cells = (
        name,
        value,
        number(row.std, infinite=NOT_ALONE),
        relative(row.std, row.size),
        f"{row.wanted:.3g}{'' if row.stated else ' (5 %)'}",
        f"{row.repetitions:,}" if row.repetitions else "-",
        f"{row.seconds:,.0f} s" if row.repetitions else "-",
    )
    return Row(cells, Emphasis.NORMAL if np.isfinite(row.std) else Emphasis.WARNING)


def _groups(title: str, groups: tuple[ParameterGroup, ...], check: Check) -> Iterator[Part]:
    """Groups of parameters, with a line per combination, its value and its σ."""
    accuracy = {
        each.expression: f" = {each.value:.4g} ± {each.std_final:.2g}" for each in check.combined
    }
    items = []
    for group in groups:
        lines = [f"  {each}{accuracy.get(str(each), '')}" for each in group.combinations]
        members = f"{', '.join(group.members)} only as"
        items.append("\n".join([members, *lines]) if lines else str(group))
    if items:
        yield Listing(f"{title}:", tuple(items), Emphasis.DERIVED)


def _about_eigenvalues(check: Check) -> str:
    """The eigenvalues of the information, of many the smallest and the largest ones."""
    values, selection = check.eigenvalues, ""
    if len(values) > MAX_LISTED_EIGENVALUES:
        values = np.concatenate([values[:4], values[-2:]])
        selection = " (smallest four, largest two)"
    listed = ", ".join(f"{value:.3g}" for value in values)
    return f"eigenvalues{selection}: {listed}; condition {check.condition:.3g}"


def _about_self_test(check: Check) -> str:
    """The result of the derivative self-test."""
    test = check.self_test
    if not test.finished:
        return "derivative self-test not finished, because the check was interrupted"
    agreement = "agree" if test.roughness is None else "disagree"
    return (
        f"derivative self-test {'passed' if test.passed else 'FAILED'}: relative error of psi "
        f"{test.recursion:.1e}, of the slope {test.slope:.1e}; two step sizes {agreement}"
    )
