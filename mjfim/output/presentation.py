"""How a notebook shows the results of verbs: as tables and sentences in HTML.

The records call `as_html`, see `mjfim.records.base`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import singledispatch

from mjfim.errors import MjfimError
from mjfim.output import html
from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.labels import complete_labels
from mjfim.output.summaries.campaign import describe_campaign
from mjfim.output.summaries.check import describe_check
from mjfim.output.summaries.comparison import describe_comparison
from mjfim.output.summaries.design import describe_design
from mjfim.output.summaries.estimate import describe_estimate
from mjfim.output.summaries.inverse_dynamics import describe_inverse_dynamics
from mjfim.output.summaries.monte_carlo import describe_study
from mjfim.output.summaries.robot_comparison import describe_robots
from mjfim.output.summaries.robustness import describe_robustness
from mjfim.output.summaries.verdicts import Level, next_steps, verdict_of
from mjfim.output.summary_parts import Emphasis, Paragraph, Summary, capitalised
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.inverse_dynamics import InverseDynamicsFit
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robots import RobotComparison
from mjfim.records.robustness import Robustness

# How strongly a verdict stands out.
EMPHASIS = {
    Level.GOOD: Emphasis.STRONG,
    Level.DOUBTFUL: Emphasis.STRONG_WARNING,
    Level.BAD: Emphasis.STRONG_WARNING,
}


def as_html(record: ShownRecord) -> str:
    """Render a record for a notebook.

    Args:
        record: The record.
    """
    return html.render(describe(record))


def describe(record: ShownRecord) -> Summary:
    """Describe a record in words and tables: its verdict first, as in its report.

    Args:
        record: The record.
    """
    summary, verdict = _described(record), verdict_of(record)
    parts = list(summary.parts)
    if summary.outcome and normalised(summary.outcome) not in normalised(verdict.text):
        parts.insert(0, Paragraph(text=capitalised(summary.outcome)))
    steps = next_steps(record)
    if steps:
        parts.append(Paragraph(text=f"Next: {steps[0]}", emphasis=Emphasis.WEAK))
    return replace(
        summary, outcome=verdict.text, emphasis=EMPHASIS[verdict.level], parts=tuple(parts)
    )


def normalised(sentence: str) -> str:
    """Return a sentence without what depends on its place: capitals and a full stop.

    Args:
        sentence: The sentence.
    """
    return sentence.lower().rstrip(".")


@singledispatch
def _described(record: ShownRecord) -> Summary:
    """The words and tables of a record, without its verdict."""
    raise MjfimError(f"a {type(record).__name__} cannot be shown as tables")


@_described.register
def _(record: Design) -> Summary:
    """Describe a design."""
    return describe_design(record, complete_labels(record).parameter_units)


@_described.register
def _(record: MonteCarloStudy) -> Summary:
    """Describe a Monte Carlo study."""
    return describe_study(record, complete_labels(record).parameter_units)


@_described.register
def _(record: Campaign) -> Summary:
    """Describe a campaign; before its first round, only how it ended."""
    if not record.rounds:
        return Summary(title="Campaign", outcome=str(record), parts=(), warnings=record.warnings)
    return describe_campaign(record, CampaignParameters.recorded(record))


_described.register(Check, describe_check)
_described.register(Estimate, describe_estimate)
_described.register(InverseDynamicsFit, describe_inverse_dynamics)
_described.register(Comparison, describe_comparison)
_described.register(RobotComparison, describe_robots)
_described.register(Robustness, describe_robustness)
