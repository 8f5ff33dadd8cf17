"""A robustness study in words and tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from mjfim.output.summary_parts import (
    Emphasis,
    Listing,
    Name,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.robustness import CONFIDENCE, REQUIRED_COVERAGE, Robustness

# Largest number of missed limits that have a sentence each.
MAX_MISSED_LIMITS = 8


def describe_robustness(result: Robustness) -> Summary:
    """Describe estimates and margins of a design on robots that differ from the model.

    Args:
        result: The study.
    """
    first, *others = robustness_sentences(result)
    items = tuple(f"• {sentence}" for sentence in others)
    findings = Listing(title="Further findings", items=items)
    tables = (_unknown_table(result), _limit_table(result))
    return Summary(
        title="A design played on robots that differ from the model",
        outcome=first,
        parts=(findings, *(table for table in tables if table.rows)),
    )


def _unknown_table(result: Robustness) -> SummaryTable:
    """Tabulate nominal, predicted and observed errors by unknown."""
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
        title=f"Accuracy of {result.runs} robots, each identified from the nominal values",
        columns=columns(
            "unknown",
            "nominal error",
            "σ predicted",
            "σ formal",
            "rms error",
            f"in 95 % interval, of {result.runs}",
            optional=["nominal error", "σ formal"],
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
            f"half of each range: {needed} (state limits that are tighter by it, and design again)"
        )


def _coverage_sentences(result: Robustness) -> Iterator[str]:
    """Yield sentences on the intervals and on the fits."""
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


def _limit_sentences(result: Robustness) -> Iterator[str]:
    """Yield how many robots keep all limits, and a sentence for each limit that some do not.

    Of many such limits, those that are exceeded most have a sentence.
    """
    yield f"{result.all_kept} of {result.runs} robots keep all limits at every engine step"

    worst = result.margins.min(axis=0)
    missed = ~result.kept.all(axis=0)
    worst_first = sorted(np.flatnonzero(missed).tolist(), key=lambda i: float(worst[i]))
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
