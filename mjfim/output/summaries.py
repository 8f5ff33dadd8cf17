"""Results in words and tables, for the terminal, Rerun and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from scipy.stats import binom

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet
from mjfim.output.summary_parts import (
    Cell,
    Column,
    ColumnGroup,
    Emphasis,
    Listing,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.recordings.summary import ColumnSummary, LogSummary
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check, ParameterCheck
from mjfim.records.combinations import ParameterGroup
from mjfim.records.comparison import DESIGN, Comparison, MethodResult
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate, Prediction
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.robustness import CONFIDENCE, REQUIRED_COVERAGE, Robustness

# Largest number of parameters or outputs that have a column each.
MAX_COLUMNS = 7

# Largest number of limits that the initial control violates and that a summary lists.
MAX_VIOLATIONS = 4

# Largest number of eigenvalues that a table shows one by one; of more, the largest three and the
# smallest two are shown.
MAX_EIGENVALUES = 6

# Largest number of eigenvalues that a sentence lists; of more, the smallest four and the largest
# two are listed.
MAX_LISTED_EIGENVALUES = 8

# Largest number of parameters for which covariance matrices are shown; of more, variances only.
MAX_MATRIX = 5

# Characters to which file names are shortened in tables of logs and of predictions.
LOG_NAME_WIDTH = 34
PREDICTION_NAME_WIDTH = 40

# Jitter of a log below this fraction of the sample period is round-off of the time stamps.
JITTER_ROUND_OFF = 1e-6

# Smallest divisor of the improvement of an eigenvalue; avoids a division by zero.
TINY = 1e-300

# Cell of a standard deviation that is infinite, because others absorb the parameter's effect.
NOT_ALONE = "not alone"

# Remark on predicted standard deviations.
BEST_CASE = (
    "σ is the Cramér-Rao bound: the best case, reached if the model and the stated noise are right."
)

# Names of the trajectories of a study in titles, where they differ from those in the record.
TRAJECTORY_NAMES = {"final": "optimized"}

# Digits as subscripts.
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


# ---- designs


def describe_design(design: Design, units: Sequence[str]) -> Summary:
    """Describe predicted standard deviations before and after a design, and how it ended.

    Args:
        design: The design.
        units: Unit of each of the p parameters.
    """
    parts: list[Part] = [accuracy_table(design, units)]

    before, after = float(design.initial.eigenvalues[0]), float(design.final.eigenvalues[0])
    parts.append(
        Paragraph(
            text=(
                f"λ_min {before:.4g} → {after:.4g} ({after / max(before, TINY):.1f} ×), cost J "
                f"{design.initial.cost:.5g} → {design.final.cost:.5g}, found from the "
                f"{design.found_by}"
            )
        )
    )
    parts.append(
        Paragraph(
            text=f"{design.iterations} iterations, {design.seconds:.2f} s, "
            f"{design.steps / 1e6:.2f} million MuJoCo steps"
        )
    )
    if design.nuisance:
        names = ", ".join(design.nuisance)
        parts.append(
            Paragraph(text=f"nuisance parameters, whose accuracy the design ignores: {names}")
        )
    if design.combinations:
        parts.append(
            Paragraph(
                text=(
                    "Some parameters are not identifiable alone; the design is optimized for "
                    "combinations of them, see design.json"
                )
            )
        )
    parts.append(Paragraph(text=BEST_CASE, emphasis=Emphasis.WEAK))

    parts += _limit_parts(design)
    parts += _start_parts(design)
    parts.append(eigenvalue_table(design))
    return Summary(
        title="Designed experiment",
        outcome=design.status.value,
        parts=tuple(parts),
        warnings=design.warnings,
    )


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


def eigenvalue_table(design: Design) -> SummaryTable:
    """Tabulate eigenvalues (largest first), criterion and cost of both trajectories.

    Of many eigenvalues, those in the middle are left out.

    Args:
        design: The design.
    """
    count = len(design.final.eigenvalues)
    left_out = count > MAX_EIGENVALUES
    shown = [0, 1, 2, count - 2, count - 1] if left_out else list(range(count))
    headings = [f"λ{str(k + 1).translate(SUBSCRIPTS)}" for k in shown]
    if left_out:
        headings.insert(3, "…")

    rows = []
    for trajectory, title, evaluation in (
        ("initial", "initial", design.initial),
        ("final", "optimized", design.final),
    ):
        descending = evaluation.eigenvalues[::-1]
        values: list[Cell] = [Quantity(value=float(descending[k]), digits=5) for k in shown]
        if left_out:
            values.insert(3, "…")
        values += [
            Quantity(value=evaluation.criterion, digits=5),
            Quantity(value=evaluation.cost, digits=5),
        ]
        rows.append(Row(cells=(title, *values), trajectory=trajectory))

    return SummaryTable(
        key="eigenvalues",
        title="Eigenvalues of the Fisher information, and cost",
        columns=columns("trajectory", *headings, "criterion", "J"),
        rows=tuple(rows),
        detail=True,
    )


def _limit_parts(design: Design) -> list[Part]:
    """Return a table of the worst margins, and which limits are violated."""
    if not design.limits:
        return []

    parts: list[Part] = []
    broken = [str(violation) for violation in design.initial_violations]
    if broken:
        shown = "; ".join(broken[:MAX_VIOLATIONS])
        others = len(broken) - MAX_VIOLATIONS
        more = f"; and {others} more, see limits.initial in design.json" if others > 0 else ""
        parts.append(
            Paragraph(
                text=f"The initial control violates limits: {shown}{more}. Its standard deviations "
                "are those of a motion outside the limits."
            )
        )

    violated = [kind for kind, margin in design.limits.items() if margin < 0.0]
    if violated:
        parts.append(
            Paragraph(
                text=f"Limits are violated: {', '.join(violated)}.",
                emphasis=Emphasis.STRONG_WARNING,
                detail=True,
            )
        )
    rows = tuple(
        Row(cells=(kind, Quantity(value=margin))) for kind, margin in design.limits.items()
    )
    parts.append(
        SummaryTable(
            key="limits",
            title="Limits",
            columns=columns("limit", "worst margin (negative: violated)"),
            rows=rows,
            detail=True,
        )
    )
    return parts


def _start_parts(design: Design) -> list[Part]:
    """Return a table of all initial controls of a multistart, and which was the best."""
    count = len(design.starts)
    if count < 2:
        return []

    rows = tuple(
        Row(
            cells=(
                start.name,
                Quantity(value=start.cost, digits=5),
                str(start.iterations),
                start.status.name.lower(),
            )
        )
        for start in design.starts
    )
    table = SummaryTable(
        key="starts",
        title="Initial controls from which the search started",
        columns=columns("initial control", "cost", "iterations", "outcome", left=["outcome"]),
        rows=rows,
        detail=True,
    )
    return [
        Paragraph(text=f"Best of {count} starts: {design.found_by}.", detail=True),
        table,
    ]


# ---- estimates


def describe_estimate(estimate: Estimate) -> Summary:
    """Describe estimates with intervals, the fit of every output, and predictions.

    Args:
        estimate: The estimate.
    """
    parts: list[Part] = [_estimate_table(estimate)]

    # Parameters that differ between recordings: the table shows the first value only.
    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            listed = ", ".join(f"{value:.3g}" for value in values)
            parts.append(Paragraph(text=f"{name} of each recording: {listed}"))

    verdict = (
        "not explained by noise: the formal σ underestimates the errors"
        if estimate.misfit
        else "consistent with noise"
    )
    rms = ", ".join(f"{name} {value:.3g}" for name, value in estimate.residual_rms.items())
    parts.append(
        Paragraph(
            text=(
                f"residuals: χ²/dof = {estimate.chi2 / estimate.dof:.3f} with {estimate.dof:,} "
                f"degrees of freedom, {verdict}; rms: {rms}"
            )
        )
    )
    parts.append(_residual_table(estimate))
    parts.append(Paragraph(text=f"{estimate.iterations} iterations, {estimate.seconds:.1f} s"))
    if estimate.predictions:
        parts.append(_prediction_table(estimate.predictions))
    parts.append(
        Paragraph(
            text=(
                "The formal σ is the true accuracy only if the model and the noise are right. The "
                "honest σ is a quarter of the width of the 95 % interval, which allows for "
                "residuals that are not white noise and for recordings that disagree, but not "
                "for the bias of a wrong model."
            ),
            emphasis=Emphasis.WEAK,
        )
    )
    return Summary(
        title="Estimated parameters",
        outcome=estimate.status,
        parts=tuple(parts),
        warnings=estimate.warnings,
    )


def _estimate_table(estimate: Estimate) -> SummaryTable:
    """Tabulate estimates, standard deviations and intervals."""
    rows = []
    for j, name in enumerate(estimate.parameters):
        low, high = estimate.interval[j]
        uncertainty: tuple[Cell, ...] = (NOT_ALONE, "-", "-")
        if np.isfinite(estimate.std[j]):
            uncertainty = (
                Quantity(value=float(estimate.std[j]), digits=2),
                Quantity(value=float(0.25 * (high - low)), digits=2),
                f"{low:.5g} … {high:.5g}",
            )
        cells = (
            Name(name=name, unit=estimate.units[j]),
            Quantity(value=float(estimate.initial_theta[j]), digits=5),
            Quantity(value=float(estimate.theta[j]), digits=5),
            *uncertainty,
            "yes" if name in estimate.at_bound else "",
        )
        rows.append(Row(cells=cells))

    headings = ["parameter", "guess", "estimate", "formal σ", "honest σ", "95 % interval"]
    if estimate.at_bound:
        headings.append("at bound")
    else:
        rows = [Row(cells=row.cells[:-1]) for row in rows]
    return SummaryTable(
        key="estimates",
        title="Estimates",
        columns=columns(*headings),
        rows=tuple(rows),
    )


def _residual_table(estimate: Estimate) -> SummaryTable:
    """Tabulate the residuals of every output."""
    rows = tuple(
        Row(cells=(name, Quantity(value=value))) for name, value in estimate.residual_rms.items()
    )
    return SummaryTable(
        key="residuals",
        title="Fit of every output",
        columns=columns("output", "residual rms"),
        rows=rows,
        detail=True,
    )


def _prediction_table(predictions: Sequence[Prediction]) -> SummaryTable:
    """Tabulate prediction errors of the identified and of the nominal model.

    At most `MAX_COLUMNS` outputs are shown.
    """
    outputs = predictions[0].identified.outputs
    measured = [
        j
        for j in range(len(outputs))
        if any(np.isfinite(prediction.identified.rms[j]) for prediction in predictions)
    ]
    shown = measured[:MAX_COLUMNS]

    rows = []
    for prediction in predictions:
        mark = "" if prediction.held_out else " *"
        errors = [
            f"{prediction.identified.rms[j]:.3g} / {prediction.nominal.rms[j]:.3g}" for j in shown
        ]
        better = prediction.ratio < 1.0
        rows.append(
            Row(
                cells=(
                    shortened(prediction.name, PREDICTION_NAME_WIDTH) + mark,
                    *errors,
                    f"{prediction.ratio:.2f}",
                ),
                emphasis=Emphasis.NORMAL if better else Emphasis.WARNING,
            )
        )

    held_out = all(prediction.held_out for prediction in predictions)
    return SummaryTable(
        key="predictions",
        title=(
            "Prediction of recordings that were not fitted: rms error of the identified / of the "
            "nominal model"
        ),
        columns=columns("recording", *(outputs[j] for j in shown), "ratio"),
        rows=tuple(rows),
        note=""
        if held_out
        else "* predicted by a fit to the other recordings, but part of the final fit; "
        "--held-out keeps a recording out of the final fit",
    )


# ---- logs


def _jitter(log: LogSummary) -> Cell:
    """Return the jitter of a log [ms]; "-" if it is only round-off of the time stamps."""
    if log.jitter_std * log.rate < JITTER_ROUND_OFF:
        return "-"
    return Quantity(value=1e3 * log.jitter_std, digits=2, suffix=" ms")


def describe_logs(logs: Sequence[LogSummary]) -> Summary:
    """Describe what was read: the clock of every log, then the range of its columns.

    Args:
        logs: Summaries of the logs.
    """
    rows = [
        Row(
            cells=(
                shortened(log.file, LOG_NAME_WIDTH),
                f"{log.rows:,}",
                Quantity(value=log.duration, digits=4, suffix=" s"),
                Quantity(value=log.rate, digits=5, suffix=" Hz"),
                _jitter(log),
                Quantity(value=1e3 * log.longest_step, digits=3, suffix=" ms"),
                f"{log.dropped:,} rows" if log.dropped else "-",
            )
        )
        for log in logs
    ]
    clocks = SummaryTable(
        key="clocks",
        title="Logs that were read",
        columns=columns("log", "rows", "time", "rate", "jitter", "longest gap", "rejected"),
        rows=tuple(rows),
    )

    # Columns of the same name in several logs share a row.
    by_name: dict[str, list[ColumnSummary]] = {}
    for log in logs:
        for column in log.columns:
            by_name.setdefault(column.name, []).append(column)
    ranges = SummaryTable(
        key="ranges",
        title="Range of each column over all logs",
        columns=columns(
            "column", "from", "smallest", "largest", "resolution", "empty", left=["from"]
        ),
        rows=tuple(Row(cells=_range_cells(found)) for found in by_name.values()),
    )
    return Summary(title="", outcome="", parts=(clocks, ranges))


def _range_cells(found: Sequence[ColumnSummary]) -> tuple[Cell, ...]:
    """Return the cells of one column over all logs."""
    smallest = float(np.nanmin([column.minimum for column in found]))
    largest = float(np.nanmax([column.maximum for column in found]))
    resolutions = [column.resolution for column in found if column.resolution > 0.0]
    empty = float(np.mean([column.empty_share for column in found]))
    return (
        found[0].name,
        found[0].source,
        Quantity(value=smallest, digits=4),
        Quantity(value=largest, digits=4),
        Quantity(value=min(resolutions, default=0.0), digits=2),
        f"{100 * empty:.0f} %" if empty else "-",
    )


def shortened(path: str, width: int) -> str:
    """Return the end of a path, which distinguishes files.

    Args:
        path: The path.
        width: Largest number of characters.
    """
    name = path.rsplit("/", 1)[-1]
    return name if len(name) <= width else f"…{name[1 - width :]}"


# ---- Monte Carlo studies


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
        title="Monte Carlo study against the Cramér-Rao bound", outcome="", parts=tuple(parts)
    )


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
            f"{low:.3f} … {high:.3f}",
        )
        rows.append(Row(cells=cells, trajectory=trajectory))

    shown = TRAJECTORY_NAMES.get(trajectory, trajectory)
    title = f"{shown}: {trials.trials} trials, {trials.failed} failed, {study.measure_rate:g} Hz"
    return SummaryTable(
        key=f"efficiency {trajectory}",
        title=title,
        columns=columns(
            "parameter", "true", "mean", "variance", "bound", "efficiency", "95 % interval"
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


# ---- checks


def describe_check(check: Check) -> Summary:
    """Describe predicted standard deviations, inseparable parameters, and the verdict.

    Args:
        check: The check.
    """
    parts: list[Part] = [_check_table(check)]

    for title, groups in (
        (
            "Identifiable only in combination, with this control and with random controls from "
            "this initial state",
            check.not_separable,
        ),
        ("Not excited by this control, but by another one", check.not_excited),
    ):
        if groups:
            items = tuple(_group_lines(group, check) for group in groups)
            parts.append(Listing(title=f"{title}:", items=items))

    parts.append(Paragraph(text=_eigenvalue_sentence(check)))
    parts.append(Paragraph(text=_self_test_sentence(check)))
    emphasis = Emphasis.NORMAL if check.ok else Emphasis.WARNING
    sentences = tuple(f"• {sentence}" for sentence in check.verdict)
    parts.append(Listing(title="Verdict", items=sentences, emphasis=emphasis))
    parts.append(Paragraph(text=BEST_CASE, emphasis=Emphasis.WEAK))
    return Summary(title="", outcome="", parts=tuple(parts))


def _check_table(check: Check) -> SummaryTable:
    """Tabulate predicted and wanted standard deviations, and the repetitions that reach them."""
    return SummaryTable(
        key="accuracy",
        title=f"Accuracy that {check.source} ({check.horizon:g} s) can give",
        columns=columns("parameter", "value", "σ", "relative σ", "wanted σ", "repetitions", "time"),
        rows=tuple(_check_row(row) for row in check.rows),
    )


def _check_row(row: ParameterCheck) -> Row:
    """Return the row of one parameter."""
    name = Name(name=row.name, unit=row.unit)
    value = Quantity(value=row.value, digits=4)
    if row.nuisance:
        return Row(cells=(name, value, "nuisance", "", "", "", ""), emphasis=Emphasis.WEAK)

    alone = bool(np.isfinite(row.std))
    relative = 100.0 * row.relative if alone and np.isfinite(row.relative) else float("nan")
    cells = (
        name,
        value,
        Quantity(value=row.std, infinite=NOT_ALONE),
        Quantity(value=relative, suffix=" %"),
        f"{row.wanted:.3g}{'' if row.stated else ' (5 %)'}",
        f"{row.repetitions:,}" if row.repetitions else "-",
        f"{row.seconds:,.0f} s" if row.repetitions else "-",
    )
    return Row(cells=cells, emphasis=Emphasis.NORMAL if alone else Emphasis.WARNING)


def _group_lines(group: ParameterGroup, check: Check) -> str:
    """Return the members of a group, and a line per combination with its value and its σ."""
    if not group.combinations:
        return str(group)

    accuracy_of = {c.expression: f" = {c.value:.4g} ± {c.std_final:.2g}" for c in check.combined}
    members = ", ".join(group.members)
    lines = [
        f"  {combination}{accuracy_of.get(str(combination), '')}"
        for combination in group.combinations
    ]
    return "\n".join([f"{members} only as", *lines])


def _eigenvalue_sentence(check: Check) -> str:
    """Return the eigenvalues of the information, of many the smallest and the largest ones."""
    values, selection = check.eigenvalues, ""
    if len(values) > MAX_LISTED_EIGENVALUES:
        values = np.concatenate([values[:4], values[-2:]])
        selection = " (smallest four, largest two)"
    listed = ", ".join(f"{value:.3g}" for value in values)
    return f"eigenvalues{selection}: {listed}; condition {check.condition:.3g}"


def _self_test_sentence(check: Check) -> str:
    """Return the result of the derivative self-test."""
    test = check.self_test
    if not test.finished:
        return "derivative self-test not finished, because the check was interrupted"

    passed = "passed" if test.passed else "FAILED"
    agreement = "agree" if test.roughness is None else "disagree"
    return (
        f"derivative self-test {passed}: relative error of psi {test.recursion:.1e}, of the slope "
        f"{test.slope:.1e}; two step sizes {agreement}"
    )


# ---- comparisons


def describe_comparison(comparison: Comparison) -> Summary:
    """Describe the result of each method with equal budgets, and which is the best.

    Methods are in the order in which they ran.

    Args:
        comparison: The comparison.
    """
    parts: list[Part] = [_method_table(comparison)]
    if len(comparison.wanted) <= MAX_COLUMNS:
        parts.append(_method_accuracy_table(comparison))

    for row in comparison.rows:
        remarks = [] if row.sound else [row.outcome.value]
        remarks += [row.note] if row.note else []
        if remarks:
            parts.append(Paragraph(text=f"{row.title}: {'; '.join(remarks)}"))

    legend = (
        "worst σ: standard deviation of the worst combination of parameters, relative to their "
        "scales; worst margin: smallest margin of all limits, in percent of half of the range."
    )
    parts.append(Paragraph(text=f"{legend} {BEST_CASE}", emphasis=Emphasis.WEAK))
    emphasis = Emphasis.STRONG if comparison.ok else Emphasis.STRONG_WARNING
    parts += [Paragraph(text=sentence, emphasis=emphasis) for sentence in comparison.verdict]
    return Summary(title="", outcome="", parts=tuple(parts))


def budget_in_words(comparison: Comparison) -> str:
    """Return the time and the MuJoCo steps that each method had.

    Args:
        comparison: The comparison.
    """
    budget = f"{comparison.seconds:g} s"
    if np.isfinite(comparison.steps):
        budget += f" or {comparison.steps / 1e6:.3g} million MuJoCo steps"
    return budget


def _method_table(comparison: Comparison) -> SummaryTable:
    """Tabulate cost, criterion, worst standard deviation, effort and margin of each method."""
    headings = ["method"]
    if comparison.weighted:
        headings.append("J")
    headings += [f"φ ({comparison.criterion})", "J against design", "worst σ"]
    headings += ["time", "steps", "worst margin"]
    return SummaryTable(
        key="methods",
        title=f"{comparison.source}: each method with {budget_in_words(comparison)}",
        columns=columns(*headings),
        rows=tuple(
            Row(cells=_method_cells(comparison, row), emphasis=_method_emphasis(comparison, row))
            for row in comparison.rows
        ),
        unbroken=True,
    )


def _method_cells(comparison: Comparison, row: MethodResult) -> tuple[Cell, ...]:
    """Return the cells of one method."""
    design, (kind, relative_margin) = comparison.design, row.tightest

    against_design = ""
    if design is not None and row is not design and not np.isnan(row.cost):
        against_design = f"{-100 * comparison.gain(row, design):+.3g} %"
    margin = "-"
    if kind and np.isfinite(relative_margin):
        margin = f"{100.0 * relative_margin:.2g} % {kind.replace('_', ' ')}"

    costs = [Quantity(value=row.criterion, digits=4)]
    if comparison.weighted:
        costs.insert(0, Quantity(value=row.cost, digits=4))
    return (
        _method_title(comparison, row),
        *costs,
        against_design,
        Quantity(value=row.worst_relative_std),
        f"{row.seconds:.1f} s",
        f"{row.steps / 1e6:.2f} M",
        margin,
    )


def _method_accuracy_table(comparison: Comparison) -> SummaryTable:
    """Tabulate every method's standard deviations."""
    rows = []
    for row in comparison.rows:
        cells = [Quantity(value=float(row.std[j])) for j in comparison.wanted]
        rows.append(
            Row(
                cells=(_method_title(comparison, row), *cells),
                emphasis=_method_emphasis(comparison, row),
            )
        )

    names = [
        Column(heading=Name(name=comparison.parameters[j], unit=comparison.units[j]))
        for j in comparison.wanted
    ]
    return SummaryTable(
        key="accuracy",
        title="σ of each parameter",
        columns=(*columns("method"), *names),
        rows=tuple(rows),
        unbroken=True,
    )


