"""The pages of a comparison of methods and of a Monte Carlo study."""

from __future__ import annotations

from pathlib import PurePath

import numpy as np

from mjfim.output.labels import complete_labels
from mjfim.output.page import (
    Emphasis,
    Level,
    Page,
    Part,
    Plot,
    Row,
    Section,
    Table,
    Text,
    Verdict,
    named,
    number,
    numbers,
    tabulated,
)
from mjfim.output.pages.accuracy import BEST_CASE
from mjfim.output.vocabulary import shown_word
from mjfim.records.comparison import DESIGN, Comparison, MethodResult
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics

# Relative difference above which a factor is easier to read than percent.
LARGE_DIFFERENCE = 10.0

# Largest number of parameters for which covariance matrices are shown; of more, variances only.
MAX_MATRIX = 5


# ---- comparison of methods


def comparison_page(comparison: Comparison) -> Page:
    """Describe the result of each method with equal budgets, and which is the best."""
    parts: list[Part] = [_method_table(comparison), Plot("compare")]
    for row in comparison.rows:
        remarks = [each for each in ("" if row.sound else row.outcome.value, row.note) if each]
        if remarks:
            parts.append(Text(f"{row.title}: {'; '.join(remarks)}"))
    legend = (
        "worst σ: standard deviation of the worst combination of parameters, relative to their "
        "scales; worst margin: smallest margin of all limits, in percent of half of the range."
    )
    parts += [Text(f"{legend} {BEST_CASE}", Emphasis.WEAK), _std_table(comparison)]
    steps: tuple[str, ...] = (
        "Play the control of the best method; every control is a table beside this file.",
    )
    if comparison.beating:
        name = comparison.beating[0].title
        steps = (
            f"Begin a design at the control of {name}: state its table as `initial.control`.",
            "Give all methods more time with `--seconds`.",
        )
    return Page(
        kind="Comparison with other excitations",
        verdict=Verdict(comparison.verdict[0], Level.GOOD if comparison.ok else Level.DOUBTFUL),
        next_steps=steps,
        warnings=comparison.verdict[1:],
        facts={
            "criterion": comparison.criterion,
            "methods": str(len(comparison.rows)),
            "budget of each": budget_in_words(comparison),
            "seed": str(comparison.seed),
        },
        sections=[Section("Methods", parts)],
    )


def budget_in_words(comparison: Comparison) -> str:
    """Return the time that each method had."""
    return f"{comparison.seconds:g} s"


def _method_table(comparison: Comparison) -> Table:
    """Tabulate cost, criterion, worst standard deviation, effort and margin of each method."""
    cost = ["J"] if comparison.weighted else []
    return Table(
        title=f"{PurePath(comparison.source).name}: each method with {budget_in_words(comparison)}",
        columns=(
            "method",
            *cost,
            f"φ ({comparison.criterion})",
            "J against design",
            "worst σ",
            "time",
            "steps",
            "worst margin",
        ),
        rows=tuple(_method_row(comparison, row) for row in comparison.rows),
        spare=("time", "steps"),
    )


def _method_row(comparison: Comparison, row: MethodResult) -> Row:
    """The row of one method; the best method has an arrow."""
    design, (kind, relative_margin) = comparison.design, row.tightest
    against_design = ""
    if design is not None and row is not design and not np.isnan(row.cost):
        share = -comparison.gain(row, design)
        against_design = f"{100.0 * share:+.3g} %"
        if share >= LARGE_DIFFERENCE:
            against_design = f"× {1.0 + share:.3g}"
    margin = "-"
    if kind and np.isfinite(relative_margin):
        margin = f"{100.0 * relative_margin:.2g} % {kind.replace('_', ' ')}"
    emphasis = Emphasis.WARNING if row in comparison.beating else Emphasis.NORMAL
    if row.method == DESIGN:
        emphasis = Emphasis.STRONG
    return Row(
        (
            ("▶ " if row is comparison.best else "") + row.title,
            *([number(row.cost, 4)] if comparison.weighted else []),
            number(row.criterion, 4),
            against_design,
            number(row.worst_relative_std),
            f"{row.seconds:.1f} s",
            f"{row.steps / 1e6:.2f} M",
            margin,
        ),
        emphasis if row.sound else Emphasis.WEAK,
    )


def _std_table(comparison: Comparison) -> Table:
    """Tabulate the standard deviation of every parameter with every method."""
    wanted = list(comparison.wanted)
    names = [named(comparison.parameters[j], comparison.units[j]) for j in wanted]
    std = {row.title: numbers(row.std[wanted]) for row in comparison.rows}
    return tabulated("σ of each parameter", {"parameter": names, **std}, detail=True)


# ---- Monte Carlo study


