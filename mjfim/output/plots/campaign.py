"""Figure of a campaign: estimates after every round beside target accuracies and true values."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mjfim.model.parameters import ParameterSet
from mjfim.output.plots import style
from mjfim.records.campaign import Campaign

# Largest number of parameters that are drawn; those with a target accuracy come first.
MAX_PARAMETERS = 8


def campaign_figure(campaign: Campaign, parameters: ParameterSet, *, simulated: bool) -> Figure:
    """Draw standard deviation and estimate of each parameter over the rounds.

    Args:
        campaign: The campaign.
        parameters: The parameters of the experiment.
        simulated: True where the true values are known.
    """
    p = parameters
    order = sorted(p.interest.tolist(), key=lambda j: not np.isfinite(campaign.wanted[j]))[
        :MAX_PARAMETERS
    ]
    new = style.new_figure(9.0, 1.2 + 1.75 * len(order))
    panels = new.subplots(len(order), 2, squeeze=False, sharex=True)
    for row, j in enumerate(order):
        last = row == len(order) - 1
        unit = f" [{p.parameters[j].unit}]" if p.parameters[j].unit else ""
        _draw_std(panels[row, 0], campaign, j)
        _draw_estimate(panels[row, 1], campaign, j, float(p.true[j]) if simulated else None)
        name = style.shorten(p.names[j], 18)
        style.format_axes(panels[row, 0], "round" if last else "", f"σ of {name}{unit}")
        style.format_axes(panels[row, 1], "round" if last else "", f"{name}{unit}")
        for axes in panels[row]:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
            axes.set_xlim(0.5, max(len(campaign.rounds), 2) + 0.5)
    for column in (0, 1):
        new.align_ylabels(panels[:, column])
    handles = [
        Line2D(
            [],
            [],
            color=style.INITIAL_COLOUR,
            marker="o",
            mfc="white",
            linestyle="",
            label="predicted before the round",
        ),
        Line2D(
            [], [], color=style.OPTIMIZED_COLOUR, marker="o", label="after it, from all recordings"
        ),
        Line2D([], [], color=style.TEXT_COLOUR, linestyle="--", label="wanted"),
    ]
    if simulated:
        handles.append(Line2D([], [], color=style.MEASURED_COLOUR, label="true"))
    note = (
        "Bars and the last round's band: ± 1 and ± 2 formal σ, which are accuracy only if the "
        "model and the noise are right."
    )
    title = (
        f"{len(campaign.rounds)} rounds of design, recording and estimate: "
        f"{campaign.status.value.split(':')[0]}"
    )
    style.add_title(new, style.shorten(title, 100), handles, note)
    return new


def _draw_std(axes: Axes, campaign: Campaign, j: int) -> None:
    """Draw predicted and formal standard deviations of parameter j over the rounds."""
    number = np.array([r.number for r in campaign.rounds])
    predicted = np.array([r.predicted[j] for r in campaign.rounds])
    after = np.array([r.attained[j] for r in campaign.rounds])
    axes.set_yscale("log")
    axes.plot(
        number,
        predicted,
        color=style.INITIAL_COLOUR,
        marker="o",
        mfc="white",
        linestyle="",
        markersize=8,
        zorder=2,
    )
    axes.plot(number, after, color=style.OPTIMIZED_COLOUR, marker="o", markersize=4, zorder=3)
    aim = float(campaign.wanted[j])
    values = np.concatenate([predicted, after, [aim]])
    values = values[np.isfinite(values) & (values > 0.0)]
    if len(values):
        axes.set_ylim(values.min() / 1.5, values.max() * 1.5)
    if np.isfinite(aim):
        axes.axhline(aim, color=style.TEXT_COLOUR, linestyle="--", linewidth=1.0)
        axes.axhspan(axes.get_ylim()[0], aim, color=style.TEXT_COLOUR, alpha=0.06, linewidth=0.0)
        axes.text(
            0.99,
            aim,
            style.format_number(aim, 2),
            transform=axes.get_yaxis_transform(),
            ha="right",
            va="bottom",
            fontsize=style.SMALL_FONT,
            color=style.TEXT_COLOUR,
        )
    low, high = axes.get_ylim()
    axes.set_yticks(_tick_values(low, high))
    axes.yaxis.set_major_formatter(lambda value, _: style.format_number(float(value), 1))
    axes.minorticks_off()


def _tick_values(low: float, high: float) -> list[float]:
    """Round numbers on a logarithmic axis, so dense that at least two lie within its limits."""
    powers = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    found: list[float] = []
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 2, 3, 4, 6, 8)):
        every = np.sort(np.outer(powers, digits).ravel())
        found = every[(every >= low) & (every <= high)].tolist()
        if len(found) >= 2:
            break
    return found


def _draw_estimate(axes: Axes, campaign: Campaign, j: int, true: float | None) -> None:
    """Draw the estimates of parameter j over the rounds, with the true value where it is known."""
    number = np.array([r.number for r in campaign.rounds])
    theta = np.array([r.estimate.theta[j] for r in campaign.rounds])
    std = np.array([r.attained[j] for r in campaign.rounds])
    known = np.isfinite(std)
    bar = np.where(known, std, 0.0)
    axes.errorbar(number, theta, 2 * bar, color=style.OPTIMIZED_COLOUR, linestyle="", linewidth=0.9)
    axes.errorbar(
        number,
        theta,
        bar,
        color=style.OPTIMIZED_COLOUR,
        linestyle="",
        linewidth=2.4,
        marker="o",
        markersize=4,
    )
    if known[-1]:
        for times in (1, 2):
            band = (theta[-1] - times * bar[-1], theta[-1] + times * bar[-1])
            axes.axhspan(*band, color=style.OPTIMIZED_COLOUR, alpha=0.07, linewidth=0.0)
    if true is not None:
        axes.axhline(true, color=style.MEASURED_COLOUR, linewidth=1.4)
    guess = float(campaign.rounds[0].theta[j])
    axes.text(
        0.99,
        0.97,
        f"first design at {style.format_number(guess, 4)}",
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=style.SMALL_FONT,
        color=style.MUTED_COLOUR,
    )
