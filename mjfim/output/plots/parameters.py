"""Figures with one row per parameter: predicted standard deviations, estimates with their intervals."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Transform

from mjfim.arrays import Array
from mjfim.output.labels import Labels
from mjfim.output.plots.style import (
    BEST_CASE,
    INITIAL_COLOUR,
    NORMAL_FONT,
    OPTIMIZED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    format_percent,
    format_with_uncertainty,
    new_figure,
    shorten,
    shorten_label,
)
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate

QUANTILE_95 = 1.959964
ROOMY = 12


def bar_limits(*stds: Array) -> tuple[float, float]:
    """Log-axis limits around all finite positive values."""
    values = np.concatenate(stds)
    finite = values[np.isfinite(values) & (values > 0.0)]
    if not finite.size:
        return 0.1, 10.0
    low, high = float(finite.min()), float(finite.max())
    return low / 3.0, high * (3.0 if np.isfinite(values).all() else 30.0)


def draw_bars(axes: Axes, std: Array, offset: float, colour: str) -> None:
    """One trajectory's bars; an infinite std becomes a hatched bar across the whole axis."""
    high = axes.get_xlim()[1]
    places = np.arange(len(std)) + offset
    known = np.isfinite(std)
    if len(std) <= ROOMY:
        for x, y in zip(std[known], places[known], strict=True):
            axes.text(
                x, y, f" {format_number(float(x))}", va="center", fontsize=SMALL_FONT, color=colour
            )
    axes.barh(places[known], std[known], height=0.36, color=colour)
    axes.barh(
        places[~known],
        high,
        height=0.36,
        facecolor="white",
        edgecolor=colour,
        hatch="////",
        linewidth=0.8,
    )
    for y in places[~known]:
        axes.text(
            high,
            y,
            "∞ ",
            ha="right",
            va="center",
            fontsize=NORMAL_FONT,
            color=colour,
            backgroundcolor="white",
        )


def annotate_bars(axes: Axes, values: Array, before: Array, after: Array) -> None:
    """Columns right of the bars: std as percent of the value for both trajectories, and the ratio of the stds."""
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = [np.abs(std / values) for std in (before, after)]
        ratio = before / after
    cells = [
        (62.0, INITIAL_COLOUR, "of value", [format_percent(v) for v in relative[0]]),
        (122.0, OPTIMIZED_COLOUR, "of value", [format_percent(v) for v in relative[1]]),
        (
            178.0,
            TEXT_COLOUR,
            "ratio",
            [f"{format_number(v)}×" if np.isfinite(v) else format_number(v) for v in ratio],
        ),
    ]
    for x, colour, title, texts in cells:
        place_text(axes, (1.0, 1.0), "axes fraction", (x, 6.0), title, colour)
        for y, text in enumerate(texts):
            place_text(axes, (1.0, y), axes.get_yaxis_transform(), (x, 0.0), text, colour)


def place_text(
    axes: Axes,
    anchor: tuple[float, float],
    system: str | Transform,
    offset: tuple[float, float],
    text: str,
    colour: str,
) -> None:
    """Right-aligned text at an offset [point] from an anchor."""
    axes.annotate(
        text,
        anchor,
        xycoords=system,
        xytext=offset,
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=NORMAL_FONT,
        color=colour,
        annotation_clip=False,
    )


def std_bars(design: Design, labels: Labels) -> Figure:
    """Predicted standard deviation of every wanted parameter and combination along both trajectories, with the gain."""
    labels.check(parameters=len(design.theta))
    shown = list(design.wanted)
    names = [
        *(shorten_label(labels.parameter(j)) for j in shown),
        *(shorten(c.expression) for c in design.combined),
    ]
    values = np.array([*design.theta[shown], *(c.value for c in design.combined)])
    before = np.array([*design.initial.std[shown], *(c.std_initial for c in design.combined)])
    after = np.array([*design.final.std[shown], *(c.std_final for c in design.combined)])
    count = len(names)
    figure = new_figure(9.0, 1.7 + (0.5 if count <= ROOMY else 0.3) * count)
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlim(*bar_limits(before, after))
    axes.set_ylim(count - 0.45, -0.55)
    draw_bars(axes, before, -0.19, INITIAL_COLOUR)
    draw_bars(axes, after, 0.19, OPTIMIZED_COLOUR)
    format_axes(axes, "predicted standard deviation [unit of the parameter]")
    axes.grid(False, axis="y")
    axes.set_yticks(range(count), names)
    annotate_bars(axes, values, before, after)
    note = BEST_CASE
    handles = [
        Patch(color=INITIAL_COLOUR, label="initial"),
        Patch(color=OPTIMIZED_COLOUR, label="optimized"),
    ]
    if not np.isfinite(np.concatenate([before, after])).all():
        note += " ∞: this trajectory does not determine the parameter by itself."
    add_title(figure, "Predicted accuracy (Cramér–Rao)", handles, note)
    return figure


