"""A fit to the equation of motion in words and tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.errors import first_ones
from mjfim.output.summaries.accuracy import NOT_ALONE
from mjfim.output.summary_parts import (
    Cell,
    Emphasis,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.inverse_dynamics import EquationFit, InverseDynamicsFit

# Residuals above this share of the forces are a warning.
LARGE_SHARE = 0.2


def describe_inverse_dynamics(fit: InverseDynamicsFit) -> Summary:
    """Describe a fit to the equation of motion.

    Args:
        fit: The fit.
    """
    return Summary(
        title="Parameters fitted to the equation of motion",
        outcome=fit.status,
        parts=(_parameter_table(fit), *equation_parts(fit)),
    )


def equation_parts(fit: InverseDynamicsFit) -> Iterator[Part]:
    """Yield the table of the equations, and what the fit does not determine.

    Args:
        fit: The fit.
    """
    yield _equation_table(fit)
    yield Paragraph(text=_determined(fit))
    yield Paragraph(
        text=(
            "The standard deviations of a fit to the equation of motion are formal: they contain "
            "neither the bias by noise in velocities and accelerations nor that by a wrong model."
        ),
        emphasis=Emphasis.WEAK,
        detail=True,
    )


def _determined(fit: InverseDynamicsFit) -> str:
    """Say how many combinations are determined, and which parameters are not."""
    text = (
        f"The equation of motion along the recordings determines {fit.determined} combinations of "
        f"{len(fit.parameters) - len(fit.absent)} parameters (condition number "
        f"{fit.condition:.3g})."
    )
    if fit.undetermined:
        text += f" Not alone: {first_ones(fit.undetermined)}."
    if fit.absent:
        text += f" It does not contain {first_ones(fit.absent)}, which keep their start."
    return text


def _equation_table(fit: InverseDynamicsFit) -> SummaryTable:
    """Tabulate how well each equation holds."""
    return SummaryTable(
        key="equations",
        title="Equation of motion: forces that the measured motion needs, and those of the motors",
        columns=columns(
            "equation", "residual", "of the force", "rows", "up to [Hz]", details=["rows"]
        ),
        rows=tuple(_equation_row(each) for each in fit.equations),
        note="residual: root mean square of averages over short windows",
    )


def _equation_row(each: EquationFit) -> Row:
    """Row of an equation."""
    is_poor = not each.share <= LARGE_SHARE
    return Row(
        cells=(
            Name(name=each.name, unit=each.unit),
            Quantity(value=each.residual),
            Quantity(value=100.0 * each.share, suffix=" %"),
            str(each.rows),
            Quantity(value=each.cutoff, digits=2),
        ),
        emphasis=Emphasis.WARNING if is_poor else Emphasis.NORMAL,
    )


def _parameter_table(fit: InverseDynamicsFit) -> SummaryTable:
    """Tabulate the parameters."""
    rows = []
    for j, name in enumerate(fit.parameters):
        std: Cell = Quantity(value=float(fit.std[j]), digits=2)
        if not np.isfinite(fit.std[j]):
            std = "-" if name in fit.absent else NOT_ALONE
        rows.append(
            Row(
                cells=(
                    Name(name=name, unit=fit.units[j]),
                    Quantity(value=float(fit.start[j]), digits=4),
                    Quantity(value=float(fit.theta[j]), digits=5),
                    std,
                )
            )
        )
    return SummaryTable(
        key="parameters",
        title="Parameters",
        columns=columns("parameter", "start", "estimate", "formal σ"),
        rows=tuple(rows),
    )
