"""Pages about what was read: a model, an experiment file, and logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.output.page import (
    NOMINAL,
    Listing,
    Page,
    Part,
    Row,
    Table,
    named,
    number,
    numbers,
)
from mjfim.recordings.read import ColumnSummary, LogSummary
from mjfim.records.base import Level, Verdict
from mjfim.records.inventory import Inventory, StatedExperiment

# Jitter of a log below this fraction of the sample period is round-off of the time stamps.
JITTER_ROUND_OFF = 1e-6


def _table(title: str, headings: str, rows: Sequence[tuple[str, ...]]) -> Table:
    """A table; its headings have commas between them."""
    return Table(
        title=title,
        columns=tuple(headings.split(", ")),
        rows=tuple(Row(cells) for cells in rows),
    )


def _page(kind: str, verdict: str, tables: Sequence[Table], further: Sequence[Part] = ()) -> Page:
    """A page of the tables that have rows."""
    parts = [*(table for table in tables if table.rows), *further]
    return Page(kind=kind, verdict=Verdict(verdict, Level.GOOD, ok=True), sections={"": parts})


# ---- model


def inventory_page(inventory: Inventory) -> Page:
    """Describe what an experiment file can name in a model."""
    tables = (
        _table(
            "Parameters: paths for `target`",
            "path, value, unit",
            [(path, _known(value), unit) for path, value, unit in inventory.parameters],
        ),
        _table(
            "Outputs: names for `[noise]` and for columns of recordings",
            "name, measured by, unit, noise in the MJCF",
            [(o.name, o.source, o.unit, _known(o.noise or None)) for o in inventory.outputs],
        ),
        _table(
            "Actuators: names for `initial.control` and columns of controls",
            "name, drives, unit of the control",
            inventory.actuators,
        ),
        _table(
            "Keyframes: names for `initial.keyframe`",
            "name, qpos, ctrl",
            [
                (k.name or "(no name)", " ".join(numbers(k.qpos, 4)), " ".join(numbers(k.ctrl, 4)))
                for k in inventory.keyframes
            ],
        ),
        _table(
            "Limits: ranges of the MJCF, which a design keeps",
            "quantity, name, lower, upper, unit",
            [
                (each.kind, each.name, _known(each.lower), _known(each.upper), each.unit)
                for each in inventory.limits
            ],
        ),
        _table(
            "Terms of the library: kinds for tables `[terms.<name>]`",
            "kind, acts on, fields",
            [(t.kind, ", ".join(t.elements), ", ".join(t.fields)) for t in inventory.terms],
        ),
    )
    return _page(
        inventory.model,
        "",
        tables,
        [Listing("Remarks", inventory.remarks)] if inventory.remarks else [],
    )


def _known(value: float | None) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else number(value, 5)


# ---- experiment file


def experiment_page(stated: StatedExperiment) -> Page:
    """Describe a correct experiment file, and for which verbs it is complete."""
    tables = (
        _table(
            "Unknown parameters",
            f"parameter, {NOMINAL}, lower bound, upper bound, nuisance",
            [
                (
                    named(name, unit),
                    number(guess, 5),
                    *map(number, bounds),
                    "yes" if name in stated.nuisance else "",
                )
                for name, unit, guess, bounds in zip(
                    stated.parameters,
                    stated.units,
                    stated.guess.tolist(),
                    stated.bounds.tolist(),
                    strict=True,
                )
            ],
        ),
        _table(
            "Measured outputs",
            "output, σ of the noise",
            [
                (named(name, stated.output_units[name]), number(sigma))
                for name, sigma in stated.sigma.items()
            ],
        ),
        _table(
            "Control laws in the loop",
            "actuator, rate [Hz], columns of the log, numbers",
            [
                (law.actuator, number(law.rate), ", ".join(law.columns), law.numbers_in_words)
                for law in stated.controllers
            ],
        ),
        _table(
            "Limits of a design, with the ranges of the MJCF",
            "quantity, name, lower, upper, unit",
            [
                (each.kind, each.name, number(each.lower, 5), number(each.upper, 5), each.unit)
                for each in stated.limits
            ],
        ),
    )
    return replace(_page(stated.source, _serves(stated), tables), warnings=stated.warnings)


def _serves(stated: StatedExperiment) -> str:
    """Say that the file is correct, and for which verbs it is complete."""
    counts = {
        "parameter": len(stated.parameters),
        "output": len(stated.outputs),
        "control": len(stated.controls),
    }
    things = [f"{count} {noun}{'s' if count != 1 else ''}" for noun, count in counts.items()]
    servos = sum(law.replaces_servo for law in stated.controllers)
    if servos:
        things.append(f"laws in place of {servos} position servos")
    found = f"{stated.source} is correct: {', '.join(things)}, {stated.rate:g} Hz"
    if stated.missing:
        keys = " and ".join(f"`{key}`" for key in stated.missing)
        work = "`simulate` also needs" if stated.controllers else "`check` and `design` also need"
        return f"{found}. It serves `identify`; {work} {keys}"
    if stated.controllers:
        return f"{found}, {stated.horizon:g} s. It serves `identify` and `simulate`, not `design`"
    return f"{found}, {stated.horizon:g} s"


# ---- logs


def log_tables(logs: Sequence[LogSummary]) -> Sequence[Table]:
    """Describe what was read: the clock of every log, then the range of its columns."""
    clocks = [
        (
            log.file,
            f"{log.rows:,}",
            number(log.duration, 4, " s"),
            number(log.rate, 5, " Hz"),
            _jitter(log),
            number(1e3 * log.longest_step, 3, " ms"),
            f"{log.dropped:,} rows" if log.dropped else "-",
        )
        for log in logs
    ]
    # Columns of the same name in several logs share a row.
    by_name: dict[str, list[ColumnSummary]] = {}
    for log in logs:
        for column in log.columns:
            by_name.setdefault(column.name, []).append(column)
    return (
        _table(
            "Logs that were read", "log, rows, time, rate, jitter, longest gap, rejected", clocks
        ),
        _table(
            "Range of each column over all logs",
            "column, from, smallest, largest, resolution, empty",
            [_range_cells(found) for found in by_name.values()],
        ),
    )


def _jitter(log: LogSummary) -> str:
    """The jitter of a log [ms]; "-" if it is only round-off of the time stamps."""
    if log.jitter_std * log.rate < JITTER_ROUND_OFF:
        return "-"
    return number(1e3 * log.jitter_std, 2, " ms")


def _range_cells(found: Sequence[ColumnSummary]) -> tuple[str, ...]:
    resolutions = [column.resolution for column in found if column.resolution > 0.0]
    empty = np.mean([column.empty_share for column in found])
    return (
        found[0].name,
        found[0].source,
        number(np.nanmin([column.minimum for column in found]), 4),
        number(np.nanmax([column.maximum for column in found]), 4),
        number(min(resolutions, default=0.0), 2),
        f"{100 * empty:.0f} %" if empty else "-",
    )