def relative_axis(offset: Array, ends: Array) -> tuple[float, float]:
    """Axis limits [%]: the guess, all estimates, and all intervals (p, 2) unless a few dwarf the rest."""
    known = np.isfinite(offset)
    centres, reach = offset[known], np.abs(ends - offset[:, None])[known]
    finite = reach[np.isfinite(reach)]
    widest = 5.0 * float(np.median(finite)) + float(np.abs(centres).max()) if finite.size else 1.0
    shown = np.minimum(reach, widest)
    low = min(0.0, float(np.min(centres - shown[:, 0], initial=0.0)))
    high = max(0.0, float(np.max(centres + shown[:, 1], initial=0.0)))
    margin = 0.08 * max(high - low, 1e-6)
    return low - margin, high + margin


def draw_interval(
    axes: Axes, y: int, centre: float, half: float, wide: tuple[float, float], bound: bool
) -> None:
    """One estimate with its formal interval, thick, in the honest one, thin; arrows where that leaves the axis."""
    low, high = axes.get_xlim()
    if np.isfinite(half):
        inner = (max(centre - half, low), min(centre + half, high))
        axes.plot(
            inner, (y, y), color=OPTIMIZED_COLOUR, linewidth=5.0, solid_capstyle="butt", alpha=0.3
        )
    ends = (max(wide[0], low), min(wide[1], high))
    axes.plot(ends, (y, y), color=OPTIMIZED_COLOUR, linewidth=1.4, solid_capstyle="butt")
    for end, marker, cut in ((ends[0], "<", wide[0] < low), (ends[1], ">", wide[1] > high)):
        axes.plot(
            end, y, marker if cut else "|", color=OPTIMIZED_COLOUR, markersize=7, clip_on=False
        )
    face = "white" if bound else OPTIMIZED_COLOUR
    axes.plot(
        centre,
        y,
        "s" if bound else "o",
        color=OPTIMIZED_COLOUR,
        markerfacecolor=face,
        markersize=6.5,
        zorder=3,
    )


def interval_text(estimate: Estimate, j: int, unit: str) -> str:
    """Guess, estimate and half width of the honest interval in the parameter's unit."""
    low, high = estimate.interval[j]
    half = 0.5 * float(high - low) if np.isfinite(estimate.std[j]) else np.inf
    guess = format_number(float(estimate.initial_theta[j]), 4)
    text = f"{guess} → {format_with_uncertainty(float(estimate.theta[j]), half)} {unit}"
    return text.rstrip() + (
        "   at its bound" if estimate.parameters[j] in estimate.at_bound else ""
    )


def parameter_intervals(estimate: Estimate, labels: Labels) -> Figure:
    """Estimates with 95 % intervals relative to the guess; a bound that holds an estimate is flagged."""
    count = len(estimate.theta)
    labels.check(parameters=count)
    scale = np.where(estimate.initial_theta == 0.0, np.nan, np.abs(estimate.initial_theta)) / 100.0
    offset = (estimate.theta - estimate.initial_theta) / scale
    half = QUANTILE_95 * estimate.std / scale
    wide = (estimate.interval - estimate.initial_theta[:, None]) / scale[:, None]
    figure = new_figure(9.5, 1.9 + (0.42 if count <= 12 else 0.27) * count)
    axes = figure.subplots()
    axes.set(xlim=relative_axis(offset, wide), ylim=(count - 0.4, -0.6))
    axes.axvline(0.0, color=INITIAL_COLOUR, linewidth=1.6)
    for j in range(count):
        if np.isfinite(offset[j]):
            ends = (float(wide[j, 0]), float(wide[j, 1]))
            bound = estimate.parameters[j] in estimate.at_bound
            draw_interval(axes, j, float(offset[j]), float(half[j]), ends, bound)
        text = interval_text(estimate, j, labels.parameter_units[j])
        axes.text(
            1.02,
            j,
            text,
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=SMALL_FONT,
            color=TEXT_COLOUR,
        )
    format_axes(axes, "difference from the guess [% of the guess]")
    axes.set_yticks(range(count), [shorten_label(labels.parameter(j)) for j in range(count)])
    handles = [
        Line2D([], [], color=INITIAL_COLOUR, label="guess", linewidth=1.6),
        Line2D(
            [], [], color=OPTIMIZED_COLOUR, marker="o", alpha=0.9, label="estimate, 95 % interval"
        ),
        Line2D([], [], color=OPTIMIZED_COLOUR, linewidth=5.0, alpha=0.3, label="formal 95 %"),
        Line2D(
            [],
            [],
            color=OPTIMIZED_COLOUR,
            marker="s",
            markerfacecolor="white",
            linestyle="",
            label="at its bound",
        ),
    ]
    note = "Formal: a best case that holds if the model and the noise are right. The thin line allows for residuals that are not."
    if estimate.misfit:
        note += " Here the residuals are not noise: no interval covers what a wrong model does to the parameters."
    if np.isnan(scale).any():
        note += " A guess of 0 has no relative scale and is given as text only."
    add_title(figure, "Estimated parameters", handles, note)
    return figure
