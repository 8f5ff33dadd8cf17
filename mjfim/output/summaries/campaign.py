"""A campaign in words and tables."""

from __future__ import annotations

import numpy as np

from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.summary_parts import Cell, Emphasis, Name, Row, Summary, SummaryTable, columns
from mjfim.output.vocabulary import IDENTIFIED, NOMINAL
from mjfim.records.campaign import Campaign
from mjfim.records.estimate import Estimate


def describe_campaign(campaign: Campaign, parameters: CampaignParameters) -> Summary:
    """Describe the estimate after the last round of a campaign.

    Args:
        campaign: The campaign.
        parameters: Its parameters.

    Returns:
        The status and the estimates; before the first estimate, the status alone.
    """
    emphasis = Emphasis.STRONG if campaign.reached else Emphasis.STRONG_WARNING
    if campaign.estimate is None:
        return Summary(title="Campaign", outcome=str(campaign), parts=(), emphasis=emphasis)

    headings = ["parameter", NOMINAL.word, IDENTIFIED.word, "formal σ", "wanted σ"]
    if parameters.true is not None:
        headings.append("error")

    rows = []
    for j in parameters.interest:
        true = None if parameters.true is None else float(parameters.true[j])
        rows.append(_campaign_row(campaign, campaign.estimate, parameters, j=j, true=true))

    table = SummaryTable(
        key="campaign", title="Estimates", columns=columns(*headings), rows=tuple(rows)
    )
    return Summary(title="Campaign", outcome=str(campaign), parts=(table,), emphasis=emphasis)


def _campaign_row(
    campaign: Campaign,
    estimate: Estimate,
    parameters: CampaignParameters,
    *,
    j: int,
    true: float | None,
) -> Row:
    """Return the row of parameter j; `true` is its true value, None if that is not known."""
    value, std = float(estimate.theta[j]), float(estimate.std[j])
    wanted = float(campaign.wanted[j])
    cells: list[Cell] = [
        Name(name=estimate.parameters[j], unit=estimate.units[j]),
        f"{parameters.guess[j]:.5g}",
        f"{value:.5g}",
        f"{std:.2g}",
        f"{wanted:.2g}" if np.isfinite(wanted) else "-",
    ]
    if true is not None:
        cells.append(f"{(value - true) / std:+.1f} σ")
    emphasis = Emphasis.NORMAL if std <= wanted else Emphasis.WARNING
    return Row(cells=tuple(cells), emphasis=emphasis)