def _method_title(comparison: Comparison, row: MethodResult) -> str:
    """Return a method's title; the best method has an arrow."""
    return ("▶ " if row is comparison.best else "  ") + row.title


def _method_emphasis(comparison: Comparison, row: MethodResult) -> Emphasis:
    """Return the emphasis of a method.

    It is strong for the design, a warning for better methods, and weak for unusable results.
    """
    if not row.sound:
        return Emphasis.WEAK
    if row.method == DESIGN:
        return Emphasis.STRONG
    return Emphasis.WARNING if row in comparison.beating else Emphasis.NORMAL


# ---- robustness


def describe_robustness(result: Robustness) -> Summary:
    """Describe estimates and margins of a design on robots that differ from the model.

    Args:
        result: The study.
    """
    sentences = [Paragraph(text=f"• {sentence}") for sentence in robustness_sentences(result)]
    return Summary(
        title="A design played on robots that differ from the model",
        outcome="",
        parts=(_unknown_table(result), _limit_table(result), *sentences),
    )


def _unknown_table(result: Robustness) -> SummaryTable:
    """Tabulate the errors of the guess, of the prediction and of the estimate by unknown."""
    rows = []
    for j, name in enumerate(result.names):
        errors = (result.wrong[j], result.predicted[j], result.formal[j], result.observed[j])
        inside = int(result.inside[j])
        alone = bool(np.isfinite(result.formal[j]))
        covered = alone and inside >= REQUIRED_COVERAGE * result.runs
        rows.append(
            Row(
                cells=(
                    Name(name=name, unit=result.units[j]),
                    *(f"{error:.3g}" if np.isfinite(error) else "-" for error in errors),
                    str(inside) if alone else "in combination only",
                ),
                emphasis=Emphasis.NORMAL if covered or not alone else Emphasis.WARNING,
            )
        )

    return SummaryTable(
        key="unknowns",
        title=f"Accuracy of {result.runs} robots, each identified from the guess",
        columns=columns(
            "unknown",
            "error of guess",
            "σ predicted",
            "σ formal",
            "rms error",
            f"in 95 % interval, of {result.runs}",
        ),
        rows=tuple(rows),
    )


