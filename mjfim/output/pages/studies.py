"""The pages of studies: campaigns, robots, methods, Monte Carlo, and the equation of motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import PurePath

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import first_ones
from mjfim.output.page import (
    IDENTIFIED,
    NOMINAL,
    Emphasis,
    Listing,
    Page,
    Part,
    Plot,
    Row,
    Table,
    Text,
    as_sentence,
    capitalised,
    named,
    number,
    numbers,
    parameter_names,
    shown_word,
    tabulated,
    warned,
)
from mjfim.output.words import BEST_CASE, NOT_ALONE, relative
from mjfim.records.base import Level, Verdict
from mjfim.records.estimate_parts import InverseDynamicsFit, ResidualForce
from mjfim.records.robots import RobotComparison, p_text
from mjfim.records.studies import (
    DESIGN,
    Campaign,
    CampaignStatus,
    Comparison,
    MethodResult,
    MonteCarloStudy,
    TrialStatistics,
)
from mjfim.records.worth import Watch

# What to do after a campaign, by how it ended.
AFTER_CAMPAIGN = {
    CampaignStatus.WAITING: (
        "Play `round_{}/design.csv` on the robot, record it, and repeat the call with "
        "`--recordings FILE`."
    ),
    CampaignStatus.REACHED: "Use `identified.xml`, the model with the estimated parameters.",
    CampaignStatus.EXHAUSTED: (
        "Allow more rounds with `--rounds`, or state larger `wanted` values."
    ),
}

# How good a campaign is by how it ended; otherwise it is doubtful.
CAMPAIGN_LEVELS = {
    CampaignStatus.REACHED: Level.GOOD,
    CampaignStatus.WAITING: Level.GOOD,
    CampaignStatus.INFEASIBLE: Level.BAD,
}


# ---- campaign


def campaign_page(campaign: Campaign, true: Array | None = None) -> Page:
    """Describe the estimate after the last round of a campaign.

    Args:
        campaign: The campaign.
        true: (p,) true values of its parameters [theta-unit], where they are known.
    """
    facts: dict[str, str] = {"rounds": str(len(campaign.rounds))}
    sections: dict[str, Sequence[Part]] = {}
    if campaign.rounds:
        sections = {
            "Parameters": [_campaign_table(campaign, true)],
            "Rounds": [Plot("campaign")],
        }
        last = campaign.rounds[-1].estimate
        facts["recordings"] = str(len(last.recordings))
        facts["χ²/dof of the last fit"] = f"{last.chi2 / max(last.dof, 1):.3f}"
    step = AFTER_CAMPAIGN.get(campaign.status)
    level = CAMPAIGN_LEVELS.get(campaign.status, Level.DOUBTFUL)
    if level is Level.GOOD and campaign.short:
        level = Level.DOUBTFUL
    return Page(
        kind="Campaign of designs and recordings",
        verdict=Verdict(as_sentence(campaign.words), level, campaign.reached),
        next_steps=() if step is None else (step.format(len(campaign.rounds) + 1),),
        warnings=campaign.warnings,
        facts=facts,
        sections=sections,
    )


def _campaign_table(campaign: Campaign, true: Array | None) -> Table:
    """Tabulate the last estimates beside the wanted standard deviations."""
    estimate, chosen = campaign.rounds[-1].estimate, campaign.interest
    values, std, wanted = estimate.theta[chosen], estimate.std[chosen], campaign.wanted[chosen]
    columns = {
        "parameter": parameter_names(estimate, chosen),
        NOMINAL: numbers(campaign.rounds[0].theta[chosen], 5),
        IDENTIFIED: numbers(values, 5),
        "formal σ": numbers(std, 2),
        "wanted σ": numbers(wanted, 2, infinite="-"),
    }
    if true is not None:
        errors = (values - true[chosen]) / std
        columns["error"] = [f"{error:+.1f} σ" for error in errors]
    return tabulated("Estimates", columns, warned(~(std <= wanted)))


# ---- two robots


def robots_page(comparison: RobotComparison) -> Page:
    """Describe which parameters of two robots differ, and which differences would be found."""
    first, second = comparison.names
    parts: list[Part] = []
    if comparison.changed:
        items = tuple(comparison.sentence(j) for j in comparison.changed)
        parts.append(Listing("Differences", items, Emphasis.STRONG))
    if comparison.parameters:
        parts += [_robot_table(comparison), Plot("robots")]
    limits = list(comparison.remarks)
    others = len(comparison.parameters) - len(comparison.changed)
    if comparison.changed and others:
        limits.append(
            f"no difference was found in the other {others} parameters, which is not a proof that "
            "they are equal: see which differences would have been found"
        )
    return Page(
        kind="Comparison of two robots",
        verdict=_robots_verdict(comparison),
        next_steps=tuple(_steps_after_robots(comparison)),
        warnings=tuple(limits),
        facts={
            f"recordings of {first}": str(comparison.recordings[0]),
            f"recordings of {second}": str(comparison.recordings[1]),
            "compared parameters": str(len(comparison.parameters)),
            "all parameters together": p_text(comparison.joint_p),
        },
        sections={"Differences": parts},
    )


def _robots_verdict(comparison: RobotComparison) -> Verdict:
    text = comparison.words
    if not comparison.parameters:
        return Verdict(text, Level.BAD)
    if not comparison.is_reliable:
        return Verdict(f"With reservations (see the warnings): {text}", Level.DOUBTFUL)
    is_doubtful = comparison.differs or comparison.doubtful
    ok = not comparison.differs
    return Verdict(text, Level.DOUBTFUL if is_doubtful else Level.GOOD, ok)


def _steps_after_robots(comparison: RobotComparison) -> Iterator[str]:
    if not comparison.is_reliable:
        yield "Let `mjfim identify --select` add what the model lacks, for both robots alike."
    if min(comparison.recordings) < 2:
        yield "Record each robot two or more times: this shows how much its recordings scatter."
    if not comparison.differs:
        yield (
            "Smaller differences are found with longer recordings, or with a motion from "
            "`mjfim design`."
        )


def _robot_table(comparison: RobotComparison) -> Table:
    """Tabulate the parameters of both robots, the most significant difference first."""
    order = comparison.order.tolist()
    low, high = comparison.interval[order].T
    robots = dict(
        zip(comparison.names, (numbers(v, 4) for v in comparison.values[:, order]), strict=True)
    )
    return tabulated(
        "Parameters of both robots",
        {
            "parameter": parameter_names(comparison, order),
            **robots,
            "difference": numbers(comparison.difference[order]),
            "95 % low": numbers(low),
            "high": numbers(high),
            "p": [p_text(p).removeprefix("p = ") for p in comparison.p[order]],
            "would be found": numbers(comparison.detectable[order], 2),
        },
        warned(j in comparison.changed for j in order),
        spare=("95 % low", "high"),
        note=(
            "p: probability of a difference as large between equal robots, corrected for the "
            "number of tests; would be found: difference that would have been found with a "
            f"probability of 80 % (at p = {comparison.level:g})."
        ),
    )


# Relative difference above which a factor is easier to read than percent.
LARGE_DIFFERENCE = 10.0

# Largest number of parameters for which covariance matrices are shown; of more, variances only.
MAX_MATRIX = 5


# ---- comparison of methods

# What two columns hold.
LEGEND = (
    "worst σ: standard deviation of the worst combination of parameters, relative to their scales; "
    "worst margin: smallest margin of all limits, in percent of half of the range."
)


def comparison_page(comparison: Comparison) -> Page:
    """Describe the result of each method with equal budgets, and which is the best."""
    parts: list[Part] = [_method_table(comparison), Plot("compare")]
    for row in comparison.rows:
        remarks = "; ".join(filter(None, ["" if row.sound else row.outcome.value, row.note]))
        if remarks:
            parts.append(Text(f"{row.title}: {remarks}"))
    parts += [Text(f"{LEGEND} {BEST_CASE}", Emphasis.WEAK), _std_table(comparison)]
    steps: tuple[str, ...] = (
        "Rehearse a design before a robot plays it: `mjfim design EXPERIMENT -o FOLDER`. No "
        "control of this comparison was rehearsed; each is a table beside this file.",
    )
    if comparison.beating:
        name = comparison.beating[0].title
        steps = (
            f"Begin a design at the control of {name}: state its table as `initial.control`.",
            "Give all methods more time with `--seconds`.",
        )
    return Page(
        kind="Comparison with other excitations",
        verdict=_verdict_on_design(comparison),
        next_steps=steps,
        warnings=comparison.findings[1:],
        facts={
            "criterion": comparison.criterion,
            "methods": str(len(comparison.rows)),
            "budget of each": budget_in_words(comparison),
            "seed": str(comparison.seed),
        },
        sections={"Methods": parts},
    )


def _verdict_on_design(comparison: Comparison) -> Verdict:
    """Say whether the design is the best method."""
    design = comparison.design
    is_sound = design is not None and design.sound and not comparison.interrupted
    ok = is_sound and not comparison.beating
    return Verdict(comparison.findings[0], Level.GOOD if ok else Level.DOUBTFUL, ok)


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
    design = comparison.design
    kind, relative_margin = row.tightest
    against_design = ""
    if design is not None and row is not design and not np.isnan(row.cost):
        share = -comparison.gain(row, design)
        percent = f"{100.0 * share:+.3g} %"
        against_design = percent if share < LARGE_DIFFERENCE else f"× {1.0 + share:.3g}"
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
            number(100.0 * relative_margin, 2, f" % {kind.replace('_', ' ')}", infinite="-"),
        ),
        emphasis if row.sound else Emphasis.WEAK,
    )


def _std_table(comparison: Comparison) -> Table:
    wanted = list(comparison.wanted)
    names = parameter_names(comparison, wanted)
    std = {row.title: numbers(row.std[wanted]) for row in comparison.rows}
    return tabulated("σ of each parameter", {"parameter": names, **std}, detail=True)


# ---- Monte Carlo study


def study_page(study: MonteCarloStudy) -> Page:
    """Describe the observed scatter of estimates beside the Cramér-Rao bound."""
    names = list(map(named, study.parameters, study.labels.parameter_units))
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
        sections={
            "Efficiency": [
                Text(f"Efficiency of the estimates: {', and '.join(ranges)} (1 is the best)"),
                *(_efficiency_table(study, name, names) for name in study.sets),
                Plot("overview"),
                Text(legend, Emphasis.WEAK),
            ],
            "Estimates": [Plot("histogram")],
            "Covariance": _covariance_tables(study, names),
        },
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
        return Verdict(text, Level.DOUBTFUL, ok=True)
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
    return Verdict(text, Level.GOOD, ok=True)


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


# Residuals above this share of the forces are a warning.
LARGE_SHARE = 0.2


def equation_page(fit: InverseDynamicsFit) -> Page:
    """Describe a fit to the equation of motion."""
    verdict = _equation_verdict(fit)
    steps = ('Identify with `fit.start = "inverse_dynamics"`, which predicts the motion itself.',)
    if verdict.level is not Level.GOOD:
        steps = ("Look at `residual_torque.png`: friction, signs and units of the forces, delays.",)
    std = [
        number(value, 2, infinite="-" if name in fit.absent else NOT_ALONE)
        for name, value in zip(fit.parameters, fit.std, strict=True)
    ]
    table = tabulated(
        "Parameters",
        {
            "parameter": parameter_names(fit),
            "start": numbers(fit.start, 4),
            "estimate": numbers(fit.theta, 5),
            "formal σ": std,
        },
    )
    return Page(
        kind="Parameters fitted to the equation of motion",
        verdict=verdict,
        next_steps=steps,
        sections={
            "Parameters": [Text(capitalised(fit.status)), table],
            "Equation of motion": equation_parts(fit),
        },
    )


def _equation_verdict(fit: InverseDynamicsFit) -> Verdict:
    worst = max(fit.equations, key=lambda each: float(np.nan_to_num(each.share)))
    share = f"{100.0 * worst.share:.2g} %"
    if not fit.converged:
        return Verdict(f"The fit to the equation of motion {fit.status}.", Level.BAD)
    if not worst.share <= LARGE_SHARE:
        text = f"The equation of motion of {worst.name} does not hold: residuals are {share} of it."
        return Verdict(text, Level.DOUBTFUL)
    text = f"The equation of motion holds: residuals are at most {share} of the forces."
    return Verdict(text, Level.GOOD, ok=True)


def equation_parts(fit: InverseDynamicsFit) -> Iterator[Part]:
    """Yield the table of the equations, and what the fit does not determine."""
    found = fit.equations
    yield tabulated(
        "Equation of motion: forces that the measured motion needs, and those of the motors",
        {
            "equation": [named(each.name, each.unit) for each in found],
            "residual": numbers([each.residual for each in found]),
            "of the force": numbers([100.0 * each.share for each in found], suffix=" %"),
            "rows": [str(each.rows) for each in found],
            "up to [Hz]": numbers([each.cutoff for each in found], 2),
        },
        warned(not each.share <= LARGE_SHARE for each in found),
        spare=("rows",),
        note="residual: root mean square of averages over short windows",
    )
    text = (
        f"The equation of motion along the recordings determines {fit.determined} combinations of "
        f"{len(fit.parameters) - len(fit.absent)} parameters (condition number "
        f"{fit.condition:.3g})."
    )
    if fit.undetermined:
        text += f" Not alone: {first_ones(fit.undetermined)}."
    if fit.absent:
        text += f" It does not contain {first_ones(fit.absent)}, which keep their start."
    yield Text(text)
    text = (
        "The standard deviations of a fit to the equation of motion are formal: they contain "
        "neither the bias by noise in velocities and accelerations nor that by a wrong model."
    )
    yield Text(text, Emphasis.WEAK, detail=True)
    yield from residual_parts(fit.residual_forces)


def residual_parts(found: Sequence[ResidualForce]) -> Sequence[Part]:
    """Forces that the model does not explain at each joint: a table and a picture."""
    if not found:
        return ()
    frictions = np.array([each.friction for each in found])
    table = tabulated(
        "Residual torque: forces of the actuators less those that the measured motion needs",
        {
            "joint": [named(each.joint, each.unit) for each in found],
            "rms": numbers([each.rms for each in found], 2),
            "by noise": numbers([each.sigma for each in found], 2),
            "of the force": numbers([100.0 * each.share for each in found], 2, " %"),
            "dry friction": numbers(frictions[:, 0], 2),
            "viscous": numbers(frictions[:, 1], 2),
        },
        spare=("of the force",),
        note=(
            "dry friction that the model lacks: half of the step between the two directions; "
            "viscous: slope over the speed, per m/s or rad/s"
        ),
        detail=True,
    )
    return (table, Plot("residual_torque"))


# ---- live meter

# Time after which nobody waits for more rows of this kind [s].
LONG_SECONDS = 3600.0


def watch_page(watch: Watch) -> Page:
    """Describe how accurate the parameters are by the rows so far; open ones come first."""
    level = Level.GOOD if watch.enough else Level.DOUBTFUL
    return Page(
        kind="Live meter",
        verdict=Verdict(progress_of_watch(watch), level, watch.enough),
        warnings=watch.warnings,
        facts={"rows": str(watch.rows), "duration": f"{watch.seconds:.1f} s"},
        sections={"Accuracy so far": [_table_of_watch(watch), Plot("watch")]},
    )


def _table_of_watch(watch: Watch) -> Table:
    """Tabulate σ so far, that of open parameters first."""
    order = np.argsort(np.isfinite(watch.reached), kind="stable")
    std, wanted, reached = watch.std[order], watch.wanted[order], watch.reached[order]
    title = f"After {watch.seconds:.1f} s, {watch.rows} rows"
    if watch.left_out:
        title += f"; faulty rows, left out: {watch.left_out}"
    return tabulated(
        title,
        {
            "parameter": parameter_names(watch, order),
            "σ now": numbers(std, infinite=NOT_ALONE),
            "of the value": list(map(relative, std, watch.sizes[order])),
            "wanted": numbers(wanted, infinite=""),
            "enough": [f"at {t:.1f} s" if np.isfinite(t) else "" for t in reached],
        },
        warned(np.isfinite(wanted) & np.isinf(reached)),
        spare=("of the value",),
        note=f"At the guess. {BEST_CASE}",
    )


def progress_of_watch(watch: Watch) -> str:
    """Say how many parameters are known well enough, and how long the slowest one needs."""
    asked = watch.asked
    reached = np.isfinite(watch.reached[asked])
    if reached.all():
        when = watch.reached[asked].max(initial=0.0)
        return f"Enough after {when:.1f} s, in the best case: every parameter reaches {watch.goal}."
    ratio = np.where(reached, 0.0, watch.std[asked] / watch.wanted[asked])
    slowest = int(asked[np.argmax(ratio)])
    name, left = watch.parameters[slowest], watch.seconds_left[slowest]
    if np.isinf(watch.std[slowest]):
        needs = f"the rows so far do not determine {name} alone"
    elif left > LONG_SECONDS:
        needs = f"the last seconds tell hardly anything about {name}"
    else:
        needs = f"{name} needs about {left:.2g} s more at this rate"
    return f"{int(reached.sum())} of {len(asked)} reach {watch.goal}; {needs}."
