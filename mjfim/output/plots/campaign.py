"""Figure of a campaign: estimates after every round beside target accuracies and true values."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator

from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.plots import style
from mjfim.records.campaign import Campaign
from mjfim.records.labels import with_unit

# Largest number of parameters that are drawn; those with a target accuracy come first.
MAX_PARAMETERS = 8

# Characters to which the names of parameters are shortened.
PARAMETER_NAME_WIDTH = 18


@style.own_style
def campaign_figure(campaign: Campaign, parameters: CampaignParameters) -> Figure:
    """Draw standard deviation and estimate of each parameter over the rounds.

    Args:
        campaign: The campaign.
        parameters: Its parameters.
    """
    count = len(campaign.rounds)
    shown = _shown_parameters(campaign, parameters)
    figure = style.new_figure(1.2 + 1.75 * len(shown))
    panels = figure.subplots(len(shown), 2, squeeze=False, sharex=True)
    for (left, right), j in zip(panels, shown, strict=True):
        name = style.shorten(parameters.names[j], PARAMETER_NAME_WIDTH)
        unit = parameters.units[j]
        guess = style.format_number(float(campaign.rounds[0].theta[j]), 4)
        left.set_title(with_unit(f"σ of {name}", unit), loc="left")
        right.set_title(f"{with_unit(name, unit)}, first design at {guess}", loc="left")

        true = None if parameters.true is None else float(parameters.true[j])
        _draw_std(left, campaign, j)
        _draw_estimate(right, campaign, j, true)

    # The numbers of the rounds are on the shared horizontal axis.
    locator = MaxNLocator(integer=True) if count > 1 else FixedLocator([1])
    panels[0, 0].xaxis.set_major_locator(locator)
    panels[0, 0].set_xlim(0.5, count + 0.5)
    for column in (0, 1):
        panels[-1, column].set_xlabel("round")

    rounds = "1 round" if count == 1 else f"{count} rounds"
    title = f"{rounds} of design, recording and estimate"
    note = (
        f"{style.as_sentence(campaign.status.value)} Bars, and the band of the last round: ± 1 "
        "and ± 2 formal σ, which are the true accuracy only if the model and the noise are right."
    )
    style.add_title(figure, title, _handles(simulated=parameters.true is not None), note)
    return figure


def _shown_parameters(campaign: Campaign, parameters: CampaignParameters) -> list[int]:
    """Return the numbers of the parameters that are drawn, those with a target accuracy first."""
    has_target = np.isfinite(campaign.wanted)
    order = sorted(parameters.interest, key=lambda j: not has_target[j])
    return order[:MAX_PARAMETERS]


def _handles(*, simulated: bool) -> list[Line2D]:
    """Return the entries of the legend."""
    predicted = Line2D(
        [],
        [],
        color=style.DESIGNED_COLOUR,
        marker="o",
        markerfacecolor="white",
        linestyle="",
        label="predicted before the round",
    )
    estimated = Line2D(
        [],
        [],
        color=style.IDENTIFIED_COLOUR,
        marker="o",
        label="estimated after the round, from all recordings",
    )
    wanted = Line2D([], [], color=style.TEXT_COLOUR, linestyle="--", label="wanted")
    handles = [predicted, estimated, wanted]
    if simulated:
        handles.append(Line2D([], [], color=style.TEXT_COLOUR, linewidth=1.0, label="true value"))
    return handles


def _draw_std(axes: Axes, campaign: Campaign, j: int) -> None:
    """Draw predicted and formal standard deviations of parameter j over the rounds."""
    rounds = np.array([r.number for r in campaign.rounds])
    predicted = np.array([r.predicted[j] for r in campaign.rounds])
    attained = np.array([r.attained[j] for r in campaign.rounds])
    wanted = float(campaign.wanted[j])

    axes.set_yscale("log")
    axes.plot(
        rounds,
        predicted,
        color=style.DESIGNED_COLOUR,
        marker="o",
        markerfacecolor="white",
        linestyle="",
        markersize=8,
        zorder=2,
    )
    axes.plot(rounds, attained, color=style.IDENTIFIED_COLOUR, marker="o", markersize=4, zorder=3)

    values = np.concatenate([predicted, attained, [wanted]])
    usable = values[np.isfinite(values) & (values > 0.0)]
    if len(usable):
        axes.set_ylim(usable.min() / 1.5, usable.max() * 1.5)
    if np.isfinite(wanted):
        _draw_target(axes, wanted)

    low, high = axes.get_ylim()
    axes.set_yticks(style.log_ticks(low, high))
    axes.yaxis.set_major_formatter(lambda value, _: style.format_number(float(value), 1))
    axes.minorticks_off()


def _draw_target(axes: Axes, wanted: float) -> None:
    """Draw the wanted standard deviation as a line; the region below it is shaded."""
    axes.axhline(wanted, color=style.TEXT_COLOUR, linestyle="--", linewidth=1.0)
    axes.axhspan(axes.get_ylim()[0], wanted, color=style.TEXT_COLOUR, alpha=0.06, linewidth=0.0)
    axes.text(
        0.99,
        wanted,
        style.format_number(wanted, 2),
        transform=axes.get_yaxis_transform(),
        ha="right",
        va="bottom",
        fontsize=style.SMALL_FONT,
        color=style.TEXT_COLOUR,
    )


def _draw_estimate(axes: Axes, campaign: Campaign, j: int, true: float | None) -> None:
    """Draw the estimates of parameter j over the rounds, with the true value if it is known."""
    rounds = np.array([r.number for r in campaign.rounds])
    theta = np.array([r.estimate.theta[j] for r in campaign.rounds])
    std = np.array([r.attained[j] for r in campaign.rounds])
    known = np.isfinite(std)
    bar = np.where(known, std, 0.0)

    colour = style.IDENTIFIED_COLOUR
    axes.errorbar(rounds, theta, 2 * bar, color=colour, linestyle="", linewidth=0.9)
    axes.errorbar(
        rounds, theta, bar, color=colour, linestyle="", linewidth=2.4, marker="o", markersize=4
    )
    if known[-1]:
        for factor in (1, 2):
            low, high = theta[-1] - factor * bar[-1], theta[-1] + factor * bar[-1]
            axes.axhspan(low, high, color=colour, alpha=0.07, linewidth=0.0)
    if true is not None:
        axes.axhline(true, color=style.TEXT_COLOUR, linewidth=1.0)
