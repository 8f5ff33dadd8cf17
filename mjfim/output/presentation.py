"""How a notebook shows the results of verbs: as tables and sentences in HTML.

The records call `as_html`, see `mjfim.records.shown`.
"""

from __future__ import annotations

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
from mjfim.output.summaries.monte_carlo import describe_study
from mjfim.output.summaries.robustness import describe_robustness
from mjfim.output.summary_parts import Summary
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robustness import Robustness
from mjfim.records.shown import ShownRecord


def as_html(record: ShownRecord) -> str:
    """Render a record for a notebook.

    Args:
        record: The record.
    """
    return html.render(describe(record))


@singledispatch
def describe(record: ShownRecord) -> Summary:
    """Describe a record in words and tables.

    Args:
        record: The record.
    """
    raise MjfimError(f"a {type(record).__name__} cannot be shown as tables")


@describe.register
def _(record: Design) -> Summary:
    """Describe a design."""
    return describe_design(record, complete_labels(record).parameter_units)


@describe.register
def _(record: MonteCarloStudy) -> Summary:
    """Describe a Monte Carlo study."""
    return describe_study(record, complete_labels(record).parameter_units)


@describe.register
def _(record: Campaign) -> Summary:
    """Describe a campaign; before its first round, only how it ended."""
    if not record.rounds:
        return Summary(title="Campaign", outcome=str(record), parts=(), warnings=record.warnings)
    return describe_campaign(record, CampaignParameters.recorded(record))


describe.register(Check, describe_check)
describe.register(Estimate, describe_estimate)
describe.register(Comparison, describe_comparison)
describe.register(Robustness, describe_robustness)