def _limit_table(result: Robustness) -> SummaryTable:
    """Tabulate the tightest limit of every kind."""
    worst = result.margins.min(axis=0)
    rows = []
    for kind in dict.fromkeys(limit.kind for limit in result.limits):
        members = [i for i, limit in enumerate(result.limits) if limit.kind == kind]
        tightest = min(members, key=lambda i: float(worst[i]))
        kept = int(result.kept[:, members].all(axis=1).sum())
        shares = (result.planned[tightest], worst[tightest], result.lost[members].max())
        rows.append(
            Row(
                cells=(
                    kind,
                    result.limits[tightest].name,
                    *(f"{100 * share:.1f} %" for share in shares),
                    f"{kept} of {result.runs}",
                ),
                emphasis=Emphasis.NORMAL if kept == result.runs else Emphasis.WARNING,
            )
        )

    return SummaryTable(
        key="limits",
        title="Margins of the limits, in percent of half of each range; negative: exceeded",
        columns=columns(
            "limit",
            "tightest",
            "planned",
            "worst robot",
            "largest loss",
            "robots that keep it",
            left=["tightest"],
        ),
        rows=tuple(rows),
    )


def robustness_sentences(result: Robustness) -> Iterator[str]:
    """Yield the conclusions of a robustness study.

    Args:
        result: The study.

    Yields:
        Sentences on the intervals, on doubtful fits, on the limits, and on the reserve that a
        design needs.
    """
    yield from _coverage_sentences(result)
    for sentence, count in result.troubles.items():
        yield f"{count} of {result.runs} runs: {sentence}"
    yield from _limit_sentences(result)

    reserve = result.reserve()
    if reserve:
        needed = " ".join(f"{kind}={share:g}" for kind, share in reserve.items())
        yield (
            "such robots keep the limits if the design stays away from them by these shares of "
            f"half of each range: {needed} (make such a design with --reserve {needed})"
        )


