"""The result of every verb in one sentence, and what the reader can do next."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import singledispatch

import numpy as np

from mjfim.errors import MjfimError, first_ones
from mjfim.output.summaries.accuracy import relative
from mjfim.output.summaries.inverse_dynamics import LARGE_SHARE
from mjfim.output.summaries.robustness import robustness_sentences
from mjfim.output.vocabulary import shown_word
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign, CampaignStatus
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.inverse_dynamics import InverseDynamicsFit
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.robots import RobotComparison
from mjfim.records.robustness import Robustness

# Ratio of two standard deviations above which one of them counts as smaller.
RELEVANT_RATIO = 1.05


class Level(Enum):
    """How good a result is."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    BAD = "bad"


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of a verb in one sentence.

    Attributes:
        text: The sentence.
        level: How good the result is.
    """

    text: str
    level: Level


@singledispatch
def verdict_of(record: ShownRecord) -> Verdict:
    """Say in one sentence what a result means.

    Args:
        record: The result of a verb.

    Raises:
        MjfimError: This kind of record has no verdict.
    """
    raise MjfimError(f"a {type(record).__name__} has no verdict")


@singledispatch
def next_steps(record: ShownRecord) -> tuple[str, ...]:
    """Say what the reader can do next, one sentence each, the most useful one first.

    Args:
        record: The result of a verb.

    Raises:
        MjfimError: This kind of record has no next steps.
    """
    raise MjfimError(f"a {type(record).__name__} has no next steps")


# ---- design


@verdict_of.register
def _(design: Design) -> Verdict:
    """The verdict on a design."""
    violated = [kind.replace("_", " ") for kind, margin in design.limits.items() if margin < 0.0]
    if violated:
        text = f"Do not play this motion: it violates limits ({first_ones(violated)})."
        return Verdict(text=text, level=Level.BAD)

    if not design.sound:
        return Verdict(text=f"The design is not ready: {design.outcome}.", level=Level.BAD)

    kept = "It keeps all limits" if design.limits else "No limits were stated"
    if not design.separable:
        text = (
            f"The design is made for combinations of parameters, because no control separates all "
            f"of them. {kept}."
        )
        return Verdict(text=text, level=Level.DOUBTFUL)

    reservation = _reservation(design)
    if reservation:
        text = f"This motion can be played, but {reservation}. {kept}."
        return Verdict(text=text, level=Level.DOUBTFUL)

    return Verdict(text=f"Ready to play: {_accuracy(design)}. {kept}.", level=Level.GOOD)


def _undetermined(design: Design) -> list[int]:
    """Numbers of the wanted parameters whose standard deviation exceeds their size."""
    std, sizes = design.final.std, design.sizes
    return [j for j in design.wanted if not np.isfinite(std[j]) or 0.0 < sizes[j] < std[j]]


def _reservation(design: Design) -> str:
    """Say which parameters a design does not determine; empty where it determines all of them."""
    found = _undetermined(design)
    if not found:
        return ""

    std, sizes = design.final.std, design.sizes
    worst = max(found, key=lambda j: float(std[j] / sizes[j]) if np.isfinite(std[j]) else np.inf)
    names = first_ones([design.parameters[j] for j in found])
    text = f"it does not determine {names}"
    if not np.isfinite(std[worst]):
        return text
    share = relative(float(std[worst]), float(sizes[worst]))
    of_one = f": σ is {share} of its size"
    return text + (of_one if len(found) == 1 else f"{of_one} for {design.parameters[worst]}")


def _accuracy(design: Design) -> str:
    """The accuracy of the parameter that a design determines worst, in words."""
    shares = design.final.std / np.where(design.sizes > 0.0, design.sizes, np.nan)
    wanted = [j for j in design.wanted if np.isfinite(shares[j])]
    seconds = float(design.trajectory.t[-1] - design.trajectory.t[0])
    if not wanted:
        return f"one experiment of {seconds:.3g} s determines every parameter"

    worst = max(wanted, key=lambda j: float(shares[j]))
    share = relative(float(design.final.std[worst]), float(design.sizes[worst]))
    sentence = (
        f"one experiment of {seconds:.3g} s determines every parameter with a σ of {share} or less"
    )
    before, after = float(design.initial.std[worst]), float(design.final.std[worst])
    if not np.isfinite(before):
        return f"{sentence}; the initial motion does not determine {design.parameters[worst]}"
    if before > RELEVANT_RATIO * after:
        times = before / after
        return (
            f"{sentence} (largest for {design.parameters[worst]}, {times:.3g} times smaller than "
            "with the initial motion)"
        )
    return f"{sentence} (largest for {design.parameters[worst]})"


@next_steps.register
def _(design: Design) -> tuple[str, ...]:
    """Return the next steps after a design."""
    return tuple(_steps_after_design(design))


def _steps_after_design(design: Design) -> Iterator[str]:
    """Yield the next steps after a design."""
    if not design.within_limits:
        yield "Widen the limit that is violated, or begin with an initial control that is smaller."
        return

    if not design.separable:
        groups = first_ones(design.combinations, "; ")
        yield (
            f"Remove or fix one parameter of each group, give it a prior, or measure another "
            f"output: {groups}."
        )
    if design.status is Status.ROUGH:
        yield (
            "Keep the motion away from contacts, dry friction and saturated actuators: begin with "
            "an initial control of smaller amplitude, or state narrower limits."
        )
    undetermined = _undetermined(design) if design.separable else []
    if undetermined:
        names = first_ones([design.parameters[j] for j in undetermined])
        yield (
            f"Determine {names} with a longer or larger motion, by measuring another output, or "
            "state what is known with `prior`."
        )
    if not design.status.success and design.status is not Status.ROUGH:
        yield "Allow more time or iterations in the table `[descent]` for a better design."
    if design.sound:
        yield "Export the motion for the robot: `mjfim export DESIGN_FOLDER --to player -o FILE`."
        yield "Record it, then estimate: `mjfim identify EXPERIMENT RECORDING -o FOLDER`."


# ---- estimate


@verdict_of.register
def _(estimate: Estimate) -> Verdict:
    """The verdict on an estimate, with the payload first where one was looked for."""
    fit = _verdict_on_fit(estimate)
    if estimate.payload is None or fit.level is Level.BAD:
        return fit
    return Verdict(text=f"{estimate.payload}. {fit.text}", level=fit.level)


def _verdict_on_fit(estimate: Estimate) -> Verdict:
    """The verdict on how an estimate explains the recordings."""
    ratio = float(np.sqrt(estimate.chi2 / max(estimate.dof, 1)))
    if not estimate.success:
        text = f"These estimates are not reliable: {_why_not_reliable(estimate)}."
        return Verdict(text=text, level=Level.BAD)

    # A search that is stopped early has not tried all that may explain the recordings.
    if estimate.interrupted:
        text = (
            "Interrupted: the estimates are the best ones that were found until then, and the "
            f"residuals are {ratio:.2f} times the noise."
        )
        return Verdict(text=text, level=Level.DOUBTFUL)

    if estimate.misfit:
        text = (
            f"{_model(estimate)} does not explain the recordings: the residuals are {ratio:.2f} "
            "times the noise or are no white noise, so the true errors may exceed the intervals."
        )
        return Verdict(text=text, level=Level.DOUBTFUL)

    model = _model(estimate)
    text = f"{model} explains the recordings: the residuals are {ratio:.2f} times the noise"
    return Verdict(text=f"{text}{_worst_estimate(estimate)}.", level=Level.GOOD)


def _model(estimate: Estimate) -> str:
    """The model as the subject of a sentence, with the terms that a selection added."""
    if estimate.selection is None or not estimate.selection.terms:
        return "The model"
    terms = first_ones([term.description for term in estimate.selection.terms])
    return f"With {terms} added, the model"


def _why_not_reliable(estimate: Estimate) -> str:
    """Why an estimate is not reliable, in words."""
    if estimate.combinations:
        return "the recordings determine some parameters in combination only"
    return estimate.status.removesuffix(".")


def _worst_estimate(estimate: Estimate) -> str:
    """The parameter whose interval is widest compared with its size, in words."""
    half_widths = 0.5 * (estimate.interval[:, 1] - estimate.interval[:, 0])
    sizes = estimate.sizes
    shares = half_widths / np.where(sizes > 0.0, sizes, np.nan)

    # A share of a value that may be zero says nothing.
    known = np.isfinite(shares) & (shares < 1.0)
    uncertain = [estimate.parameters[j] for j in np.flatnonzero(~known).tolist()]
    if not known.any():
        return ""

    worst = int(np.argmax(np.where(known, shares, -np.inf)))
    share = relative(float(half_widths[worst]), float(sizes[worst]))
    others = f" except {first_ones(uncertain)}, whose interval holds zero," if uncertain else ""
    return (
        f", and every parameter{others} is known to ± {share} or better (95 % interval, widest for "
        f"{estimate.parameters[worst]})"
    )


@next_steps.register
def _(estimate: Estimate) -> tuple[str, ...]:
    """Return the next steps after an estimate."""
    return tuple(_steps_after_estimate(estimate))


def _steps_after_estimate(estimate: Estimate) -> Iterator[str]:
    """Yield the next steps after an estimate."""
    for term in estimate.missing_terms[:1]:
        yield (
            f"Add the term that explains most of the residuals, {term.description}: "
            f"`{term.recipe}`."
        )
    if estimate.misfit and estimate.worst_residual is not None:
        yield f"Look where the model fails: {estimate.worst_residual}."
    if estimate.combinations:
        yield "Remove or fix one parameter of each group, give it a prior, or record other motions."
    if estimate.sloppy:
        names = first_ones(estimate.sloppy)
        yield f"Design an experiment that tells more about {names}: `mjfim design EXPERIMENT`."
    if not any(prediction.held_out for prediction in estimate.predictions):
        yield (
            "Keep a recording out of the fit with `--held-out FILE`: a prediction of new data is "
            "the best test of a model."
        )
    if estimate.success and not estimate.misfit:
        yield "Use `identified.xml`, the model with the estimated parameters."


# ---- check


@verdict_of.register
def _(check: Check) -> Verdict:
    """The verdict on an experiment."""
    level = Level.GOOD if check.ok else Level.DOUBTFUL
    if check.ok:
        shares = {row.name: row.relative for row in check.rows if not row.nuisance}
        worst = max(shares, key=lambda name: shares[name])
        text = (
            f"All parameters can be identified with {check.source}; the least accurate is {worst} "
            f"with a σ of {relative(shares[worst], 1.0)}."
        )
        return Verdict(text=text, level=level)

    first = check.verdict[0] if check.verdict else "the check found a fault"
    return Verdict(text=_as_sentence(first), level=level)


@next_steps.register
def _(check: Check) -> tuple[str, ...]:
    """Return the next steps after a check."""
    if check.refused or check.missing:
        return ()
    if check.not_separable:
        return (
            "Remove or fix one parameter of each group that is identifiable only in combination, "
            "give it a prior, or measure another output.",
        )
    return (
        "Design a motion that tells more: `mjfim design EXPERIMENT -o FOLDER`. A design that was "
        "made already is checked with `--design`.",
    )


# ---- studies


@verdict_of.register
def _(comparison: Comparison) -> Verdict:
    """The verdict on the methods that were compared."""
    level = Level.GOOD if comparison.ok else Level.DOUBTFUL
    return Verdict(text=comparison.verdict[0], level=level)


@next_steps.register
def _(comparison: Comparison) -> tuple[str, ...]:
    """Return the next steps after a comparison."""
    if not comparison.beating:
        return ("Play the control of the best method; every control is a table beside this file.",)
    name = comparison.beating[0].title
    return (
        f"Begin a design at the control of {name}: state its table as `initial.control`.",
        "Give all methods more time with `--seconds`.",
    )


@verdict_of.register
def _(fit: InverseDynamicsFit) -> Verdict:
    """The verdict on a fit to the equation of motion."""
    worst = max(fit.equations, key=lambda each: float(np.nan_to_num(each.share)))
    share = f"{100.0 * worst.share:.2g} %"
    if not fit.success:
        return Verdict(text=f"The fit to the equation of motion {fit.status}.", level=Level.BAD)
    if not worst.share <= LARGE_SHARE:
        text = f"The equation of motion of {worst.name} does not hold: residuals are {share} of it."
        return Verdict(text=text, level=Level.DOUBTFUL)
    text = f"The equation of motion holds: residuals are at most {share} of the forces."
    return Verdict(text=text, level=Level.GOOD)


@next_steps.register
def _(fit: InverseDynamicsFit) -> tuple[str, ...]:
    """Return the next steps after a fit to the equation of motion."""
    if verdict_of(fit).level is not Level.GOOD:
        return ("Look at the forces in `inverse_dynamics.png`: signs, units, delays, friction.",)
    return ('Identify with `fit.start = "inverse_dynamics"`, which predicts the motion itself.',)


@verdict_of.register
def _(study: MonteCarloStudy) -> Verdict:
    """The verdict on an estimator."""
    failed = [name for name, trials in study.sets.items() if trials.failed]
    if failed:
        counts = ", ".join(
            f"{study.sets[name].failed} of {study.sets[name].trials} ({shown_word(name)})"
            for name in failed
        )
        return Verdict(text=f"Some fits failed: {counts}.", level=Level.DOUBTFUL)

    below = [name for name, trials in study.sets.items() if not _reaches_bound(trials)]
    if below:
        shown = " and ".join(shown_word(name) for name in below)
        text = (
            f"Along the {shown} trajectory, the scatter of some estimates differs from the "
            "Cramér-Rao bound by more than chance."
        )
        return Verdict(text=text, level=Level.DOUBTFUL)

    agreement = "every efficiency agrees with 1"
    missing = sum(_missing_one(trials) for trials in study.sets.values())
    if missing:
        count = sum(len(trials.efficiency_interval) for trials in study.sets.values())
        agreement = (
            f"the efficiencies agree with 1 ({missing} of {count} intervals of 95 % "
            f"{'misses' if missing == 1 else 'miss'} it, as many as chance may cause)"
        )
    return Verdict(
        text=f"The estimates scatter as predicted: {agreement}, so the σ of the design can be "
        "trusted if the model and the noise are right.",
        level=Level.GOOD,
    )


def _missing_one(trials: TrialStatistics) -> int:
    """Count the 95 % intervals of efficiencies without 1."""
    low, high = trials.efficiency_interval.T
    return int(np.sum((low > 1.0) | (high < 1.0)))


def _reaches_bound(trials: TrialStatistics) -> bool:
    """Whether the efficiencies agree with 1; a few of the 95 % intervals may miss it by chance."""
    count = len(trials.efficiency_interval)
    allowed = int(np.ceil(0.05 * count)) if count > 1 else 0
    return _missing_one(trials) <= allowed


@next_steps.register
def _(study: MonteCarloStudy) -> tuple[str, ...]:
    """Return the next steps after a Monte Carlo study."""
    if verdict_of(study).level is Level.GOOD:
        return ("Play the design on the robot: `mjfim export DESIGN_FOLDER --to player -o FILE`.",)
    return (
        "Shorter segments (`fit.segments`) or more starts (`fit.starts`) help fits that end in a "
        "local minimum; a smaller noise brings the estimator closer to its bound.",
    )


@verdict_of.register
def _(result: Robustness) -> Verdict:
    """The verdict on a design that was played on robots that differ from the model."""
    kept = f"{result.all_kept} of {result.runs} robots keep all limits"
    covered = (
        "the 95 % intervals hold the true values often enough"
        if result.covered
        else "the 95 % intervals hold the true values too rarely"
    )
    level = Level.GOOD if result.ok else Level.DOUBTFUL
    return Verdict(text=f"{kept}, and {covered}.", level=level)


@next_steps.register
def _(result: Robustness) -> tuple[str, ...]:
    """Return the next steps after a robustness study."""
    if result.reserve():
        *_, advice = robustness_sentences(result)
        return (_as_sentence(advice),)
    if result.ok:
        return ("Play the design on the robot: `mjfim export DESIGN_FOLDER --to player -o FILE`.",)
    return ()


@verdict_of.register
def _(comparison: RobotComparison) -> Verdict:
    """The verdict on two robots."""
    text = str(comparison)
    if not comparison.parameters:
        return Verdict(text=text, level=Level.BAD)
    if not comparison.is_reliable:
        return Verdict(text=f"With reservations (see the warnings): {text}", level=Level.DOUBTFUL)
    return Verdict(text=text, level=Level.DOUBTFUL if comparison.differs else Level.GOOD)


@next_steps.register
def _(comparison: RobotComparison) -> tuple[str, ...]:
    """Return the next steps after a comparison of two robots."""
    return tuple(_steps_after_robots(comparison))


def _steps_after_robots(comparison: RobotComparison) -> Iterator[str]:
    """Yield the next steps after a comparison of two robots."""
    if not comparison.is_reliable:
        yield "Let `mjfim identify --select` add what the model lacks, for both robots alike."
    if min(comparison.recordings) < 2:
        yield "Record each robot two or more times: this shows how much its recordings scatter."
    if not comparison.differs:
        yield (
            "Smaller differences are found with longer recordings, or with a motion from "
            "`mjfim design`."
        )


@verdict_of.register
def _(campaign: Campaign) -> Verdict:
    """The verdict on a campaign."""
    levels = {
        CampaignStatus.REACHED: Level.GOOD,
        CampaignStatus.WAITING: Level.GOOD,
        CampaignStatus.INFEASIBLE: Level.BAD,
    }
    level = levels.get(campaign.status, Level.DOUBTFUL)
    return Verdict(text=_as_sentence(str(campaign)), level=level)


@next_steps.register
def _(campaign: Campaign) -> tuple[str, ...]:
    """Return the next steps after a campaign."""
    if campaign.status is CampaignStatus.WAITING:
        return (
            "Play the last design on the robot, record it, and repeat the call with "
            "`--recordings FILE`.",
        )
    if campaign.status is CampaignStatus.REACHED:
        return ("Use `identified.xml`, the model with the estimated parameters.",)
    if campaign.status is CampaignStatus.EXHAUSTED:
        return ("Allow more rounds with `--rounds`, or state larger `wanted` values.",)
    return ()


def _as_sentence(text: str) -> str:
    """Return a text with a capital first letter and a full stop."""
    stop = "" if text.endswith((".", "!", "?")) else "."
    return f"{text[:1].upper()}{text[1:]}{stop}"
