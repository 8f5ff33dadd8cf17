"""The elements of a model that an experiment file can name, as tables."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.output.summary_parts import (
    Cell,
    Listing,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.inventory import Inventory

# Headings of columns of text.
LEFT = ("name", "measured by", "drives", "unit", "qpos", "ctrl", "acts on", "fields")


def describe_inventory(inventory: Inventory) -> Summary:
    """Describe what an experiment file can name in a model.

    Args:
        inventory: The elements of the model.
    """
    tables = (
        _table(
            "parameters",
            "Parameters: paths for `target`",
            ("path", "value", "unit"),
            [(p.path, _number(p.value), p.unit) for p in inventory.parameters],
        ),
        _table(
            "outputs",
            "Outputs: names for `[noise]` and for columns of recordings",
            ("name", "measured by", "unit", "noise in the MJCF"),
            [(o.name, o.source, o.unit, _number(o.noise or None)) for o in inventory.outputs],
        ),
        _table(
            "actuators",
            "Actuators: names for `initial.control` and columns of controls",
            ("name", "drives", "unit of the control"),
            [(a.name, a.drives, a.unit) for a in inventory.actuators],
        ),
        _table(
            "keyframes",
            "Keyframes: names for `initial.keyframe`",
            ("name", "qpos", "ctrl"),
            [
                (k.name or "(no name)", _numbers(k.qpos), _numbers(k.ctrl))
                for k in inventory.keyframes
            ],
        ),
        _table(
            "limits",
            "Limits: ranges of the MJCF, which a design keeps",
            ("quantity", "name", "lower", "upper", "unit"),
            [
                (limit.quantity, limit.name, _number(limit.lower), _number(limit.upper), limit.unit)
                for limit in inventory.limits
            ],
        ),
        _table(
            "terms",
            "Terms of the library: kinds for tables `[terms.<name>]`",
            ("kind", "acts on", "fields"),
            [(t.kind, ", ".join(t.elements), ", ".join(t.fields)) for t in inventory.terms],
        ),
    )
    parts: list[Part] = [table for table in tables if table.rows]
    if inventory.remarks:
        parts.append(Listing(title="Remarks", items=inventory.remarks))
    return Summary(title=inventory.model, outcome="", parts=tuple(parts))


def _table(
    key: str, title: str, headings: Sequence[str], rows: Sequence[tuple[Cell, ...]]
) -> SummaryTable:
    """One table."""
    return SummaryTable(
        key=key,
        title=title,
        columns=columns(*headings, left=LEFT),
        rows=tuple(Row(cells=row) for row in rows),
    )


def _number(value: float | None) -> Cell:
    """A number, or a dash where there is none."""
    return "-" if value is None else Quantity(value=value, digits=5)


def _numbers(values: Sequence[float]) -> str:
    """Numbers of a keyframe in one cell."""
    return " ".join(f"{value:.4g}" for value in values)
