"""The pages of a campaign, of a design on robots that differ from the model, and of two robots."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy.stats

from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.page import (
    Emphasis,
    Level,
    Listing,
    Page,
    Part,
    Plot,
    Row,
    Section,
    Table,
    Verdict,
    as_sentence,
    named,
    numbers,
    tabulated,
    warned,
)
from mjfim.output.vocabulary import IDENTIFIED, NOMINAL
from mjfim.records.campaign import Campaign, CampaignStatus
from mjfim.records.robots import RobotComparison, p_text
from mjfim.records.robustness import CONFIDENCE, REQUIRED_COVERAGE, Robustness

# Largest number of missed limits that have a sentence each.
MAX_MISSED_LIMITS = 8

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


def campaign_page(campaign: Campaign, parameters: CampaignParameters | None = None) -> Page:
    """Describe the estimate after the last round of a campaign.

    Args:
        campaign: The campaign.
        parameters: Its parameters, where more is known of them than the campaign records.
    """
    facts, sections = {"rounds": str(len(campaign.rounds))}, []
    if campaign.rounds:
        known = parameters or CampaignParameters.recorded(campaign)
        sections = [
            Section("Parameters", [_campaign_table(campaign, known)]),
            Section("Rounds", [Plot("campaign")]),
        ]
        last = campaign.rounds[-1].estimate
        facts["recordings"] = str(len(last.recordings))
        facts["χ²/dof of the last fit"] = f"{last.chi2 / max(last.dof, 1):.3f}"
    step = AFTER_CAMPAIGN.get(campaign.status)
    level = CAMPAIGN_LEVELS.get(campaign.status, Level.DOUBTFUL)
    return Page(
        kind="Campaign of designs and recordings",
        verdict=Verdict(as_sentence(str(campaign)), level),
        next_steps=() if step is None else (step.format(len(campaign.rounds) + 1),),
        warnings=campaign.warnings,
        facts=facts,
        sections=sections,
    )


def _campaign_table(campaign: Campaign, parameters: CampaignParameters) -> Table:
    """Tabulate the last estimates beside the wanted standard deviations."""
    estimate, chosen = campaign.rounds[-1].estimate, list(parameters.interest)
    values, std, wanted = estimate.theta[chosen], estimate.std[chosen], campaign.wanted[chosen]
    columns = {
        "parameter": [named(estimate.parameters[j], estimate.units[j]) for j in chosen],
        NOMINAL.word: numbers(parameters.guess[chosen], 5),
        IDENTIFIED.word: numbers(values, 5),
        "formal σ": numbers(std, 2),
        "wanted σ": numbers(wanted, 2, infinite="-"),
    }
    if parameters.true is not None:
        errors = (values - parameters.true[chosen]) / std
        columns["error"] = [f"{error:+.1f} σ" for error in errors]
    return tabulated("Estimates", columns, warned(~(std <= wanted)))


# ---- a design on robots that differ from the model


def robustness_page(result: Robustness) -> Page:
    """Describe estimates and margins of a design on robots that differ from the model."""
    conditions = result.conditions
    covered = (
        "the 95 % intervals hold the true values often enough"
        if result.covered
        else "the 95 % intervals hold the true values too rarely"
    )
    text = f"{result.all_kept} of {result.runs} robots keep all limits, and {covered}."
    conclusions = tuple(as_sentence(sentence) for sentence in robustness_sentences(result))
    steps: tuple[str, ...] = ()
    if result.reserve():
        steps = conclusions[-1:]
    elif result.ok:
        steps = ("Play the design on the robot: `mjfim export DESIGN_FOLDER --to player -o FILE`.",)
    limits: list[Part] = [_limit_table(result)] if result.limits else []
    return Page(
        kind="A design on robots that differ from the model",
        verdict=Verdict(text, Level.GOOD if result.ok else Level.DOUBTFUL),
        next_steps=steps,
        facts={
            "robots": str(result.runs),
            "error of the parameters": f"{100 * conditions.wrong:g} %",
            "delay of the control": f"{1e3 * conditions.latency:g} ms",
            "control": "with feedback" if conditions.feedback else "open loop",
            "noise / stated noise": f"{conditions.loudness:g}",
        },
        sections=[
            Section(
                "Robots",
                [
                    Listing("Conclusions", conclusions),
                    _unknown_table(result),
                    *limits,
                    Plot("playback"),
                ],
            )
        ],
    )


def robustness_sentences(result: Robustness) -> Iterator[str]:
    """Yield the conclusions of a robustness study; the advice is the last one."""
    n = result.runs
    low, high = (int(k) for k in scipy.stats.binom.interval(0.99, n, CONFIDENCE))
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
    for sentence, count in result.troubles.items():
        yield f"{count} of {n} runs: {sentence}"
    yield from _limit_sentences(result)
    reserve = result.reserve()
    if reserve:
        needed = " ".join(f"{kind}={share:g}" for kind, share in reserve.items())
        yield (
            "such robots keep the limits if the design stays away from them by these shares of "
            f"half of each range: {needed} (state limits that are tighter by it, and design again)"
        )


def _limit_sentences(result: Robustness) -> Iterator[str]:
    """Yield how many robots keep all limits, and a sentence for each limit that some do not."""
    yield f"{result.all_kept} of {result.runs} robots keep all limits at every engine step"
    worst = result.margins.min(axis=0)
    missed = np.flatnonzero(~result.kept.all(axis=0)).tolist()
    worst_first = sorted(missed, key=lambda i: float(worst[i]))
    for i in sorted(worst_first[:MAX_MISSED_LIMITS]):
        limit = result.limits[i]
        excess = -worst[i] * limit.scale
        manner = f"exceeded by up to {excess:.3g}" if excess > 0.0 else "reached and clamped"
        yield f"{limit.kind} of {limit.name} is {manner}"
    others = len(worst_first) - MAX_MISSED_LIMITS
    if others > 0:
        yield (
            f"{others} more limits are exceeded or reached, each by a smaller share of its range; "
            "see limits in playback.json"
        )


def _unknown_table(result: Robustness) -> Table:
    """Tabulate nominal, predicted and observed errors by unknown."""
    alone = np.isfinite(result.formal)
    inside = [
        str(int(count)) if is_alone else "in combination only"
        for count, is_alone in zip(result.inside, alone, strict=True)
    ]
    return tabulated(
        f"Accuracy of {result.runs} robots, each identified from the nominal values",
        {
            "unknown": list(map(named, result.names, result.units)),
            "nominal error": numbers(result.wrong, infinite="-"),
            "σ predicted": numbers(result.predicted, infinite="-"),
            "σ formal": numbers(result.formal, infinite="-"),
            "rms error": numbers(result.observed, infinite="-"),
            f"in 95 % interval, of {result.runs}": inside,
        },
        warned(alone & (result.inside < REQUIRED_COVERAGE * result.runs)),
        spare=("nominal error", "σ formal"),
    )


def _limit_table(result: Robustness) -> Table:
    """Tabulate the tightest limit of every kind."""
    worst = result.margins.min(axis=0)
    rows = []
    for kind in dict.fromkeys(limit.kind for limit in result.limits):
        members = [i for i, limit in enumerate(result.limits) if limit.kind == kind]
        tightest = min(members, key=lambda i: float(worst[i]))
        kept = int(result.kept[:, members].all(axis=1).sum())
        shares = (result.planned[tightest], worst[tightest], result.lost[members].max())
        cells = (
            f"{kind} of {result.limits[tightest].name}",
            *(f"{100 * share:.1f} %" for share in shares),
            f"{kept} of {result.runs}",
        )
        rows.append(Row(cells, Emphasis.NORMAL if kept == result.runs else Emphasis.WARNING))
    return Table(
        title="Margins of the limits, in percent of half of each range; negative: exceeded",
        columns=("tightest limit", "planned", "worst robot", "largest loss", "robots that keep it"),
        rows=tuple(rows),
    )


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
    return Page(
        kind="Comparison of two robots",
        verdict=_robots_verdict(comparison),
        next_steps=tuple(_steps_after_robots(comparison)),
        warnings=tuple(_limits_of(comparison)),
        facts={
            f"recordings of {first}": str(comparison.recordings[0]),
            f"recordings of {second}": str(comparison.recordings[1]),
            "compared parameters": str(len(comparison.parameters)),
            "all parameters together": p_text(comparison.joint_p),
        },
        sections=[Section("Differences", parts)],
    )


def _robots_verdict(comparison: RobotComparison) -> Verdict:
    text = str(comparison)
    if not comparison.parameters:
        return Verdict(text, Level.BAD)
    if not comparison.is_reliable:
        return Verdict(f"With reservations (see the warnings): {text}", Level.DOUBTFUL)
    return Verdict(text, Level.DOUBTFUL if comparison.differs else Level.GOOD)


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


def _limits_of(comparison: RobotComparison) -> Iterator[str]:
    """Yield sentences that limit a comparison."""
    yield from comparison.remarks
    others = len(comparison.parameters) - len(comparison.changed)
    if comparison.changed and others:
        yield (
            f"no difference was found in the other {others} parameters, which is not a proof that "
            "they are equal: see which differences would have been found"
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
            "parameter": [named(comparison.parameters[j], comparison.units[j]) for j in order],
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
