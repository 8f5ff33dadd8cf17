"""The selection of terms in words and a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import tomlkit

from mjfim.errors import listed
from mjfim.output.page import Emphasis, Listing, Part, Plot, Row, Table, Text, number
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


def selection_parts(selection: Selection) -> Sequence[Part]:
    """Which terms were added, the steps that led to them, and what they depend on."""
    parts: list[Part] = [Text(str(selection)), _table(selection)]
    kept = {term.path for term in selection.terms}
    parts += [
        Text(_about_alternatives(step), Emphasis.WARNING)
        for step in selection.steps
        if step.alternatives and step.path in kept
    ]
    if selection.refit is not None:
        parts.append(_about_refit(selection.refit))
    tables = tuple(_tables_to_keep(selection))
    if tables:
        title = "To keep this model, put these tables into the experiment file"
        parts.append(Listing(title, tables, Emphasis.WEAK, code=True))
    return (*parts, Plot("selection"))


def _about_refit(refit: HeldOutRefit) -> Text:
    """Say whether the held-out recordings alone give the same parameters."""
    text = (
        "The held-out recordings took no part in the selection. Fitted to them alone, the selected "
        "model has "
    )
    if not refit.differs:
        return Text(text + "the same parameters within the intervals.")
    text += (
        f"other values of {listed(refit.differs)}, by more than both intervals explain; the "
        "intervals are widened to hold both."
    )
    return Text(text, Emphasis.WARNING)


def _about_alternatives(step: SelectionStep) -> str:
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


def _table(selection: Selection) -> Table:
    """Tabulate the steps."""
    return Table(
        title="Terms that were tried: error of data that were left out of the fit",
        columns=("term", "decision", "terms", "error [σ]", "reduction [σ²]", "± standard error"),
        rows=tuple(_row(step) for step in selection.steps),
        spare=("terms",),
    )


def _row(step: SelectionStep) -> Row:
    is_begin = step.decision in (Decision.BEGUN, Decision.SHORTENED)
    is_compared = not is_begin and step.decision is not Decision.UNHELPFUL
    is_change = step.is_kept and not is_begin
    is_other = step.decision is Decision.REJECTED and step.reduction > step.standard_error
    return Row(
        (
            step.description or "as stated",
            "another is better" if is_other else WORDS[step.decision],
            str(step.count),
            number(step.error, 4),
            number(step.reduction, 2) if is_compared else "",
            number(step.standard_error, 2) if is_compared else "",
        ),
        Emphasis.STRONG if is_change else Emphasis.NORMAL,
    )


# ---- tables of the experiment file


def _tables_to_keep(selection: Selection) -> Iterator[str]:
    """Yield the tables of the experiment file that state the selected model, as TOML."""
    for name, table in selection.library_terms.items():
        yield _as_toml(table, "terms", name)
    for name, table in selection.parameters.items():
        yield _as_toml(table, "parameters", name)
    for pool in selection.pooled:
        members = listed([f"[parameters.{member}]" for member in pool.members])
        yield _as_toml(pool.table, "parameters", pool.name, remark=f"in place of {members}")
    if selection.fit_table:
        yield _as_toml(selection.fit_table, "fit", remark="beside the other keys of this table")


def _as_toml(table: Mapping[str, object], *name: str, remark: str = "") -> str:
    """Write a table of an experiment file, with a line for each key."""
    written = tomlkit.table()
    if remark:
        written.add(tomlkit.comment(remark))
    for key, value in table.items():
        written.add(key, _value(value))
    for part in reversed(name[1:]):
        outer = tomlkit.table(is_super_table=True)
        outer.add(part, written)
        written = outer
    return tomlkit.dumps({name[0]: written}).strip()


def _value(value: object) -> Any:
    """A value; tables in it are written in one line, and lists of them with a line for each."""
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        inline.update({key: _value(each) for key, each in value.items()})
        return inline
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        array = tomlkit.array()
        array.extend(_value(entry) for entry in value)
        return array.multiline(True)
    return value
