"""Figures of the joint uncertainty of pairs of parameters, as ellipses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.distributions import normal_density
from mjfim.output.plots.check import colour_of_source, duration
from mjfim.output.plots.style import (
    IDENTIFIED_COLOUR,
    NOMINAL_COLOUR,
    SMALL_FONT,
    add_title,
    fit_text,
    format_axes,
    format_number,
    new_figure,
    own_style,
    shorten,
)
from mjfim.output.summaries.accuracy import BEST_CASE
from mjfim.output.vocabulary import NOMINAL
from mjfim.records.check import Check
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels

# Largest number of parameters of a figure; of more, those with the largest correlations are drawn.
MAX_PARAMETERS = 6

# Half the range of every axis, and places of its ticks [standard deviations].
RANGE, TICK = 3.2, 2.0

# Standard deviations of the ellipses, each with its opacity.
ELLIPSES = ((2.0, 0.18), (1.0, 0.35))

# Number of points of a curve.
CURVE_POINTS = 90

# Characters to which the names of parameters are shortened above a panel, and width of them beside
# an axis [inch].
NAME_WIDTH, LABEL_WIDTH = 18, 1.05

# Largest number of decimals of a value at an axis, and size up to which it has no power of ten.
MAX_DECIMALS, LARGEST_PLAIN = 6, 1e5

# Smallest and largest number of digits of other values.
MIN_DIGITS, MAX_DIGITS = 2, 6

# Height of the mark of the guess in the panel of a density.
GUESS_HEIGHT = 0.02

# Height of a row of panels, and of all that is above and below them [inch].
ROW_HEIGHT, FRAME_HEIGHT = 1.15, 1.3


@dataclass(frozen=True, kw_only=True, eq=False)
class _Estimates:
    """Parameters with their values and their joint uncertainty.

    Attributes:
        names: Names of the k parameters.
        units: Their units; may be empty.
        values: (k,) values [theta-unit].
        covariance: (k, k) covariance [product of the units].
        guess: (k,) initial guess [theta-unit], or None.
        colour: Colour of the ellipses.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    covariance: Array
    guess: Array | None
    colour: str

    @property
    def std(self) -> Array:
        """(k,) standard deviations [theta-unit]."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def guess_in_stds(self) -> Array | None:
        """(k,) differences of the guess from the values, in standard deviations, or None."""
        return None if self.guess is None else (self.guess - self.values) / self.std

    @property
    def has_guess_in_range(self) -> bool:
        """Whether the guess of at least one parameter is on its axis."""
        guess = self.guess_in_stds
        return guess is not None and bool((np.abs(guess) < RANGE).any())

    def part(self, chosen: NDArray[np.intp]) -> _Estimates:
        """Return some of the parameters."""
        return _Estimates(
            names=tuple(self.names[j] for j in chosen),
            units=tuple(self.units[j] for j in chosen),
            values=self.values[chosen],
            covariance=self.covariance[np.ix_(chosen, chosen)],
            guess=None if self.guess is None else self.guess[chosen],
            colour=self.colour,
        )


def has_pairs(std: Array) -> bool:
    """Return whether at least two parameters have a standard deviation.

    Args:
        std: (k,) standard deviations; infinite or NaN where there is none.
    """
    return bool(np.count_nonzero(np.isfinite(std) & (std > 0.0)) > 1)


@own_style
def estimate_pairs(estimate: Estimate, labels: Labels) -> Figure:
    """Draw the joint uncertainty of the estimates of every pair of parameters.

    Args:
        estimate: The estimate.
        labels: Labels of the parameters.

    Raises:
        MjfimError: The labels do not fit the estimate.
    """
    labels.check(parameters=len(estimate.theta))
    estimates = _Estimates(
        names=estimate.parameters,
        units=labels.parameter_units,
        values=estimate.theta,
        covariance=estimate.covariance,
        guess=estimate.initial_theta,
        colour=IDENTIFIED_COLOUR,
    )
    note = "Formal uncertainty: it is right only if the model and the noise are right."
    return _draw(estimates, "Joint uncertainty of the identified parameters", note)


@own_style
def check_pairs(check: Check) -> Figure:
    """Draw the predicted joint uncertainty of the estimates of every pair of parameters.

    Args:
        check: The check.
    """
    rows = [row for row in check.rows if not row.nuisance]
    std = np.array([row.std for row in rows])
    scale = np.where(np.isfinite(std), std, np.nan)
    estimates = _Estimates(
        names=tuple(row.name for row in rows),
        units=tuple(row.unit for row in rows),
        values=np.array([row.value for row in rows]),
        covariance=check.correlation * np.outer(scale, scale),
        guess=None,
        colour=colour_of_source(check),
    )
    title = f"Predicted joint uncertainty, {check.source} ({duration(check)})"
    return _draw(estimates, title, BEST_CASE)


def _draw(estimates: _Estimates, title: str, note: str) -> Figure:
    """Draw a density per parameter, and ellipses for every pair."""
    chosen = _shown_parameters(estimates)
    shown = estimates.part(chosen)
    count = len(chosen)
    figure = new_figure(ROW_HEIGHT * count + FRAME_HEIGHT)
    grid = figure.add_gridspec(count, count)
    for i in range(count):
        for j in range(i + 1):
            axes = figure.add_subplot(grid[i, j])
            if i == j:
                _draw_density(axes, shown, i)
            else:
                _draw_ellipses(axes, shown, i, j)
            _label_ticks(axes, shown, i, j)

    handles = [
        Line2D([], [], color=shown.colour, linewidth=7.0, alpha=opacity + 0.1, label=f"{size:g} σ")
        for size, opacity in reversed(ELLIPSES)
    ]
    if shown.has_guess_in_range:
        handles.append(
            Line2D([], [], color=NOMINAL_COLOUR, marker="x", linestyle="", label=NOMINAL.word)
        )
    if count < len(estimates.names):
        note += (
            f" Shown: {count} of {len(estimates.names)} parameters, those with the largest "
            "correlations."
        )
    add_title(figure, title, handles, note)
    return figure


def _shown_parameters(estimates: _Estimates) -> NDArray[np.intp]:
    """Return the parameters to draw: of many, those with the largest correlations."""
    std = estimates.std
    known = np.flatnonzero(np.isfinite(std) & (std > 0.0))

    covariance = estimates.covariance[np.ix_(known, known)]
    correlation = covariance / np.outer(std[known], std[known])
    np.fill_diagonal(correlation, 0.0)

    # The largest correlation of each parameter with any other one decides.
    largest = np.abs(np.nan_to_num(correlation)).max(axis=0)
    by_correlation = np.argsort(-largest, kind="stable")
    return np.sort(known[by_correlation[:MAX_PARAMETERS]])


def _draw_density(axes: Axes, shown: _Estimates, i: int) -> None:
    """Draw the normal density of one parameter."""
    x = np.linspace(-RANGE, RANGE, CURVE_POINTS)
    density = normal_density(x)
    axes.fill_between(x, density, color=shown.colour, alpha=0.25, linewidth=0.0)
    axes.plot(x, density, color=shown.colour)

    axes.set(xlim=(-RANGE, RANGE), ylim=(0.0, 0.45), yticks=[])
    axes.spines["left"].set_visible(False)
    axes.set_title(shorten(shown.names[i], NAME_WIDTH), fontsize=SMALL_FONT, pad=3)

    guess = shown.guess_in_stds
    if guess is not None:
        _mark_guess(axes, float(guess[i]), GUESS_HEIGHT)


def _draw_ellipses(axes: Axes, shown: _Estimates, i: int, j: int) -> None:
    """Draw the ellipses of parameter j (across) and i (up), in standard deviations."""
    std = shown.std
    ratio = shown.covariance[i, j] / (std[i] * std[j])
    correlation = float(np.clip(ratio, -1.0, 1.0))

    # The ellipse of one standard deviation.
    angle = np.linspace(0.0, 2.0 * np.pi, CURVE_POINTS)
    x = np.cos(angle)
    y = correlation * x + np.sqrt(1.0 - correlation**2) * np.sin(angle)

    for size, opacity in ELLIPSES:
        axes.fill(size * x, size * y, facecolor=shown.colour, alpha=opacity, linewidth=0.0)
    axes.plot(2.0 * x, 2.0 * y, color=shown.colour, linewidth=0.8)
    axes.plot(0.0, 0.0, ".", color=shown.colour, markersize=4)
    axes.set(xlim=(-RANGE, RANGE), ylim=(-RANGE, RANGE))

    guess = shown.guess_in_stds
    if guess is not None:
        _mark_guess(axes, float(guess[j]), float(guess[i]))


def _mark_guess(axes: Axes, x: float, y: float) -> None:
    """Mark the guess at a place in standard deviations, if it lies within the axes."""
    if abs(x) < RANGE and abs(y) < RANGE:
        axes.plot(x, y, "x", color=NOMINAL_COLOUR, markersize=5)


def _label_ticks(axes: Axes, shown: _Estimates, i: int, j: int) -> None:
    """Write values two standard deviations from the estimate at the outer axes."""
    is_lowest, is_left = i == len(shown.names) - 1, j == 0 and i > 0
    format_axes(
        axes,
        _label(shown, j) if is_lowest else "",
        _label(shown, i) if is_left else "",
    )
    axes.xaxis.set_major_locator(FixedLocator([-TICK, TICK]))
    axes.tick_params(labelbottom=is_lowest, labelleft=is_left)
    axes.xaxis.set_major_formatter(lambda x, _: _value(shown, j, x))
    if i != j:
        axes.yaxis.set_major_locator(FixedLocator([-TICK, TICK]))
        axes.yaxis.set_major_formatter(lambda y, _: _value(shown, i, y))


def _label(shown: _Estimates, i: int) -> str:
    """Return the label of an axis: name and unit of a parameter, a line each."""
    name = fit_text(shown.names[i], LABEL_WIDTH, SMALL_FONT)
    return f"{name}\n[{shown.units[i]}]" if shown.units[i] else name


def _value(shown: _Estimates, i: int, stds: float) -> str:
    """Write the value of a parameter at a distance from its estimate, in steps of its σ."""
    estimate, std = float(shown.values[i]), float(shown.std[i])
    value = estimate + stds * std
    largest = abs(estimate) + TICK * std

    # All values of a parameter have the same decimals, those that its σ can change.
    decimals = int(np.ceil(-np.log10(std)))
    if 0 <= decimals <= MAX_DECIMALS and largest < LARGEST_PLAIN:
        return f"{value:.{decimals}f}".replace("-", "−")

    digits = int(np.ceil(np.log10(largest / std))) + 1
    return format_number(value, int(np.clip(digits, MIN_DIGITS, MAX_DIGITS)))
