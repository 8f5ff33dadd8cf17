"""Standard deviations in percent: as dots by their source, and over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjfim.arrays import Array, finite_or_nan
from mjfim.output.page import number
from mjfim.output.panels import Axis, Panel, around, dots, hline, line, row_axis
from mjfim.output.words import relative, shorten

# Height of a picture of accuracies without its rows, of a row, and of one of many rows [inch].
FRAME, ROW, LOW_ROW, MAX_HIGH_ROWS = 0.8, 0.32, 0.2, 20

# Look of the curves of the initial motion, and multiple of the wanted σ up to which σ over time is
# drawn.
INITIAL_LOOK, LARGEST_OVER_TARGET = {"width": 0.9, "dash": "--"}, 10.0


class Accuracies(NamedTuple):
    """Standard deviations of all rows from one source.

    Attributes:
        std: (n,) standard deviations [unit of the row]; infinite where they are not determined, NaN
            where they are unknown.
        role: Role of the dots.
        label: Source in words.
        size: Size of the dots [points].
        hollow: Whether they are white inside.
        symbol: Their symbol, as matplotlib names it.
    """

    std: Array
    role: str
    label: str
    size: float = 7.0
    hollow: bool = False
    symbol: str = "o"


def accuracy_panel(
    names: Sequence[str], sizes: Array, sources: Sequence[Accuracies], wanted: Array
) -> Panel:
    """Return a row of dots for each parameter on one axis in percent.

    Args:
        names: Names of the n rows, with units.
        sizes: (n,) sizes of which percent are taken [unit of the row]; NaN for none.
        sources: What is drawn, the most important one last.
        wanted: (n,) wanted standard deviations, infinite for none [unit of the row].
    """
    rows = np.arange(len(names), dtype=np.float64)
    percent = 100.0 * np.array([source.std for source in sources]) / sizes
    goal = 100.0 * finite_or_nan(wanted) / sizes
    low, high = around(np.concatenate([percent.ravel(), goal]), factor=1.6)

    marks = []
    for row, values in enumerate(percent.T):
        ends = values[np.isfinite(values)]
        if len(ends) > 1:
            marks.append(line([ends.min(), ends.max()], [row, row], "band", width=3.0, front=1.0))
    if np.isfinite(goal).any():
        tick = {"symbol": "|", "size": 13.0, "width": 1.8, "front": 4.0}
        marks.append(dots(goal, rows, "text", label="wanted σ", **tick))
    for source, values in zip(sources, percent, strict=True):
        known = np.isfinite(values)
        look = {"symbol": source.symbol, "size": source.size, "hollow": source.hollow, "front": 3.0}
        marks.append(dots(values[known], rows[known], source.role, label=source.label, **look))
        # An arrow at the edge stands for a parameter that is not identifiable alone.
        lost = np.isinf(source.std)
        if lost.any():
            arrow = {"symbol": ">", "size": 7.0, "hollow": True, "label": "not identifiable alone"}
            marks.append(dots(np.full(lost.sum(), high), rows[lost], source.role, **arrow))
    beside = [
        (source.label, source.role, list(map(share_text, source.std.tolist(), sizes.tolist())))
        for source in sources
    ]
    return Panel(
        marks=marks,
        x=Axis(label="σ [% of the value]", log=True, limits=(low, high * 1.05)),
        y=row_axis(names),
        beside=beside,
    )


def accuracy_over_time_panel(
    motions: Sequence[tuple[Array, Array]],
    names: Sequence[str],
    sizes: Array,
    targets: Array,
    reached: Array,
    shown: Sequence[int],
    *,
    is_stated: bool,
) -> Panel:
    """Return curves of the standard deviations in percent, with the times at which targets are met.

    Args:
        motions: (N,) times [s] and (N, p) standard deviations from the measurements up to them, of
            motions for comparison and then of the one that the panel is about.
        names: Names of the p parameters.
        sizes: (p,) their sizes [theta-unit].
        targets: (p,) wanted standard deviations, infinite for none [theta-unit].
        reached: (p,) times at which they are reached, infinite where they are not [s].
        shown: Numbers of the parameters that are shown.
        is_stated: Whether the experiment states the targets.
    """
    shares = sizes / 100.0
    ends = (np.stack([std[-1] for _, std in motions]) / shares)[:, shown]
    goals = finite_or_nan(targets)[shown] / shares[shown]
    _, high = around(np.concatenate([ends.ravel(), LARGEST_OVER_TARGET * goals]), factor=1.5)
    low, _ = around(np.concatenate([ends.ravel(), goals]), factor=1.5)

    curves, targets_met = [], []
    for place, j in enumerate(shown):
        role, goal = f"series{place}", targets[j] / shares[j]
        final = relative(motions[-1][1][-1, j], sizes[j])
        main = {"width": 2.0, "label": f"{shorten(names[j], among=names)} {final}"}
        for order, (t, std) in enumerate(motions, start=1):
            percent = std[:, j] / shares[j]
            look = main if order == len(motions) else INITIAL_LOOK
            curves.append(line(t, np.where(percent <= high, percent, np.nan), role, **look))
        if np.isfinite(goal):
            word = "wanted σ" if is_stated else f"σ of {goal:.2g} %"
            is_common = np.allclose(goals[np.isfinite(goals)], goal)
            look = {"dash": ":", "width": 1.4, "label": word}
            targets_met.append(hline(goal, "muted" if is_common else role, **look))
        if np.isfinite(goal) and np.isfinite(reached[j]):
            met = {"size": 6.0, "front": 4.0, "label": "reached"}
            targets_met.append(dots([reached[j]], [goal], role, **met))
    return Panel(
        title="σ by the measurements up to each time [% of the value]",
        marks=[*curves, *targets_met],
        x=Axis(label="time [s]"),
        y=Axis(label="σ [%]", log=True, limits=(low, high)),
        message="" if shown else "no parameter is determined alone",
    )


def share_text(std: float, size: float) -> str:
    """Write a standard deviation in percent, or in its unit where there is no size."""
    if np.isnan(std):
        return ""
    return number(std) if np.isnan(size) else relative(std, size)


def height_of_rows(count: int) -> float:
    """Return the height of a picture with this number of rows [inch]."""
    return FRAME + (ROW if count <= MAX_HIGH_ROWS else LOW_ROW) * count