def study_page(study: MonteCarloStudy) -> Page:
    """Describe the observed scatter of estimates beside the Cramér-Rao bound."""
    names = [
        named(name, unit)
        for name, unit in zip(study.parameters, complete_labels(study).parameter_units, strict=True)
    ]
    ranges = [
        f"{min(trials.efficiency):.2f} to {max(trials.efficiency):.2f} in {trials.trials:,} trials "
        f"along the {shown_word(name)} trajectory"
        for name, trials in study.sets.items()
    ]
    legend = "efficiency = Cramér-Rao bound / observed variance; 1 means that the bound is reached."
    verdict = _study_verdict(study)
    steps = ("Play the design on the robot: `mjfim export DESIGN_FOLDER --to player -o FILE`.",)
    if verdict.level is not Level.GOOD:
        steps = (
            "Shorter segments (`fit.segments`) or more starts (`fit.starts`) help fits that end in "
            "a local minimum; a smaller noise brings the estimator closer to its bound.",
        )
    return Page(
        kind="Monte Carlo study of the estimates",
        verdict=verdict,
        next_steps=steps,
        facts={
            **{f"trials, {shown_word(name)}": str(t.trials) for name, t in study.sets.items()},
            "rate of the measurements": f"{study.measure_rate:g} Hz",
        },
        sections=[
            Section(
                "Efficiency",
                [
                    Text(f"Efficiency of the estimates: {', and '.join(ranges)} (1 is the best)"),
                    *(_efficiency_table(study, name, names) for name in study.sets),
                    Plot("overview"),
                    Text(legend, Emphasis.WEAK),
                ],
            ),
            Section("Estimates", [Plot("histogram")]),
            Section("Covariance", _covariance_tables(study, names)),
        ],
    )


def _study_verdict(study: MonteCarloStudy) -> Verdict:
    failed = [
        f"{trials.failed} of {trials.trials} ({shown_word(name)})"
        for name, trials in study.sets.items()
        if trials.failed
    ]
    if failed:
        return Verdict(f"Some fits failed: {', '.join(failed)}.", Level.DOUBTFUL)
    below = [shown_word(name) for name, trials in study.sets.items() if not _reaches_bound(trials)]
    if below:
        text = (
            f"Along the {' and '.join(below)} trajectory, the scatter of some estimates differs "
            "from the Cramér-Rao bound by more than chance."
        )
        return Verdict(text, Level.DOUBTFUL)
    agreement = "every efficiency agrees with 1"
    missing = sum(_missing_one(trials) for trials in study.sets.values())
    if missing:
        count = sum(len(trials.efficiency_interval) for trials in study.sets.values())
        agreement = (
            f"the efficiencies agree with 1 ({missing} of {count} intervals of 95 % "
            f"{'misses' if missing == 1 else 'miss'} it, as many as chance may cause)"
        )
    text = (
        f"The estimates scatter as predicted: {agreement}, so the σ of the design can be trusted "
        "if the model and the noise are right."
    )
    return Verdict(text, Level.GOOD)


def _missing_one(trials: TrialStatistics) -> int:
    """Count the 95 % intervals of efficiencies without 1."""
    low, high = trials.efficiency_interval.T
    return int(np.sum((low > 1.0) | (high < 1.0)))


def _reaches_bound(trials: TrialStatistics) -> bool:
    """Whether the efficiencies agree with 1; a few of the 95 % intervals may miss it by chance."""
    count = len(trials.efficiency_interval)
    allowed = int(np.ceil(0.05 * count)) if count > 1 else 0
    return _missing_one(trials) <= allowed


def _efficiency_table(study: MonteCarloStudy, trajectory: str, names: list[str]) -> Table:
    """Tabulate variance, bound and efficiency of every parameter along one trajectory."""
    trials = study.sets[trajectory]
    low, high = trials.efficiency_interval.T
    counts = f"{trials.trials} trials, {trials.failed} failed, {study.measure_rate:g} Hz"
    return tabulated(
        f"{shown_word(trajectory)}: {counts}",
        {
            "parameter": names,
            "true": numbers(study.theta, 4),
            "mean": numbers(trials.mean, 5),
            "variance": numbers(np.diag(trials.covariance), 4),
            "bound": numbers(np.diag(trials.crlb), 4),
            "efficiency": [f"{value:.3f}" for value in trials.efficiency],
            "95 % low": [f"{value:.3f}" for value in low],
            "high": [f"{value:.3f}" for value in high],
        },
        spare=("true", "mean"),
    )


def _covariance_tables(study: MonteCarloStudy, names: list[str]) -> list[Table]:
    """Tabulate covariance, information and bound; of many parameters, the variances only."""
    tables = []
    for trajectory, trials in study.sets.items():
        word = shown_word(trajectory)
        matrices = {
            "Monte Carlo covariance": trials.covariance,
            "Fisher information": study.information[trajectory],
            "Cramér–Rao bound": trials.crlb,
        }
        if len(names) > MAX_MATRIX:
            diagonals = {title: numbers(np.diag(matrix)) for title, matrix in matrices.items()}
            columns = {"parameter": names, **diagonals}
            tables.append(tabulated(f"Diagonals, {word}", columns, detail=True))
            continue
        for title, matrix in matrices.items():
            cells = dict(zip(study.parameters, map(numbers, matrix.T), strict=True))
            tables.append(tabulated(f"{title}, {word}", {"parameter": names, **cells}, detail=True))
    return tables