def _coverage_sentences(result: Robustness) -> Iterator[str]:
    """Yield sentences on the intervals and on the fits."""
    n = result.runs
    low, high = (int(k) for k in binom.interval(0.99, n, CONFIDENCE))
    inside = result.inside[result.identified]
    stated, every = result.joint
    yield (
        f"95 % intervals hold the true value in {inside.min(initial=n)} to {inside.max(initial=0)} "
        f"of {n} runs (expected by chance: {low} to {high})"
    )
    yield (
        f"joint 95 % regions hold the true values of the experiment's parameters in {stated}, and "
        f"of all unknowns in {every} of {n} runs"
    )
    yield (
        f"fits: mean chi2 / dof {result.fit:.3f}, {result.misfits} misfits, {result.restarted} "
        "repeated from other initial guesses"
    )


def _limit_sentences(result: Robustness) -> Iterator[str]:
    """Yield how many robots keep all limits, and a sentence for every limit that some do not."""
    yield f"{result.all_kept} of {result.runs} robots keep all limits at every engine step"

    worst = result.margins.min(axis=0)
    missed = ~result.kept.all(axis=0)
    for i in np.flatnonzero(missed).tolist():
        limit = result.limits[i]
        excess = -worst[i] * limit.scale
        manner = f"exceeded by up to {excess:.3g}" if excess > 0.0 else "reached and clamped"
        yield f"{limit.kind} of {limit.name} is {manner}"


