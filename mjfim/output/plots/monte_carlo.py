"""Figures of a Monte Carlo study: an overview of all parameters, and histograms of one."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import MjfimError
from mjfim.output.distributions import normal_density
from mjfim.output.plots.style import (
    MUTED_COLOUR,
    NORMAL_FONT,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    new_figure,
    own_style,
    quotient_unit,
    set_plain_log_ticks,
    shorten_label,
    squared_unit,
    trajectory_style,
    write_message,
)
from mjfim.records.labels import Labels
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics

# Distance from the quartiles beyond which estimates are outliers, as a multiple of the distance
# between the quartiles.
OUTLIER_DISTANCE = 4.0

# Standard deviations of the Cramér-Rao bound on each side of the true value that a histogram shows.
SHOWN_STDS = 4.0

# Ratio of the bound's standard deviation to half the range of the estimates above which the range
# ignores the bound.
HUGE_BOUND = 20.0

# Smallest relative width of a histogram's range.
MIN_RELATIVE_RANGE = 1e-9

# Largest number of parameters of an overview; of more, the least efficient ones are drawn.
MAX_PARAMETERS = 30

# Distance between the trajectories in a row of an overview, as a share of the height of the row.
ROW_OFFSET = 0.3

# Characters to which the names of parameters are shortened.
OVERVIEW_NAME_WIDTH = 26

# Number of points of the normal curve.
CURVE_POINTS = 400

# Smallest and largest number of bars of a histogram.
MIN_BINS, MAX_BINS = 8, 60


# ---- overview


@own_style
def study_overview(study: MonteCarloStudy, labels: Labels) -> Figure:
    """Draw scatter, Cramér-Rao bound and efficiency of every parameter along each trajectory.

    Args:
        study: The study.
        labels: Labels of the parameters.

    Raises:
        MjfimError: The labels do not fit the study.
    """
    labels.check(parameters=len(study.theta))
    shown = _shown_parameters(study)
    figure = new_figure(1.9 + 0.36 * len(shown))
    left, right = figure.subplots(1, 2, sharey=True)
    left.set_xscale("log")
    offsets = ROW_OFFSET * (np.arange(len(study.sets)) - 0.5 * (len(study.sets) - 1))
    for offset, (trajectory, trials) in zip(offsets, study.sets.items(), strict=True):
        colour = trajectory_style(trajectory)[1]
        _draw_scatter(left, study, trials, shown, float(offset), colour)
        _draw_efficiency(right, trials, shown, float(offset), colour)

    names = [shorten_label(labels.parameter(int(j)), OVERVIEW_NAME_WIDTH) for j in shown]
    left.set_yticks(range(len(shown)), names)
    left.set_ylim(len(shown) - 0.5, -0.5)
    set_plain_log_ticks(left.xaxis)
    right.axvline(1.0, color=TEXT_COLOUR, linewidth=1.0, linestyle="--")
    first = trajectory_style(next(iter(study.sets)))[0]
    format_axes(left, f"standard deviation / bound of the {first} trajectory [–]")
    format_axes(right, "efficiency: bound / observed variance [–]")
    for axes in (left, right):
        axes.grid(False, axis="y")
    right.tick_params(labelleft=False)

    handles = [
        Line2D([], [], color=colour, marker="o", linestyle="", label=f"{name}: estimates")
        for name, colour in map(trajectory_style, study.sets)
    ]
    bound = Line2D(
        [], [], color=TEXT_COLOUR, marker="|", markersize=10, linestyle="", label="Cramér–Rao bound"
    )
    note = (
        f"Simulated recordings of the model with noise of the stated σ, at {study.measure_rate:g} "
        "Hz. Efficiency with its 95 % interval; 1: the bound is reached."
    )
    if len(shown) < len(study.theta):
        note += (
            f" Shown: {len(shown)} of {len(study.theta)} parameters, those with the smallest "
            "efficiency."
        )
    add_title(figure, "Monte Carlo study against the Cramér–Rao bound", [*handles, bound], note)
    return figure


def _shown_parameters(study: MonteCarloStudy) -> NDArray[np.intp]:
    """Return the parameters of an overview: of many, those with the smallest efficiency."""
    smallest = np.min([trials.efficiency for trials in study.sets.values()], axis=0)
    order = np.argsort(np.nan_to_num(smallest, nan=np.inf), kind="stable")
    return np.sort(order[:MAX_PARAMETERS])


def _draw_scatter(
    axes: Axes,
    study: MonteCarloStudy,
    trials: TrialStatistics,
    shown: NDArray[np.intp],
    offset: float,
    colour: str,
) -> None:
    """Draw observed and least standard deviations over the least one of the first trajectory."""
    first = next(iter(study.sets.values()))
    least = np.sqrt(np.diagonal(first.crlb)[shown])
    size = np.where(np.isfinite(least), least, np.sqrt(np.diagonal(first.covariance)[shown]))
    size = np.where(size > 0.0, size, np.nan)

    places = np.arange(len(shown)) + offset
    observed = np.sqrt(np.diagonal(trials.covariance)[shown]) / size
    bound = np.sqrt(np.diagonal(trials.crlb)[shown]) / size
    axes.plot(
        np.where(np.isfinite(bound), bound, np.nan),
        places,
        "|",
        color=TEXT_COLOUR,
        markersize=10,
        markeredgewidth=1.4,
    )
    axes.plot(observed, places, "o", color=colour, markersize=4.5)


def _draw_efficiency(
    axes: Axes, trials: TrialStatistics, shown: NDArray[np.intp], offset: float, colour: str
) -> None:
    """Draw the efficiency of some parameters with its interval."""
    places = np.arange(len(shown)) + offset
    low, high = trials.efficiency_interval[shown].T
    axes.hlines(places, low, high, color=colour, linewidth=1.4)
    axes.plot(trials.efficiency[shown], places, "o", color=colour, markersize=4.5)


# ---- histograms


@own_style
def histogram(study: MonteCarloStudy, index: int, labels: Labels) -> Figure:
    """Draw the estimates of one parameter along each trajectory (the paper's figures 4 to 6).

    Args:
        study: The study.
        index: Number of the parameter.
        labels: Labels of the parameters.

    Raises:
        MjfimError: There is no such parameter, or the labels do not fit the study.
    """
    count = len(study.theta)
    labels.check(parameters=count)
    if not 0 <= index < count:
        raise MjfimError(f"the study has no parameter {index}; valid: 0 to {count - 1}")

    label = labels.parameter(index)
    density_unit = quotient_unit("", labels.parameter_units[index])
    figure = new_figure(5.3)
    grid = figure.add_gridspec(2, len(study.sets), height_ratios=(2.6, 1.0))
    for k, trajectory in enumerate(study.sets):
        axes = figure.add_subplot(grid[0, k])
        format_axes(axes, label, f"density [{density_unit}]")
        _draw_histogram(axes, study, trajectory, index, labels.parameter_units[index])

    overlay = figure.add_subplot(grid[1, :])
    format_axes(overlay, label, "density / peak [–]")
    _draw_overlay(overlay, study, index)
    overlay.set_title(
        "all trajectories on one axis", loc="left", fontsize=SMALL_FONT, color=MUTED_COLOUR
    )

    title = f"Monte Carlo estimates of {labels.parameters[index]}"
    note = (
        "Simulated recordings of the model with noise of the stated σ. "
        "The upper panels have different ranges."
    )
    add_title(figure, title, _handles(study, index, labels), note)
    return figure


def _handles(study: MonteCarloStudy, index: int, labels: Labels) -> list[Artist]:
    """Return the entries of the legend."""
    handles: list[Artist] = []
    for trajectory in study.sets:
        name, colour = trajectory_style(trajectory)
        handles.append(Patch(facecolor=colour, alpha=0.5, label=name))

    theta = format_number(float(study.theta[index]))
    true_value = f"true value {theta} {labels.parameter_units[index]}".rstrip()
    handles.append(Line2D([], [], color=TEXT_COLOUR, linestyle="--", label=true_value))
    curve = "normal curve of the Cramér–Rao bound"
    handles.append(Line2D([], [], color=TEXT_COLOUR, label=curve))
    return handles


def _successful_estimates(trials: TrialStatistics, index: int) -> Array:
    """Return the (n,) estimates of one parameter without those of failed trials [theta-unit]."""
    estimates = trials.estimates[:, index]
    return estimates[np.isfinite(estimates)]


def _bound_std(trials: TrialStatistics, index: int) -> float:
    """Return the Cramér-Rao bound of one parameter as a standard deviation [theta-unit]."""
    return float(np.sqrt(trials.crlb[index, index]))


def _central_range(values: Array, theta: float, std: float) -> tuple[float, float]:
    """Return a range that shows most estimates, the true value and four bounds on each side.

    Args:
        values: (n,) estimates [theta-unit].
        theta: The true value.
        std: Standard deviation of the Cramér-Rao bound; infinite where the range ignores it.

    Returns:
        Ends of the range; it is never empty.
    """
    # Outliers do not widen the range.
    first, median, third = (float(value) for value in np.quantile(values, (0.25, 0.5, 0.75)))
    reach = OUTLIER_DISTANCE * (third - first)
    low = max(float(values.min()), first - reach)
    high = min(float(values.max()), third + reach)

    # A bound that is far wider than the estimates would hide them.
    half = 0.5 * (high - low)
    bound_fits = np.isfinite(std) and (std < HUGE_BOUND * half or half == 0.0)
    bound_reach = SHOWN_STDS * std if bound_fits else 0.0
    low = min(low - 0.1 * half, theta - bound_reach)
    high = max(high + 0.1 * half, theta + bound_reach)

    # Estimates that are all equal need some width around them.
    smallest = MIN_RELATIVE_RANGE * max(abs(median), abs(theta), MIN_RELATIVE_RANGE)
    if high - low > smallest:
        return low, high
    return median - 1e3 * smallest, median + 1e3 * smallest


def _densities(values: Array, limits: tuple[float, float]) -> tuple[Array, Array]:
    """Return heights (bins,) and edges (bins+1,) of a histogram.

    Values outside the limits count in the normalisation.
    """
    count = len(values)
    bins = int(np.clip(2.0 * np.sqrt(count), MIN_BINS, MAX_BINS))
    counts, edges = np.histogram(values, bins=bins, range=limits)

    widths = np.diff(edges)
    return counts / (count * widths), edges


def _draw_histogram(
    axes: Axes, study: MonteCarloStudy, trajectory: str, index: int, unit: str
) -> None:
    """Draw the estimates along one trajectory, the true value and the bound's normal curve."""
    trials = study.sets[trajectory]
    name, colour = trajectory_style(trajectory)
    axes.set_title(name, loc="left", fontsize=NORMAL_FONT + 1, color=colour, weight="bold", pad=49)
    values = _successful_estimates(trials, index)
    if not values.size:
        write_message(axes, "no successful trials")
        return

    theta = float(study.theta[index])
    std = _bound_std(trials, index)
    low, high = _central_range(values, theta, std)
    heights, edges = _densities(values, (low, high))
    axes.stairs(heights, edges, fill=True, color=colour, alpha=0.45, linewidth=0)
    axes.stairs(heights, edges, color=colour, linewidth=0.8)
    if np.isfinite(std) and std > 0.0:
        x = np.linspace(low, high, CURVE_POINTS)
        axes.plot(x, normal_density(x, theta, std), color=TEXT_COLOUR, linewidth=1.4)
    axes.axvline(theta, color=TEXT_COLOUR, linewidth=1.2, linestyle="--")
    axes.set_xlim(low, high)
    axes.locator_params(axis="x", nbins=6)

    hidden = int(np.sum((values < low) | (values > high)))
    axes.text(
        0.0,
        1.02,
        _statistics_in_words(trials, index, unit, hidden),
        transform=axes.transAxes,
        va="bottom",
        fontsize=SMALL_FONT,
        color=MUTED_COLOUR,
    )


def _statistics_in_words(trials: TrialStatistics, index: int, unit: str, hidden: int) -> str:
    """Return variance, bound, efficiency and counts of one panel in words.

    `hidden` is the number of estimates outside its range.
    """
    variance = format_number(float(trials.covariance[index, index]))
    bound = format_number(float(trials.crlb[index, index]))
    efficiency = format_number(float(trials.efficiency[index]))
    low, high = (format_number(float(end)) for end in trials.efficiency_interval[index])

    counts = f"{trials.trials} trials, {trials.failed} failed"
    if hidden:
        counts += f", {hidden} outside this range"
    lines = (
        f"variance {variance} {squared_unit(unit)}".rstrip(),
        f"bound {bound} {squared_unit(unit)}".rstrip(),
        f"efficiency {efficiency}, 95 % interval [{low}, {high}]",
        counts,
    )
    return "\n".join(lines)


def _draw_overlay(axes: Axes, study: MonteCarloStudy, index: int) -> None:
    """Draw the estimates along all trajectories on one axis, each scaled to its highest bar."""
    theta = float(study.theta[index])
    ranges = []
    for trajectory, trials in study.sets.items():
        values = _successful_estimates(trials, index)
        if not values.size:
            continue
        ranges.append(_central_range(values, theta, _bound_std(trials, index)))
        heights, edges = _densities(values, _central_range(values, theta, np.inf))
        relative_heights = heights / max(heights.max(), 1e-300)
        _, colour = trajectory_style(trajectory)
        axes.stairs(relative_heights, edges, fill=True, color=colour, alpha=0.5)

    if not ranges:
        write_message(axes, "no successful trials")
        return
    axes.axvline(theta, color=TEXT_COLOUR, linewidth=1.2, linestyle="--")
    axes.set_xlim(min(low for low, _ in ranges), max(high for _, high in ranges))
    axes.set_ylim(0.0, 1.08)
