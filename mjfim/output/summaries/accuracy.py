"""Predicted accuracy of parameters before and after a design."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.output.summary_parts import Cell, Emphasis, Name, Quantity, Row, SummaryTable, columns
from mjfim.records.design import Design

# Remark on predicted standard deviations.
BEST_CASE = (
    "σ is the Cramér-Rao bound: the best case, reached if the model and the stated noise are right."
)

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
        name = Name(name=design.parameters[j], unit=units[j])
        std_initial, std_final = float(design.initial.std[j]), float(design.final.std[j])
        rows.append(Row(cells=_accuracy_cells(name, design.theta[j], std_initial, std_final)))
    for combination in design.combined:
        cells = _accuracy_cells(
            combination.expression,
            combination.value,
            combination.std_initial,
            combination.std_final,
        )
        rows.append(Row(cells=cells, emphasis=Emphasis.DERIVED))

    return SummaryTable(
        key="accuracy",
        title="Predicted standard deviation σ of each parameter after one experiment",
        columns=columns(
            "parameter", "value", "σ initial", "relative", "σ optimized", "relative", "smaller by"
        ),
        rows=tuple(rows),
    )


def _accuracy_cells(
    name: Cell, value: float, std_initial: float, std_final: float
) -> tuple[Cell, ...]:
    """Return the cells of one parameter or combination."""
    return (
        name,
        Quantity(value=float(value), digits=4),
        Quantity(value=std_initial, infinite=NOT_ALONE),
        _relative(std_initial, value),
        Quantity(value=std_final, infinite=NOT_ALONE),
        _relative(std_final, value),
        improvement(std_initial, std_final),
    )


def _relative(std: float, value: float) -> Quantity:
    """Return a standard deviation in percent of a value; NaN where there is none."""
    if not value or not np.isfinite(std):
        return Quantity(value=float("nan"))
    return Quantity(value=float(100.0 * std / abs(value)), digits=2, suffix=" %")


def improvement(before: float, after: float) -> str:
    """Return the factor by which a standard deviation became smaller, in words.

    Args:
        before: Standard deviation before.
        after: Standard deviation after, in the same unit.
    """
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    if before >= after:
        return f"{before / after:.1f} ×"
    return f"{after / before:.1f} × larger"
