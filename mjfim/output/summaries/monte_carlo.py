"""A Monte Carlo study in words and tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mjfim.arrays import Array
from mjfim.output.summary_parts import (
    Cell,
    ColumnGroup,
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
from mjfim.output.vocabulary import shown_word
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics

# Largest number of parameters for which covariance matrices are shown; of more, variances only.
MAX_MATRIX = 5


def describe_study(study: MonteCarloStudy, units: Sequence[str]) -> Summary:
    """Describe the observed scatter of estimates beside the Cramér-Rao bound.

    Args:
        study: The study.
        units: Unit of each of the p parameters.
    """
    parts: list[Part] = [
        _efficiency_table(study, name, trials, units) for name, trials in study.sets.items()
    ]
    parts.append(
        Paragraph(
            text=(
                "efficiency = Cramér-Rao bound / observed variance; 1 means that the bound is "
                "reached."
            ),
            emphasis=Emphasis.WEAK,
        )
    )
    parts += _covariance_tables(study, units)
    return Summary(
        title="Monte Carlo study against the Cramér-Rao bound",
        outcome=_efficiency_sentence(study),
        parts=tuple(parts),
    )


def _efficiency_sentence(study: MonteCarloStudy) -> str:
    """Return the range of the efficiencies along each trajectory."""
    ranges = []
    for name, trials in study.sets.items():
        low, high = min(trials.efficiency), max(trials.efficiency)
        of_trials = f"in {trials.trials:,} trials"
        ranges.append(
            f"{low:.2f} to {high:.2f} {of_trials} along the {shown_word(name)} trajectory"
        )
    return f"Efficiency of the estimates: {', and '.join(ranges)} (1 is the best)"


def _efficiency_table(
    study: MonteCarloStudy, trajectory: str, trials: TrialStatistics, units: Sequence[str]
) -> SummaryTable:
    """Tabulate variance, bound and efficiency of every parameter along one trajectory."""
    rows = []
    for j, name in enumerate(study.parameters):
        low, high = trials.efficiency_interval[j]
        cells = (
            Name(name=name, unit=units[j]),
            Quantity(value=float(study.theta[j]), digits=4),
            Quantity(value=float(trials.mean[j]), digits=5),
            Quantity(value=float(trials.covariance[j, j]), digits=4),
            Quantity(value=float(trials.crlb[j, j]), digits=4),
            f"{trials.efficiency[j]:.3f}",
            f"{low:.3f}",
            f"{high:.3f}",
        )
        rows.append(Row(cells=cells, trajectory=trajectory))

    shown = shown_word(trajectory)
    title = f"{shown}: {trials.trials} trials, {trials.failed} failed, {study.measure_rate:g} Hz"
    return SummaryTable(
        key=f"efficiency {trajectory}",
        title=title,
        columns=columns(
            "parameter",
            "true",
            "mean",
            "variance",
            "bound",
            "efficiency",
            "95 % low",
            "high",
            details=["true", "mean"],
        ),
        rows=tuple(rows),
    )


def _covariance_tables(study: MonteCarloStudy, units: Sequence[str]) -> list[SummaryTable]:
    """Tabulate covariance, information and bound; of many parameters, the variances only."""
    if len(study.parameters) > MAX_MATRIX:
        return [_variance_table(study, units)]
    return [
        _matrix_table(
            study, units, "Monte Carlo covariance", lambda name: study.sets[name].covariance
        ),
        _matrix_table(study, units, "Fisher information", lambda name: study.information[name]),
        _matrix_table(study, units, "Cramér–Rao bound", lambda name: study.sets[name].crlb),
    ]


def _matrix_table(
    study: MonteCarloStudy, units: Sequence[str], title: str, matrix_of: Callable[[str], Array]
) -> SummaryTable:
    """Tabulate the upper triangles of a symmetric matrix of each trajectory side by side."""
    count = len(study.parameters)
    cells: list[list[Cell]] = [
        [Name(name=name, unit=unit)] for name, unit in zip(study.parameters, units, strict=True)
    ]
    groups = []
    for k, trajectory in enumerate(study.sets):
        groups.append(ColumnGroup(trajectory=trajectory, first=1 + k * count, last=(k + 1) * count))
        matrix = matrix_of(trajectory)
        for j in range(count):
            cells[j] += [
                "·" if i < j else Quantity(value=float(matrix[j, i])) for i in range(count)
            ]

    return SummaryTable(
        key=title,
        title=title,
        columns=columns("", *(study.parameters * len(study.sets))),
        rows=tuple(Row(cells=tuple(row)) for row in cells),
        groups=tuple(groups),
        detail=True,
    )


def _variance_table(study: MonteCarloStudy, units: Sequence[str]) -> SummaryTable:
    """Tabulate observed variance, information and bound of every parameter.

    Trajectories are side by side.
    """
    cells: list[list[Cell]] = [
        [Name(name=name, unit=unit)] for name, unit in zip(study.parameters, units, strict=True)
    ]
    groups = []
    for k, (trajectory, trials) in enumerate(study.sets.items()):
        groups.append(ColumnGroup(trajectory=trajectory, first=1 + 3 * k, last=3 + 3 * k))
        matrices = (trials.covariance, study.information[trajectory], trials.crlb)
        for j, row in enumerate(cells):
            row += [Quantity(value=float(matrix[j, j])) for matrix in matrices]

    return SummaryTable(
        key="variances",
        title="Variances (diagonals)",
        columns=columns("parameter", *(("observed", "information", "bound") * len(study.sets))),
        rows=tuple(Row(cells=tuple(row)) for row in cells),
        groups=tuple(groups),
        detail=True,
    )
