"""Predicted accuracy of parameters before and after a design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.output.summary_parts import Cell, Emphasis, Name, Quantity, Row, SummaryTable, columns
from mjfim.records.design import Design

# Remark on predicted standard deviations.
BEST_CASE = (
    "σ is the Cramér-Rao bound: the best case, reached if the model and the stated noise are right."
)

# Heading of the relative standard deviation before a design.
RELATIVE_INITIAL = "relative σ initial"

# Largest number of digits of a share in percent.
MAX_DIGITS = 6

# Cell of a standard deviation that is infinite, because others absorb the parameter's effect.
NOT_ALONE = "not alone"


def accuracy_table(design: Design, units: Sequence[str]) -> SummaryTable:
    """Tabulate the predicted standard deviation of every parameter before and after a design.

    Args:
        design: The design.
        units: Unit of each of the p parameters.
    """
    rows = []
    for j in design.wanted:
        cells = _accuracy_cells(
            Name(name=design.parameters[j], unit=units[j]),
            value=float(design.theta[j]),
            size=float(design.sizes[j]),
            std_initial=float(design.initial.std[j]),
            std_final=float(design.final.std[j]),
        )
        rows.append(Row(cells=cells))
    for combination in design.combined:
        cells = _accuracy_cells(
            combination.expression,
            value=combination.value,
            size=abs(combination.value),
            std_initial=combination.std_initial,
            std_final=combination.std_final,
        )
        rows.append(Row(cells=cells, emphasis=Emphasis.DERIVED))

    return SummaryTable(
        key="accuracy",
        title="Predicted standard deviation σ of each parameter after one experiment",
        columns=columns(
            "parameter",
            "value",
            "σ initial",
            RELATIVE_INITIAL,
            "σ designed",
            "relative σ",
            "change of σ",
            details=[RELATIVE_INITIAL],
            optional=["value"],
        ),
        rows=tuple(rows),
    )


def _accuracy_cells(
    name: Cell, *, value: float, size: float, std_initial: float, std_final: float
) -> tuple[Cell, ...]:
    """Return the cells of one parameter or combination."""
    return (
        name,
        Quantity(value=value, digits=4),
        Quantity(value=std_initial, infinite=NOT_ALONE),
        relative(std_initial, size),
        Quantity(value=std_final, infinite=NOT_ALONE),
        relative(std_final, size),
        improvement(std_initial, std_final),
    )


def relative(std: float, size: float) -> Quantity:
    """Return a standard deviation in percent of a size; NaN where there is none.

    Args:
        std: The standard deviation.
        size: Magnitude of the value, or of the whole vector or tensor of which it is an entry.
    """
    if not size or not np.isfinite(std):
        return Quantity(value=float("nan"))
    percent = 100.0 * std / size

    # Shares from 99.5 % on are whole numbers, not powers of ten.
    places = len(f"{percent:.0f}") if percent < 10.0**MAX_DIGITS else MAX_DIGITS
    digits = max(places, 2)
    return Quantity(value=percent, digits=digits, suffix=" %")


def size_sentence(values: Sequence[float] | Array, sizes: Sequence[float] | Array) -> str:
    """Say of what a relative standard deviation is a share; empty where it is of the value.

    Args:
        values: Values of the parameters.
        sizes: Their sizes.
    """
    if np.array_equal(np.abs(values), sizes):
        return ""
    return (
        "A relative σ is a share of the value; for an entry of a vector or tensor, and for a value "
        "of zero, it is a share of the magnitude of the whole."
    )


def improvement(before: float, after: float) -> str:
    """Return how a standard deviation changed: divided by a number, or times a number.

    Args:
        before: Standard deviation before.
        after: Standard deviation after, in the same unit.
    """
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    if before >= after:
        return f"÷ {before / after:.1f}"
    return f"× {after / before:.1f}"
