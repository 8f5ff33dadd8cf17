"""Figures of estimates: Monte-Carlo histograms, fit to a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.errors import MjfimError
from mjfim.model.coordinates import split_unit
from mjfim.output.labels import Labels
from mjfim.output.plots.style import (
    GRID_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    NORMAL_FONT,
    OTHER_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    TRAJECTORY_STYLES,
    add_title,
    break_before_unit,
    format_axes,
    format_number,
    new_figure,
    quotient_unit,
    squared_unit,
    write_message,
)
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics
from mjfim.records.recording import Recording

MAX_OUTPUTS = 12
MAX_ROWS = 6000  # of a recording in a picture


def finite_column(trials: TrialStatistics, index: int) -> Array:
    """Estimates of one parameter without the failed trials."""
    column = trials.estimates[:, index]
    return column[np.isfinite(column)]


def central_range(values: Array, theta: float, std: float) -> tuple[float, float]:
    """Range that shows the bulk, the true value and four bound sigmas, whatever the outliers."""
    first, middle, third = (float(v) for v in np.quantile(values, (0.25, 0.5, 0.75)))
    reach = 4.0 * (third - first)
    low, high = max(float(values.min()), first - reach), min(float(values.max()), third + reach)
    half = 0.5 * (high - low)
    span = 4.0 * std if np.isfinite(std) and (std < 20.0 * half or half == 0.0) else 0.0
    low, high = min(low - 0.1 * half, theta - span), max(high + 0.1 * half, theta + span)
    least = 1e-9 * max(abs(middle), abs(theta), 1e-9)
    return (low, high) if high - low > least else (middle - 1e3 * least, middle + 1e3 * least)


def densities(values: Array, limits: tuple[float, float]) -> tuple[Array, Array]:
    """Histogram (heights, edges) on the given range; outliers count in the normalisation."""
    bins = int(np.clip(2.0 * len(values) ** 0.5, 8, 60))
    counts, edges = np.histogram(values, bins=bins, range=limits)
    return counts / (len(values) * np.diff(edges)), edges


def normal(x: Array, mean: float, std: float) -> Array:
    """Normal density."""
    return np.asarray(
        np.exp(-0.5 * ((x - mean) / std) ** 2) / (std * np.sqrt(2.0 * np.pi)), dtype=np.float64
    )


def describe(trials: TrialStatistics, index: int, unit: str, hidden: int) -> str:
    """Variance, bound, efficiency and counts of one panel."""
    low, high = (format_number(float(v)) for v in trials.efficiency_interval[index])
    square = f" {squared_unit(unit)}".rstrip()
    text = f"variance {format_number(float(trials.covariance[index, index]))}{square}\n"
    text += f"bound {format_number(float(trials.crlb[index, index]))}{square}\n"
    text += f"efficiency {format_number(float(trials.efficiency[index]))}, 95 % interval [{low}, {high}]\n"
    text += f"{trials.trials} trials, {trials.failed} failed" + (
        f", {hidden} outside this range" if hidden else ""
    )
    return text


def draw_panel(
    axes: Axes, trials: TrialStatistics, index: int, theta: float, unit: str, style: tuple[str, str]
) -> None:
    """Histogram of one trajectory on its own range, with true value and the normal curve of the bound."""
    name, colour = style
    values = finite_column(trials, index)
    axes.set_title(name, loc="left", fontsize=NORMAL_FONT + 1, color=colour, weight="bold", pad=49)
    if not values.size:
        write_message(axes, "no successful trials")
        return
    std = float(np.sqrt(trials.crlb[index, index]))
    limits = central_range(values, theta, std)
    heights, edges = densities(values, limits)
    axes.stairs(heights, edges, fill=True, color=colour, alpha=0.45, linewidth=0)
    axes.stairs(heights, edges, color=colour, linewidth=0.8)
    if np.isfinite(std) and std > 0.0:
        x = np.linspace(*limits, 400)
        axes.plot(x, normal(x, theta, std), color=TEXT_COLOUR, linewidth=1.4)
    axes.axvline(theta, color=TEXT_COLOUR, linewidth=1.2, linestyle="--")
    axes.set_xlim(*limits)
    axes.locator_params(axis="x", nbins=6)
    hidden = int(np.sum((values < limits[0]) | (values > limits[1])))
    note = describe(trials, index, unit, hidden)
    axes.text(
        0.0,
        1.02,
        note,
        transform=axes.transAxes,
        va="bottom",
        fontsize=SMALL_FONT,
        color=MUTED_COLOUR,
    )


def draw_overlay(axes: Axes, study: MonteCarloStudy, index: int) -> None:
    """All trajectories on one axis, each scaled to its own peak."""
    theta = float(study.theta[index])
    columns = {name: finite_column(trials, index) for name, trials in study.sets.items()}
    bounds = {
        name: float(np.sqrt(trials.crlb[index, index])) for name, trials in study.sets.items()
    }
    ranges = [
        central_range(values, theta, bounds[name])
        for name, values in columns.items()
        if values.size
    ]
    if not ranges:
        write_message(axes, "no successful trials")
        return
    for name, values in columns.items():
        if values.size:
            colour = TRAJECTORY_STYLES.get(name, (name, OTHER_COLOUR))[1]
            heights, edges = densities(values, central_range(values, theta, np.inf))
            axes.stairs(
                heights / max(heights.max(), 1e-300), edges, fill=True, color=colour, alpha=0.5
            )
    axes.axvline(theta, color=TEXT_COLOUR, linewidth=1.2, linestyle="--")
    axes.set_xlim(min(r[0] for r in ranges), max(r[1] for r in ranges))
    axes.set_ylim(0.0, 1.08)


def histogram(study: MonteCarloStudy, index: int, labels: Labels) -> Figure:
    """Monte-Carlo estimates of parameter `index` along each trajectory (paper's figures 4 to 6)."""
    labels.check(parameters=len(study.theta))
    if not 0 <= index < len(study.theta):
        raise MjfimError(f"the study has no parameter {index}; valid: 0 to {len(study.theta) - 1}")
    unit, theta = labels.parameter_units[index], float(study.theta[index])
    figure = new_figure(max(4.1 * len(study.sets), 5.0), 5.3)
    grid = figure.add_gridspec(2, len(study.sets), height_ratios=(2.6, 1.0))
    for k, (name, trials) in enumerate(study.sets.items()):
        axes = format_axes(
            figure.add_subplot(grid[0, k]),
            labels.parameter(index),
            f"density [{quotient_unit('', unit)}]",
        )
        draw_panel(
            axes, trials, index, theta, unit, TRAJECTORY_STYLES.get(name, (name, OTHER_COLOUR))
        )
    overlay = format_axes(
        figure.add_subplot(grid[1, :]), labels.parameter(index), "density / peak [–]"
    )
    draw_overlay(overlay, study, index)
    overlay.set_title("common axis", loc="left", fontsize=SMALL_FONT, color=MUTED_COLOUR)
    handles = [
        Patch(
            facecolor=TRAJECTORY_STYLES.get(n, (n, OTHER_COLOUR))[1],
            alpha=0.5,
            label=TRAJECTORY_STYLES.get(n, (n, OTHER_COLOUR))[0],
        )
        for n in study.sets
    ]
    lines = [
        Line2D(
            [],
            [],
            color=TEXT_COLOUR,
            linestyle="--",
            label=f"true value {format_number(theta)} {unit}".rstrip(),
        ),
        Line2D([], [], color=TEXT_COLOUR, label="normal curve of the Cramér–Rao bound"),
    ]
    title = f"Monte-Carlo estimates of {labels.parameters[index]}"
    note = "Simulated noise of the stated sigma on the model itself; the panels above have different ranges."
    add_title(figure, title, [*handles, *lines], note)
    return figure


def shown_outputs(residual: Array, sigma: Array) -> NDArray[np.intp]:
    """Outputs to draw: all, or the worst ones by residual over sigma, in their own order."""
    squares = np.where(np.isfinite(residual), residual, 0.0) ** 2
    count = np.maximum(np.isfinite(residual).sum(axis=0), 1)
    worst = np.argsort(-(squares.sum(axis=0) / count / sigma**2), kind="stable")[:MAX_OUTPUTS]
    return np.sort(worst)


def draw_fit(axes: Axes, recording: Recording, predicted: Array, column: int) -> None:
    """Measured dots and predicted line of one output."""
    rows = evenly_spread_indices(len(recording.t), MAX_ROWS)
    size = float(np.clip(900.0 / len(rows), 1.5, 4.0))
    axes.plot(
        recording.t[rows], recording.y[rows, column], ".", color=MEASURED_COLOUR, markersize=size
    )
    axes.plot(recording.t[rows], predicted[rows, column], color=TEXT_COLOUR, linewidth=1.2)


def draw_residual(axes: Axes, t: Array, residual: Array, sigma: float) -> None:
    """Measured minus predicted with the band of two sigma, and the share outside it."""
    known = residual[np.isfinite(residual)]
    axes.axhspan(-2.0 * sigma, 2.0 * sigma, color=GRID_COLOUR, alpha=0.8, linewidth=0)
    axes.axhline(0.0, color=TEXT_COLOUR, linewidth=0.8)
    rows = evenly_spread_indices(len(t), MAX_ROWS)
    size = float(np.clip(900.0 / len(rows), 1.5, 4.0))
    axes.plot(t[rows], residual[rows], ".", color=MEASURED_COLOUR, markersize=size)
    if not known.size:
        write_message(axes, "not measured")
        return
    outside = 100.0 * float(np.mean(np.abs(known) > 2.0 * sigma))
    text = f"rms / σ = {np.sqrt(np.mean(known**2)) / sigma:.2f},  {outside:.1f} % outside"
    axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=3)


