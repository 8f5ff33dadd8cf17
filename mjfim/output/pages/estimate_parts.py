"""Studies beside an estimate: lengths of segments, recordings, and drawn robots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import tomlkit

from mjfim.arrays import NORMAL_95
from mjfim.errors import first_ones, listed
from mjfim.identification.assessment.accuracy import POORLY_KNOWN_SHARE
from mjfim.output.page import (
    Emphasis,
    Listing,
    Part,
    Plot,
    Row,
    Table,
    Text,
    named,
    number,
    numbers,
    tabulated,
    warned,
)
from mjfim.records.estimate import Estimate, HorizonStudy, ParameterDraws
from mjfim.records.robots import RecordingComparison, p_text
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


# Largest number of rows of the table with the values of single recordings.
MAX_VALUES = 60


# ---- lengths of segments


def horizon_parts(study: HorizonStudy | None) -> Sequence[Part]:
    """Which length of segments was chosen, and which estimates depend on it."""
    if study is None:
        return ()
    cautions = study.findings if study.is_used else (study.about_use, *study.findings)
    names = [study.name_of(i) for i in range(len(study.errors))]
    names[study.chosen] += " (chosen)" if study.is_used else " (chosen, but not used)"
    errors = {
        f"over {length:.2g} s": numbers(errors)
        for length, errors in zip(study.lengths, np.transpose(study.errors), strict=True)
    }
    title = "Error of data that were left out of the fit [σ], by the time that is predicted"
    table = tabulated(title, {"fit over": names, **errors}, detail=True)
    return (
        Text(f"{study.about_choice} {study.about_growth}"),
        *(Text(caution, Emphasis.WARNING) for caution in cautions),
        table,
        Plot("horizons"),
    )


# ---- recordings


def recording_parts(estimate: Estimate) -> Sequence[Part]:
    """Whether recordings agree, their scatter, and what each of them suggests."""
    comparison = estimate.recording_comparison
    if comparison is None:
        return ()
    # An odd recording is a warning already.
    differs = bool(comparison.odd or comparison.apart)
    emphasis = Emphasis.WARNING if differs else Emphasis.NORMAL
    in_short_form = differs and not comparison.odd
    parts: list[Part] = [Text(str(comparison), emphasis, detail=not in_short_form)]
    if differs and estimate.misfit:
        text = (
            "The model does not explain the recordings: its error acts differently along different "
            "motions, and this alone can make recordings differ."
        )
        parts.append(Text(text, Emphasis.WEAK, detail=True))
    tables = (_scatter_table(comparison), _value_table(comparison))
    return (*parts, *tables, Plot("recordings"))


def _scatter_table(comparison: RecordingComparison) -> Table:
    """Tabulate means over the recordings, and the scatter between them."""
    low, high = comparison.interval.T
    new = np.where(np.isfinite(comparison.prediction), comparison.prediction, np.nan).T
    p = [
        "stated" if is_stated else p_text(p).removeprefix("p = ")
        for is_stated, p in zip(comparison.is_stated, comparison.p, strict=True)
    ]
    return tabulated(
        "Means over the recordings, and another recording",
        {
            "parameter": list(map(named, comparison.parameters, comparison.units)),
            "mean": numbers(comparison.mean, 4),
            "95 % low": numbers(low, 4),
            "high": numbers(high, 4),
            "σ between": numbers(comparison.tau, 2),
            "I²": numbers(100.0 * comparison.share, 2, " %"),
            "new low": numbers(new[0], 4),
            "new high": numbers(new[1], 4),
            "p": p,
        },
        warned(j in comparison.apart for j in range(len(p))),
        spare=("95 % low", "high", "I²", "new low", "new high"),
        note=(
            "σ between: standard deviation between recordings beyond their noise; I²: its share of "
            "the scatter; new: 95 % interval of what another recording would suggest; p: "
            "probability of a scatter as large if all recordings had the same value, corrected for "
            "the number of parameters."
        ),
        detail=True,
    )


def _value_table(comparison: RecordingComparison) -> Table:
    """Tabulate what each recording suggests alone; of many, the parameters that differ most."""
    count = len(comparison.recordings)
    shown = comparison.order[: max(MAX_VALUES // count, 1)]
    odd = {recording.index for recording in comparison.odd}
    pairs = [(j, k) for j in shown for k in range(count)]
    note = "Each value is one Gauss-Newton step away from the estimate of all recordings."
    if len(shown) < len(comparison.parameters):
        of_all = f"{len(shown)} of {len(comparison.parameters)} parameters"
        note += f" Shown: {of_all}, those that differ most."
    return tabulated(
        "What each recording suggests alone",
        {
            "recording": [
                comparison.recordings[k] + (" (odd)" if k in odd else "") for _, k in pairs
            ],
            "parameter": [named(comparison.parameters[j], comparison.units[j]) for j, _ in pairs],
            "value": numbers([comparison.values[k, j] for j, k in pairs], 4),
            "σ": numbers([comparison.std[k, j] for j, k in pairs], 2, infinite="-"),
        },
        warned(k in odd for _, k in pairs),
        note=note,
        detail=True,
    )


# ---- drawn robots


def sample_parts(estimate: Estimate) -> Iterator[Part]:
    """Which robots were drawn, where they are, and what they do not cover."""
    draws = estimate.draws
    if draws is None:
        return
    yield Text(f"{draws}.")
    yield _sample_table(draws)
    yield from (Text(caution, Emphasis.WARNING) for caution in _not_covered(estimate, draws))
    yield Plot("samples")


def _not_covered(estimate: Estimate, draws: ParameterDraws) -> Iterator[str]:
    """Sentences about what the drawn robots do not cover."""
    if estimate.misfit:
        yield (
            "The drawn robots do not cover the error of a model that does not explain the "
            "recordings; find the missing term first (--select), or randomise more widely."
        )
    wide = [
        name
        for name in estimate.sloppy
        if name in draws.parameters
        and NORMAL_95 * float(draws.std[draws.parameters.index(name)])
        > POORLY_KNOWN_SHARE * float(estimate.sizes[estimate.parameters.index(name)])
    ]
    if wide:
        yield (
            f"The drawn robots differ widely in {first_ones(wide)}, which the recordings hardly "
            "determine."
        )
    directions = estimate.prior_directions
    if draws.held_combinations and directions is not None:
        yield (
            f"The drawn robots differ in {directions.determined} of {directions.count} "
            f"combinations of the inertial parameters of {first_ones(directions.bodies)}. The "
            f"recordings do not determine the other {draws.held_combinations}, which are those of "
            "the estimate in all robots; what is wrong in them is not covered."
        )
    held = [name for name in estimate.held if name in draws.parameters]
    if held:
        yield (
            f"The drawn robots do not differ in {first_ones(held)}, which the fit held at the "
            "guess; its error is not covered."
        )


def _sample_table(draws: ParameterDraws) -> Table:
    """Tabulate the range of every drawn parameter."""
    low, middle, high = np.quantile(draws.values, (0.0, 0.5, 1.0), axis=0)
    return tabulated(
        "Parameters of the drawn robots",
        {
            "parameter": list(map(named, draws.parameters, draws.units)),
            "centre": numbers(draws.centre, 4),
            "σ": numbers(draws.std, 2),
            "smallest": numbers(low, 4),
            "median": numbers(middle, 4),
            "largest": numbers(high, 4),
        },
        spare=("median",),
        note=(
            "σ is that of the 95 % intervals, before the bounds cut the distribution off; a bound "
            "shifts the median. It is smaller where combinations of inertias stay at the estimate."
        ),
        detail=True,
    )
