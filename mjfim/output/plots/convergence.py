"""Figure of the convergence of a design: cost, slope and information over the iterations."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    SMALL_FONT,
    add_title,
    as_sentence,
    format_axes,
    format_number,
    new_figure,
    own_style,
    set_plain_log_ticks,
    write_message,
)
from mjfim.records.design import Design

# Space at both ends of the axis of the iterations, over the number of iterations.
X_MARGIN = 0.04

# Labels of the panels.
COST = "cost J [–]"
SLOPE = "slope |DJ·ζ| [–]"
EIGENVALUE = r"$\lambda_{\min}$  [s / (unit of $\theta$)$^2$]"


@own_style
def convergence(design: Design) -> Figure:
    """Draw cost, slope and smallest eigenvalue over the iterations, logarithmically.

    Args:
        design: The design.
    """
    history = design.history
    iterations = np.array([row.iteration for row in history], dtype=np.float64)
    slope = np.abs(np.array([row.slope for row in history], dtype=np.float64))
    relative_slope = _relative_slope(design, slope)
    values = {
        COST: np.array([row.cost for row in history], dtype=np.float64),
        SLOPE: slope,
        EIGENVALUE: np.array([row.min_eigenvalue for row in history], dtype=np.float64),
    }

    # The search for a release has no slope.
    if history and not np.isfinite(slope).any():
        del values[SLOPE]

    figure = new_figure(3.3)
    panels = figure.subplots(1, len(values))
    for axes, (name, shown) in zip(panels, values.items(), strict=True):
        _draw_history(axes, iterations, shown, relative_slope if name == SLOPE else None)
        _format_panel(axes, name, iterations)

    handles = [
        Line2D([], [], color=INITIAL_COLOUR, marker="o", linestyle="", label=_start_label(design)),
        Line2D([], [], color=DESIGNED_COLOUR, marker="o", linestyle="", label="designed"),
    ]
    if relative_slope is not None:
        handles.append(Line2D([], [], color=MUTED_COLOUR, linestyle=":", label="slope / J"))

    note = " ".join(
        [
            as_sentence(design.outcome),
            *_mark_rates(panels, design, iterations),
            *_mark_barrier_stages(panels, design, iterations),
            *_mark_random_search(panels, iterations, slope),
        ]
    )
    add_title(figure, "Convergence", handles, note)
    return figure


def _relative_slope(design: Design, slope: Array) -> Array | None:
    """Return the slopes (n,) over the cost; None where there are no slopes of the cost itself."""
    # With a barrier the slope is that of log J, which is relative already.
    has_barrier = any(row.mu for row in design.history)
    if has_barrier or (design.history and not np.isfinite(slope).any()):
        return None

    cost = np.abs([row.cost for row in design.history])
    return np.asarray(slope / np.where(cost == 0.0, np.nan, cost), dtype=np.float64)


def _format_panel(axes: Axes, name: str, iterations: Array) -> None:
    """Label a panel, and let it show all iterations."""
    format_axes(axes, "iteration [–]", name)
    axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True))
    if axes.get_yscale() == "log":
        set_plain_log_ticks(axes.yaxis)

    # A search that is stopped early may have one iterate on each of two levels.
    if len(set(iterations)) > 1:
        margin = X_MARGIN * float(np.ptp(iterations))
        axes.set_xlim(iterations.min() - margin, iterations.max() + margin)


def _start_label(design: Design) -> str:
    """Return the name of the first iterate, which is not the initial trajectory in every search."""
    costs = [row.cost for row in design.history[:1]]
    if not costs or np.isclose(costs[0], design.initial.cost, rtol=1e-9, atol=0.0):
        return "initial"
    return f"start: {design.found_by}"


def _draw_history(
    axes: Axes, iterations: Array, values: Array, relative: Array | None = None
) -> None:
    """Draw one quantity over the iterations; dots mark its first and its last value.

    Args:
        axes: Axes of the panel; they become logarithmic unless no value is positive.
        iterations: (n,) numbers of the iterations.
        values: (n,) values; of a logarithmic axis, the positive ones are shown.
        relative: (n,) values of a second, dotted curve.
    """
    if not np.isfinite(values).any():
        write_message(axes, "no iterations recorded")
        return

    shown = np.where(values > 0.0, values, np.nan)
    if np.isfinite(shown).any():
        axes.set_yscale("log")
    else:
        shown = values
    axes.plot(iterations, shown, color=MUTED_COLOUR, linewidth=1.3, marker=".", markersize=3)
    if relative is not None:
        positive = np.where(relative > 0.0, relative, np.nan)
        axes.plot(iterations, positive, color=MUTED_COLOUR, linewidth=1.0, linestyle=":")

    # Dots mark the ends of the search, where they have a value.
    usable = np.flatnonzero(np.isfinite(shown))
    first, last = usable[0], usable[-1]
    if first == 0:
        axes.plot(iterations[0], shown[0], "o", color=INITIAL_COLOUR, markersize=6)
    if last == len(shown) - 1:
        axes.plot(iterations[last], shown[last], "o", color=DESIGNED_COLOUR, markersize=6)
    text = f"{format_number(float(shown[first]))} → {format_number(float(shown[last]))}"
    axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=4)


def _mark_rates(panels: NDArray[np.object_], design: Design, iterations: Array) -> list[str]:
    """Mark the iterations at which the time grid becomes finer; return a sentence about it."""
    rates = np.array([row.rate for row in design.history])
    changes = []
    for k in np.flatnonzero(np.diff(rates)):
        for axes in panels:
            axes.axvline(iterations[k + 1], color=GRID_COLOUR, linewidth=2.0, zorder=0)
        changes.append(f"from {rates[k]:g} to {rates[k + 1]:g} Hz")
    if not changes:
        return []
    return [f"Thick line: the time grid becomes finer, {', then '.join(changes)}."]


def _mark_random_search(panels: NDArray[np.object_], iterations: Array, slope: Array) -> list[str]:
    """Shade the iterations without a slope if others have one; return a sentence about it."""
    unknown = ~np.isfinite(slope)
    if not unknown.any() or unknown.all():
        return []

    # Each run of iterations is shaded from half an iteration before it to half of one behind it.
    change = np.flatnonzero(np.diff(np.concatenate([[False], unknown, [False]]).astype(int)))
    for begin, end in change.reshape(-1, 2):
        for axes in panels:
            low, high = axes.get_xlim()
            left = max(float(iterations[begin]) - 0.5, low)
            right = min(float(iterations[end - 1]) + 0.5, high)
            axes.axvspan(left, right, color=GRID_COLOUR, alpha=0.5, linewidth=0.0)
    return ["Shaded: a random search, which has no slope."]


def _mark_barrier_stages(
    panels: NDArray[np.object_], design: Design, iterations: Array
) -> list[str]:
    """Mark the iterations at which a new barrier stage begins; return a sentence about it."""
    mu = np.array([row.mu for row in design.history])
    if not mu.any():
        return []

    for k in np.flatnonzero(mu[1:] != mu[:-1]):
        for axes in panels:
            axes.axvline(
                iterations[k + 1], color=GRID_COLOUR, linewidth=1.0, linestyle="--", zorder=0
            )
    return [
        "Dashed lines: a new barrier stage begins; with limits, the slope is that of log J plus "
        "the barrier."
    ]
