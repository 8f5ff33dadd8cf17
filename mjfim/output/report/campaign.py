"""The report of a campaign."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.report.correlations import correlation_of_covariance
from mjfim.output.report.curves import (
    axis,
    correlation_panel,
    curve,
    dots,
    error_bars,
    level,
    log_axis,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.campaign import describe_campaign
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.vocabulary import IDENTIFIED, INITIAL, NOMINAL
from mjfim.records.campaign import Campaign
from mjfim.records.labels import with_unit

# Largest number of parameters that are drawn; those with a target accuracy come first.
MAX_PARAMETERS = 12

# Names of the curves in the legends.
PREDICTED, ESTIMATED, WANTED = (
    "predicted before the round",
    "identified after the round",
    "wanted",
)


def campaign_page(campaign: Campaign) -> Page:
    """Return the report of a campaign.

    Args:
        campaign: The campaign.
    """
    sections = []
    facts = {"rounds": str(len(campaign.rounds))}
    if campaign.rounds:
        parameters = CampaignParameters.recorded(campaign)
        summary = describe_campaign(campaign, parameters)

        estimates = [*summary.parts, *_last_correlation(campaign)]
        sections.append(Section(title="Parameters", parts=estimates))
        rounds = [_std_plots(campaign, parameters), _estimate_plots(campaign, parameters)]
        sections.append(Section(title="Rounds", parts=rounds))
        last = campaign.rounds[-1].estimate
        facts["recordings"] = str(len(last.recordings))
        facts["χ²/dof of the last fit"] = f"{last.chi2 / max(last.dof, 1):.3f}"
    return Page(
        kind="Campaign of designs and recordings",
        verdict=verdict_of(campaign),
        next_steps=next_steps(campaign),
        warnings=campaign.warnings,
        facts=facts,
        sections=sections,
    )


def _shown(campaign: Campaign, parameters: CampaignParameters) -> list[int]:
    """Return the numbers of the parameters that are drawn."""
    has_target = np.isfinite(campaign.wanted)
    order = sorted(parameters.interest, key=lambda j: not has_target[j])
    return order[:MAX_PARAMETERS]


def _label(parameters: CampaignParameters, j: int) -> str:
    """Return the label of parameter j."""
    return with_unit(parameters.names[j], parameters.units[j])


def _rounds_axis(campaign: Campaign) -> Plotly:
    """Return the axis of the rounds."""
    count = max(len(campaign.rounds), 2)
    return axis("round [–]", range=[0.5, count + 0.5], dtick=max(1, count // 8))


def _joined(trace: Plotly) -> Plotly:
    """Return dots that a line joins."""
    line = {"color": trace["marker"]["color"], "width": 1.6}
    return {**trace, "mode": "lines+markers", "line": line}


def _std_plots(campaign: Campaign, parameters: CampaignParameters) -> PlotGroup:
    """Return the standard deviation of every parameter over the rounds."""
    numbers = np.array([r.number for r in campaign.rounds], dtype=np.float64)
    panels = []
    for j in _shown(campaign, parameters):
        predicted = np.array([r.predicted[j] for r in campaign.rounds])
        attained = np.array([r.attained[j] for r in campaign.rounds])
        wanted = float(campaign.wanted[j])
        values = np.concatenate([predicted, attained, [wanted]])
        traces = [
            dots(numbers, _finite(predicted), PREDICTED, INITIAL.word, size=10),
            _joined(dots(numbers, _finite(attained), ESTIMATED, IDENTIFIED.word, size=6)),
        ]
        if np.isfinite(wanted):
            ends = np.array([0.5, max(len(numbers), 2) + 0.5])
            traces.append(curve(ends, np.full(2, wanted), WANTED, "text", dash="dash", width=1.2))
        panels.append(
            Panel(
                title=f"σ of {_label(parameters, j)}",
                traces=traces,
                layout={
                    "xaxis": _rounds_axis(campaign),
                    "yaxis": log_axis("", values, room=(0.15, 0.15)),
                },
            )
        )
    keys = [
        Key(name=PREDICTED, role=INITIAL.word, shape="dot"),
        Key(name=ESTIMATED, role=IDENTIFIED.word),
        Key(name=WANTED, role="text", shape="dash"),
    ]
    return PlotGroup(title="Accuracy after each round", panels=panels, keys=keys)


def _finite(values: Array) -> Array:
    """Return values with NaN where they are infinite."""
    return np.where(np.isfinite(values), values, np.nan)


def _estimate_plots(campaign: Campaign, parameters: CampaignParameters) -> PlotGroup:
    """Return the estimate of every parameter over the rounds."""
    numbers = np.array([r.number for r in campaign.rounds], dtype=np.float64)
    panels = []
    for j in _shown(campaign, parameters):
        theta = np.array([r.estimate.theta[j] for r in campaign.rounds])
        std = np.array([r.attained[j] for r in campaign.rounds])
        trace = _joined(dots(numbers, theta, ESTIMATED, IDENTIFIED.word, size=7))
        trace["error_y"] = error_bars(IDENTIFIED.word, 2.0 * std, thickness=1.5)
        guess = float(parameters.guess[j])
        reach = np.where(np.isfinite(std), 2.0 * std, 0.0)
        ends = np.concatenate([theta - reach, theta + reach, [guess]])
        room = 0.08 * float(np.ptp(ends))
        panels.append(
            Panel(
                title=_label(parameters, j),
                traces=[trace],
                layout={
                    "xaxis": _rounds_axis(campaign),
                    "yaxis": axis(range=[float(ends.min()) - room, float(ends.max()) + room]),
                    "shapes": [level(guess, NOMINAL.word)],
                },
                remark=f"{NOMINAL.word} {guess:.4g}",
            )
        )
    keys = [Key(name=ESTIMATED, role=IDENTIFIED.word)]
    note = (
        "Bars: ± 2 formal σ, which is the true accuracy only if the model and the noise are right."
    )
    return PlotGroup(title="Estimates after each round", panels=panels, keys=keys, note=note)


def _last_correlation(campaign: Campaign) -> list[PlotGroup]:
    """Return the correlation of the last estimates."""
    last = campaign.rounds[-1].estimate
    correlation = correlation_of_covariance(last.covariance)
    if len(last.parameters) < 2 or not np.isfinite(correlation).any():
        return []
    panel = correlation_panel(correlation, last.parameters, "correlation of the estimates [–]")
    return [PlotGroup(title="", panels=[panel])]