def fit(estimate: Estimate, index: int, labels: Labels, sigma: Sequence[float] | Array) -> Figure:
    """Measured against predicted outputs of recording `index`, with residuals.

    sigma: (ny,) stated noise of each output [output's unit]
    """
    if not 0 <= index < len(estimate.recordings):
        raise MjfimError(
            f"the estimate has no recording {index}; valid: 0 to {len(estimate.recordings) - 1}"
        )
    recording, predicted = estimate.recordings[index], estimate.predicted[index]
    noise = np.asarray(sigma, dtype=np.float64)
    if noise.shape != (len(recording.outputs),) or not (noise > 0.0).all():
        raise MjfimError(
            f"sigma must hold one positive number for each of {', '.join(recording.outputs)}"
        )
    residual = recording.y - predicted
    columns = shown_outputs(residual, noise)
    figure = new_figure(10.0, 1.45 * len(columns) + 1.1)
    grid = figure.subplots(len(columns), 2, squeeze=False, sharex=True, width_ratios=(1.5, 1.0))
    for (left, right), column in zip(grid, columns, strict=True):
        label = labels.output(recording.outputs[column])
        draw_fit(left, recording, predicted, int(column))
        draw_residual(right, recording.t, residual[:, column], float(noise[column]))
        format_axes(left, ylabel=break_before_unit(label))
        format_axes(right, ylabel=f"residual [{split_unit(label)[1]}]")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    handles = [
        Line2D([], [], color=MEASURED_COLOUR, marker=".", linestyle="", label="measured"),
        Line2D([], [], color=TEXT_COLOUR, label="predicted"),
        Patch(color=GRID_COLOUR, label="±2σ of the noise"),
    ]
    note = "Residual: measured − predicted; 4.6 % outside ±2σ is expected if the model and the noise are right."
    if len(columns) < len(recording.outputs):
        note += f" Shown: the {len(columns)} of {len(recording.outputs)} outputs with the largest residual over sigma."
    add_title(figure, f"Fit to {Path(recording.name).name}", handles, note)
    return figure