# ---- campaigns


def describe_campaign(campaign: Campaign, parameters: ParameterSet, *, simulated: bool) -> Summary:
    """Describe the estimate after the last round of a campaign.

    Args:
        campaign: The campaign.
        parameters: The parameters of the experiment.
        simulated: True if the recordings were simulated at the true values.

    Returns:
        The estimates and the status; before the first estimate, the status alone.
    """
    status = Paragraph(text=str(campaign))
    if campaign.estimate is None:
        return Summary(title="Campaign", outcome="", parts=(status,))

    headings = ["parameter", "guess", "estimate", "formal σ", "wanted σ"]
    if simulated:
        headings.append("error")

    rows = []
    for j in parameters.interest.tolist():
        true = float(parameters.true[j]) if simulated else None
        rows.append(_campaign_row(campaign, campaign.estimate, parameters, j=j, true=true))

    table = SummaryTable(
        key="campaign", title="Estimates", columns=columns(*headings), rows=tuple(rows)
    )
    return Summary(title="Campaign", outcome="", parts=(table, status))


def _campaign_row(
    campaign: Campaign,
    estimate: Estimate,
    parameters: ParameterSet,
    *,
    j: int,
    true: float | None,
) -> Row:
    """Return the row of parameter j; `true` is its true value, None if that is not known."""
    value, std = float(estimate.theta[j]), float(estimate.std[j])
    wanted = float(campaign.wanted[j])
    cells = [
        estimate.parameters[j],
        f"{parameters.guess[j]:.5g}",
        f"{value:.5g}",
        f"{std:.2g}",
        f"{wanted:.2g}" if np.isfinite(wanted) else "-",
    ]
    if true is not None:
        cells.append(f"{(value - true) / std:+.1f} σ")
    emphasis = Emphasis.NORMAL if std <= wanted else Emphasis.WARNING
    return Row(cells=tuple(cells), emphasis=emphasis)
