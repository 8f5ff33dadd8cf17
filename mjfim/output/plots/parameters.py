"""Figures with a row per parameter: predicted standard deviations, estimates with intervals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Transform

from mjfim.arrays import NORMAL_95, Array
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    IDENTIFIED_COLOUR,
    INITIAL_COLOUR,
    NOMINAL_COLOUR,
    NORMAL_FONT,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    format_number,
    format_with_uncertainty,
    new_figure,
    own_style,
    set_plain_log_ticks,
    shorten,
    shorten_label,
    without_zeros,
)
from mjfim.output.summaries.accuracy import BEST_CASE, improvement, relative, size_sentence
from mjfim.output.vocabulary import IDENTIFIED, NOMINAL
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels

# Largest number of rows that are high; more rows are lower and their bars have no numbers.
MAX_HIGH_ROWS = 12

# Height of a bar, and distance of the two bars of a row from its middle, as shares of the height of
# a row.
BAR_HEIGHT, BAR_OFFSET = 0.36, 0.19

# Distances from the guess beyond which an interval, and an estimate, are cut off so that the others
# stay visible, over the median distance of the ends of the intervals.
MAX_RELATIVE_WIDTH, MAX_RELATIVE_DISTANCE = 5.0, 20.0


# ---- predicted standard deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class _Accuracies:
    """Predicted accuracy of n parameters and combinations along both trajectories.

    Attributes:
        names: n names with units.
        sizes: (n,) sizes of which standard deviations are a share [theta-unit].
        std_initial: (n,) standard deviations along the initial trajectory [theta-unit].
        std_final: (n,) standard deviations along the designed trajectory [theta-unit].
    """

    names: list[str]
    sizes: Array
    std_initial: Array
    std_final: Array


@own_style
def std_bars(design: Design, labels: Labels) -> Figure:
    """Draw the predicted standard deviations along both trajectories.

    Each wanted parameter and each combination has a row.

    Args:
        design: The design.
        labels: Labels of the parameters.

    Raises:
        MjfimError: The labels do not fit the design.
    """
    labels.check(parameters=len(design.theta))
    accuracies = _accuracies(design, labels)
    stds = np.concatenate([accuracies.std_initial, accuracies.std_final])
    count = len(accuracies.names)
    row_height = 0.5 if count <= MAX_HIGH_ROWS else 0.3

    figure = new_figure(1.7 + row_height * count)
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_xlim(*_bar_limits(stds))
    axes.set_ylim(count - 0.45, -0.55)
    _draw_bars(axes, accuracies.std_initial, -BAR_OFFSET, INITIAL_COLOUR)
    _draw_bars(axes, accuracies.std_final, BAR_OFFSET, DESIGNED_COLOUR)

    set_plain_log_ticks(axes.xaxis)
    format_axes(axes, "predicted σ [unit of the parameter]")
    axes.grid(False, axis="y")
    axes.set_yticks(range(count), accuracies.names)
    _write_columns(axes, accuracies)

    handles = [
        Patch(color=INITIAL_COLOUR, label="initial"),
        Patch(color=DESIGNED_COLOUR, label="designed"),
    ]
    note = BEST_CASE
    if not np.isfinite(stds).all():
        note += " ∞: the parameter is not identifiable alone from this trajectory."
    if of_size := size_sentence(design.theta, design.sizes):
        note += f" {of_size}"
    add_title(figure, "Predicted accuracy (Cramér–Rao)", handles, note)
    return figure


def _accuracies(design: Design, labels: Labels) -> _Accuracies:
    """Collect the wanted parameters and the combinations of a design."""
    wanted = list(design.wanted)
    combined = design.combined
    names = [shorten_label(labels.parameter(j)) for j in wanted]
    names += [shorten(combination.expression) for combination in combined]

    sizes = [*design.sizes[wanted], *(abs(combination.value) for combination in combined)]
    initial = [*design.initial.std[wanted], *(c.std_initial for c in combined)]
    final = [*design.final.std[wanted], *(c.std_final for c in combined)]
    return _Accuracies(
        names=names,
        sizes=np.array(sizes),
        std_initial=np.array(initial),
        std_final=np.array(final),
    )


def _bar_limits(stds: Array) -> tuple[float, float]:
    """Return the limits of a logarithmic axis around all finite positive values. stds: (n,)."""
    finite = stds[np.isfinite(stds) & (stds > 0.0)]
    if not finite.size:
        return 0.1, 10.0

    # Infinite bars reach beyond all others.
    headroom = 3.0 if np.isfinite(stds).all() else 30.0
    return float(finite.min()) / 3.0, float(finite.max()) * headroom


def _draw_bars(axes: Axes, std: Array, offset: float, colour: str) -> None:
    """Draw the bars of one trajectory.

    The bar of an infinite value is hatched and crosses the whole axis.

    Args:
        axes: Axes with their final limits.
        std: (n,) standard deviations [theta-unit].
        offset: Distance of the bars from the middle of their rows, as a share of the height of a
            row.
        colour: Colour of the trajectory.
    """
    places = np.arange(len(std)) + offset
    known = np.isfinite(std)

    if len(std) <= MAX_HIGH_ROWS:
        for value, place in zip(std[known], places[known], strict=True):
            text = f" {format_number(float(value))}"
            axes.text(value, place, text, va="center", fontsize=SMALL_FONT, color=colour)
    axes.barh(places[known], std[known], height=BAR_HEIGHT, color=colour)

    right = axes.get_xlim()[1]
    axes.barh(
        places[~known],
        right,
        height=BAR_HEIGHT,
        facecolor="white",
        edgecolor=colour,
        hatch="////",
        linewidth=0.8,
    )
    for place in places[~known]:
        axes.text(
            right,
            place,
            "∞ ",
            ha="right",
            va="center",
            fontsize=NORMAL_FONT,
            color=colour,
            backgroundcolor="white",
        )


def _write_columns(axes: Axes, accuracies: _Accuracies) -> None:
    """Write three columns beside the bars: both relative standard deviations, and the change."""
    sizes = accuracies.sizes.tolist()
    initial, final = accuracies.std_initial.tolist(), accuracies.std_final.tolist()
    initial_texts = [str(relative(*pair)) for pair in zip(initial, sizes, strict=True)]
    final_texts = [str(relative(*pair)) for pair in zip(final, sizes, strict=True)]
    changes = [improvement(*pair) for pair in zip(initial, final, strict=True)]

    # Right edge of each column [points], behind the right end of the axis.
    _write_column(axes, 62.0, "relative σ", initial_texts, INITIAL_COLOUR)
    _write_column(axes, 126.0, "relative σ", final_texts, DESIGNED_COLOUR)
    _write_column(axes, 182.0, "change", changes, TEXT_COLOUR)


def _write_column(axes: Axes, right: float, heading: str, texts: list[str], colour: str) -> None:
    """Write a heading and a text per row, aligned at `right` points behind the end of the axis."""
    _write_at_offset(axes, 1.0, "axes fraction", (right, 6.0), heading, colour)

    rows = axes.get_yaxis_transform()
    for row, text in enumerate(texts):
        _write_at_offset(axes, row, rows, (right, 0.0), text, colour)


def _write_at_offset(
    axes: Axes,
    height: float,
    system: str | Transform,
    offset: tuple[float, float],
    text: str,
    colour: str,
) -> None:
    """Write text that ends at an offset [points] from the right end of the axes.

    `height` is in the coordinates `system`.
    """
    axes.annotate(
        text,
        (1.0, height),
        xycoords=system,
        xytext=offset,
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=NORMAL_FONT,
        color=colour,
        annotation_clip=False,
    )


# ---- estimates with their intervals


@dataclass(frozen=True, kw_only=True, eq=False)
class _RelativeEstimate:
    """Estimates relative to their guesses [% of the guess]; NaN where the guess is 0.

    Attributes:
        centre: (p,) difference of the estimates from the guesses.
        formal_half_width: (p,) half widths of the formal 95 % intervals.
        interval: (p, 2) ends of the 95 % intervals that allow for autocorrelated residuals.
    """

    centre: Array
    formal_half_width: Array
    interval: Array


@own_style
def parameter_intervals(estimate: Estimate, labels: Labels) -> Figure:
    """Draw estimates with 95 % intervals relative to the guess; an estimate at its bound is marked.

    Args:
        estimate: The estimate.
        labels: Labels of the parameters.

    Raises:
        MjfimError: The labels do not fit the estimate.
    """
    count = len(estimate.theta)
    labels.check(parameters=count)
    difference = _difference_from_guess(estimate)
    row_height = 0.42 if count <= MAX_HIGH_ROWS else 0.27

    figure = new_figure(1.9 + row_height * count)
    axes = figure.subplots()
    axes.set(xlim=_interval_limits(difference), ylim=(count - 0.4, -0.6))
    axes.axvline(0.0, color=NOMINAL_COLOUR, linewidth=1.6)
    for j, name in enumerate(estimate.parameters):
        if np.isfinite(difference.centre[j]):
            _draw_interval(axes, difference, j, at_bound=name in estimate.at_bound)
        axes.text(
            1.02,
            j,
            _interval_text(estimate, j, labels.parameter_units[j]),
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=SMALL_FONT,
            color=TEXT_COLOUR,
        )

    format_axes(axes, f"difference from the {NOMINAL.word} value [%]")
    axes.set_yticks(range(count), [shorten_label(labels.parameter(j)) for j in range(count)])
    note = _interval_note(estimate, guess_of_zero=bool(np.isnan(difference.centre).any()))
    add_title(figure, "Estimated parameters", _interval_handles(estimate), note)
    return figure


def _difference_from_guess(estimate: Estimate) -> _RelativeEstimate:
    """Express estimates and intervals as percent of the size of the guess."""
    guess = estimate.initial_theta
    sizes = estimate.guess_sizes
    percent = np.where(sizes > 0.0, sizes, np.nan) / 100.0
    return _RelativeEstimate(
        centre=(estimate.theta - guess) / percent,
        formal_half_width=NORMAL_95 * estimate.std / percent,
        interval=(estimate.interval - guess[:, None]) / percent[:, None],
    )


def _interval_limits(difference: _RelativeEstimate) -> tuple[float, float]:
    """Return the limits of the axis [%]; few very wide intervals do not widen it."""
    known = np.isfinite(difference.centre)
    centre = difference.centre[known]
    reach = np.abs(difference.interval - difference.centre[:, None])[known]

    # Few intervals that reach much farther from the guess than the others are cut off.
    ends = np.stack([centre - reach[:, 0], centre + reach[:, 1]])
    distance = np.abs(ends).max(axis=0)
    finite = distance[np.isfinite(distance)]
    usual = float(np.median(finite)) if finite.size else 1.0
    near = centre[np.abs(centre) <= MAX_RELATIVE_DISTANCE * usual]
    largest = max(MAX_RELATIVE_WIDTH * usual, float(np.abs(near).max(initial=0.0)))
    ends = np.clip(ends, -largest, largest)

    low = float(np.min(ends, initial=0.0))
    high = float(np.max(ends, initial=0.0))
    margin = 0.08 * max(high - low, 1e-6)
    return low - margin, high + margin


def _draw_interval(axes: Axes, difference: _RelativeEstimate, j: int, *, at_bound: bool) -> None:
    """Draw one estimate with its formal interval (thick) and its honest one (thin).

    Arrows mark where the axis cuts an interval off.
    """
    low, high = axes.get_xlim()
    centre = float(difference.centre[j])
    half = float(difference.formal_half_width[j])
    if np.isfinite(half):
        formal = np.clip((centre - half, centre + half), low, high)
        axes.plot(
            formal, (j, j), color=IDENTIFIED_COLOUR, linewidth=5.0, solid_capstyle="butt", alpha=0.3
        )

    left, right = (float(end) for end in difference.interval[j])
    shown_left, shown_right = np.clip((left, right), low, high).tolist()
    axes.plot(
        (shown_left, shown_right),
        (j, j),
        color=IDENTIFIED_COLOUR,
        linewidth=1.4,
        solid_capstyle="butt",
    )
    _draw_end(axes, shown_left, j, "<" if left < low else "|")
    _draw_end(axes, shown_right, j, ">" if right > high else "|")

    axes.plot(
        centre,
        j,
        "s" if at_bound else "o",
        color=IDENTIFIED_COLOUR,
        markerfacecolor="white" if at_bound else IDENTIFIED_COLOUR,
        markersize=6.5,
        zorder=3,
    )


def _draw_end(axes: Axes, x: float, row: int, marker: str) -> None:
    """Draw the marker at one end of an interval."""
    axes.plot(x, row, marker, color=IDENTIFIED_COLOUR, markersize=7, clip_on=False)


def _interval_text(estimate: Estimate, j: int, unit: str) -> str:
    """Write guess, estimate and half the width of the thin interval of parameter j in its unit."""
    half_width = np.inf
    if np.isfinite(estimate.std[j]):
        low, high = estimate.interval[j]
        half_width = 0.5 * float(high - low)

    guess = without_zeros(format_number(float(estimate.initial_theta[j]), 4))
    value = format_with_uncertainty(float(estimate.theta[j]), half_width)
    text = f"{guess} → {value} {unit}".rstrip()
    if estimate.parameters[j] in estimate.at_bound:
        text += "   (at its bound)"
    return text


def _interval_handles(estimate: Estimate) -> list[Line2D]:
    """Return the entries of the legend."""
    colour = IDENTIFIED_COLOUR
    handles = [
        Line2D([], [], color=NOMINAL_COLOUR, label=NOMINAL.word, linewidth=1.6),
        Line2D(
            [], [], color=colour, marker="o", alpha=0.9, label=f"{IDENTIFIED.word}, 95 % interval"
        ),
        Line2D([], [], color=colour, linewidth=5.0, alpha=0.3, label="formal 95 %"),
    ]
    if estimate.at_bound:
        at_bound = Line2D(
            [],
            [],
            color=colour,
            marker="s",
            markerfacecolor="white",
            linestyle="",
            label="at its bound",
        )
        handles.append(at_bound)
    return handles


def _interval_note(estimate: Estimate, *, guess_of_zero: bool) -> str:
    """Say what the two intervals mean."""
    note = (
        "The formal interval is right only if the model and the noise are right. "
        "The 95 % interval also allows for autocorrelated residuals."
    )
    if estimate.misfit:
        note += (
            " Here the residuals are not explained by noise: "
            "no interval covers the bias of a wrong model."
        )
    if not np.array_equal(np.abs(estimate.theta), estimate.sizes):
        note += " The difference of an entry of a vector or tensor is a share of the whole."
    if guess_of_zero:
        note += " For a nominal value of 0 there is no relative difference, only numbers."
    return note
