"""The comparison of two robots in words and a table."""

from __future__ import annotations

from collections.abc import Iterator

from mjfim.output.summary_parts import (
    Emphasis,
    Listing,
    Name,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.robots import RobotComparison, p_text


def describe_robots(comparison: RobotComparison) -> Summary:
    """Describe which parameters of two robots differ, and which differences would be found.

    Args:
        comparison: The comparison.
    """
    parts: list[Part] = []
    if comparison.changed:
        items = tuple(f"• {comparison.sentence(j)}" for j in comparison.changed)
        parts.append(Listing(title="Differences", items=items, emphasis=Emphasis.STRONG))
    if comparison.parameters:
        parts.append(_table(comparison))
    return Summary(
        title="Two robots",
        outcome=str(comparison),
        parts=tuple(parts),
        warnings=tuple(warnings_of(comparison)),
    )


def warnings_of(comparison: RobotComparison) -> Iterator[str]:
    """Yield sentences that limit a comparison.

    Args:
        comparison: The comparison.
    """
    yield from comparison.remarks
    if comparison.changed and comparison.parameters and len(comparison.parameters) > 1:
        others = len(comparison.parameters) - len(comparison.changed)
        if others:
            yield (
                f"no difference was found in the other {others} parameters, which is not a proof "
                "that they are equal: see which differences would have been found"
            )


def _table(comparison: RobotComparison) -> SummaryTable:
    """Tabulate the parameters of both robots, the most significant difference first."""
    rows = []
    for j in comparison.order.tolist():
        is_changed = j in comparison.changed
        low, high = comparison.interval[j]
        cells = (
            Name(name=comparison.parameters[j], unit=comparison.units[j]),
            Quantity(value=float(comparison.values[0, j]), digits=4),
            Quantity(value=float(comparison.values[1, j]), digits=4),
            Quantity(value=float(comparison.difference[j]), digits=3),
            Quantity(value=float(low), digits=3),
            Quantity(value=float(high), digits=3),
            p_text(comparison.p[j]).removeprefix("p = "),
            Quantity(value=float(comparison.detectable[j]), digits=2),
        )
        rows.append(Row(cells=cells, emphasis=Emphasis.WARNING if is_changed else Emphasis.NORMAL))

    first, second = comparison.names
    return SummaryTable(
        key="robots",
        title="Parameters of both robots",
        columns=columns(
            "parameter",
            first,
            second,
            "difference",
            "95 % low",
            "high",
            "p",
            "would be found",
            optional=["95 % low", "high"],
        ),
        rows=tuple(rows),
        note=(
            "p: probability of a difference as large between equal robots, corrected for the "
            "number of tests; would be found: difference that would have been found with a "
            f"probability of 80 % (at p = {comparison.level:g})."
        ),
    )
