"""Tables of the contents of an experiment file."""

from __future__ import annotations

from mjfim.output.summary_parts import (
    Name,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.output.vocabulary import NOMINAL
from mjfim.records.inventory import StatedExperiment


def describe_experiment(stated: StatedExperiment) -> Summary:
    """Describe a correct experiment file.

    Args:
        stated: What the file states.
    """
    parts: list[Part] = [_parameters(stated), _outputs(stated)]
    if stated.controllers:
        parts.append(_controllers(stated))
    if stated.limits:
        parts.append(_limits(stated))
    return Summary(
        title=stated.source,
        outcome=_verdict(stated),
        parts=tuple(parts),
        warnings=stated.warnings,
    )


def _parameters(stated: StatedExperiment) -> SummaryTable:
    """The unknown parameters."""
    return SummaryTable(
        key="parameters",
        title="Unknown parameters",
        columns=columns("parameter", NOMINAL.word, "lower bound", "upper bound", "nuisance"),
        rows=tuple(
            Row(
                cells=(
                    Name(name=each.name, unit=each.unit),
                    Quantity(value=each.guess, digits=5),
                    Quantity(value=each.lower),
                    Quantity(value=each.upper),
                    "yes" if each.nuisance else "",
                )
            )
            for each in stated.parameters
        ),
    )


def _outputs(stated: StatedExperiment) -> SummaryTable:
    """The measured outputs."""
    return SummaryTable(
        key="outputs",
        title="Measured outputs",
        columns=columns("output", "σ of the noise"),
        rows=tuple(
            Row(cells=(Name(name=each.name, unit=each.unit), Quantity(value=each.sigma)))
            for each in stated.outputs
        ),
    )


def _controllers(stated: StatedExperiment) -> SummaryTable:
    """The control laws."""
    return SummaryTable(
        key="controllers",
        title="Control laws in the loop",
        columns=columns(
            "actuator",
            "rate [Hz]",
            "columns of the log",
            "numbers",
            left=("columns of the log", "numbers"),
            details=("columns of the log",),
        ),
        rows=tuple(
            Row(
                cells=(
                    law.actuator,
                    Quantity(value=law.rate),
                    ", ".join(law.columns),
                    law.numbers_in_words,
                )
            )
            for law in stated.controllers
        ),
    )


def _limits(stated: StatedExperiment) -> SummaryTable:
    """The limits of a design."""
    return SummaryTable(
        key="limits",
        title="Limits of a design, with the ranges of the MJCF",
        columns=columns("quantity", "name", "lower", "upper", "unit", left=("name", "unit")),
        rows=tuple(
            Row(
                cells=(
                    each.quantity,
                    each.name,
                    Quantity(value=each.lower, digits=5),
                    Quantity(value=each.upper, digits=5),
                    each.unit,
                )
            )
            for each in stated.limits
        ),
    )


def _verdict(stated: StatedExperiment) -> str:
    """One sentence: the file is correct, and for which verbs it is complete."""
    count = len(stated.parameters)
    found = (
        f"{stated.source} is correct: {_counted(count, 'parameter')}, "
        f"{_counted(len(stated.outputs), 'output')}, "
        f"{_counted(len(stated.controls), 'control')}, {stated.rate:g} Hz"
    )
    if stated.missing:
        keys = " and ".join(f"`{key}`" for key in stated.missing)
        work = "`simulate` also needs" if stated.controllers else "`check` and `design` also need"
        return f"{found}. It serves `identify`; {work} {keys}"
    if stated.controllers:
        return f"{found}, {stated.horizon:g} s. It serves `identify` and `simulate`, not `design`"
    return f"{found}, {stated.horizon:g} s"


def _counted(count: int, noun: str) -> str:
    """A number of things in words."""
    return f"{count} {noun}{'s' if count != 1 else ''}"
