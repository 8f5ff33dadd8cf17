"""Tables as images, ruled as in print: eigenvalues, Cramer-Rao bounds, Monte-Carlo covariances."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

from mjfim.arrays import Array
from mjfim.output.labels import Labels
from mjfim.output.plots.style import (
    BEST_CASE,
    INITIAL,
    INK,
    LARGE,
    MUTED,
    NORMAL,
    OPTIMIZED,
    OTHER,
    SMALL,
    STYLES,
    brief,
    new_figure,
    number,
    percent,
    shorten,
)
from mjfim.records.design import Design
from mjfim.records.monte_carlo import MonteCarloStudy

ROW = 0.26  # [inch]
GAP = 0.28  # between columns [inch]
MARGIN = 0.3
MAX_MATRIX = 5
MAX_EIGENVALUES = 6


@dataclass(frozen=True)
class Group:
    """A heading over the columns first..last (inclusive) of a block."""

    text: str
    first: int
    last: int
    colour: str


@dataclass(frozen=True)
class Block:
    """One ruled table: title, optional column groups, header, rows of text; colours of the first cells by row."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    groups: tuple[Group, ...] = ()
    colours: tuple[str, ...] = ()

    @property
    def height(self) -> float:
        """Height with title and gap below [inch]."""
        return ROW * (2.9 + len(self.rows) + (1 if self.groups else 0))


def text_width(text: str, size: float = NORMAL) -> float:
    """Printed width [inch]."""
    font = get_font(findfont(FontProperties()))
    font.set_size(size, 72)
    font.set_text(text)
    return float(font.get_width_height()[0]) / 64.0 / 72.0


def column_edges(block: Block, total: float = 0.0) -> list[float]:
    """Right edge of every column [inch]; columns grow with a wide group heading, and to the total width."""
    cells = [block.header, *block.rows]
    widths = [max(text_width(row[c]) for row in cells) for c in range(len(block.header))]
    for group in block.groups:
        span = range(group.first, group.last + 1)
        short = text_width(group.text) - sum(widths[c] for c in span) - GAP * (len(span) - 1)
        for c in span:
            widths[c] += max(short, 0.0) / len(span)
    edges = np.cumsum(np.array(widths) + GAP) - GAP
    spare = max(total - float(edges[-1]), 0.0) / (len(edges) - 1)
    return [float(edge) for edge in edges + spare * np.arange(len(edges))]


def rule(axes: Axes, first: float, last: float, y: float, width: float) -> None:
    """Horizontal line."""
    axes.plot([first, last], [y, y], color=INK, linewidth=width, solid_capstyle="butt")


def draw_block(axes: Axes, block: Block, top: float, total: float) -> None:
    """Block with its title's baseline one row below `top`; first column left aligned, the others right aligned."""
    edges = [MARGIN + e for e in column_edges(block, total)]
    y = top + 0.7 * ROW
    axes.text(MARGIN, y, block.title, fontsize=NORMAL + 0.5, color=INK, va="center", weight="bold")
    y += 0.75 * ROW
    rule(axes, MARGIN, edges[-1], y - 0.1 * ROW, 1.2)
    if block.groups:
        y += 0.45 * ROW
        for group in block.groups:
            left = edges[group.first - 1] + GAP if group.first else MARGIN
            middle = (left + edges[group.last]) / 2
            axes.text(
                middle, y, group.text, fontsize=NORMAL, color=group.colour, ha="center", va="center"
            )
            rule(axes, left, edges[group.last], y + 0.45 * ROW, 0.5)
        y += 0.55 * ROW
    for k, row in enumerate((block.header, *block.rows)):
        y += (0.5 if k == 0 else 1.0) * ROW + (0.15 * ROW if k == 1 else 0.0)
        for c, text in enumerate(row):
            colour = block.colours[k - 1] if c == 0 and k > 0 and block.colours else INK
            x, side = (MARGIN, "left") if c == 0 else (edges[c], "right")
            axes.text(x, y, text, fontsize=NORMAL, color=colour, ha=side, va="center")
        if k == 0:
            rule(axes, MARGIN, edges[-1], y + 0.52 * ROW, 0.7)
    rule(axes, MARGIN, edges[-1], y + 0.6 * ROW, 1.2)


def draw_tables(title: str, blocks: Sequence[Block], notes: Sequence[str]) -> Figure:
    """Figure just large enough for the blocks, one under the other."""
    texts = [text_width(title, LARGE), *(text_width(note, SMALL - 0.5) for note in notes)]
    total = max(*(column_edges(block)[-1] for block in blocks), *texts)
    wide = total + 2 * MARGIN
    tall = 0.55 + sum(b.height for b in blocks) + 0.17 * len(notes) + 0.05
    figure = new_figure(wide, tall)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, wide), ylim=(tall, 0.0))
    axes.set_axis_off()
    axes.text(MARGIN, 0.3, title, fontsize=LARGE, color=INK, va="center")
    top = 0.5
    for block in blocks:
        draw_block(axes, block, top, total)
        top += block.height
    for k, note in enumerate(notes):
        axes.text(
            MARGIN, top + 0.1 + 0.17 * k, note, fontsize=SMALL - 0.5, color=MUTED, va="center"
        )
    return figure


def eigenvalue_block(design: Design) -> Block:
    """Eigenvalues (largest first) and cost of both trajectories; the middle ones are left out when there are many."""
    count = len(design.final.eigenvalues)
    shown = list(range(count)) if count <= MAX_EIGENVALUES else [0, 1, 2, count - 2, count - 1]
    header = [f"λ{str(k + 1).translate(str.maketrans('0123456789', '₀₁₂₃₄₅₆₇₈₉'))}" for k in shown]
    rows = []
    for name, evaluation in (("initial", design.initial), ("optimized", design.final)):
        descending = evaluation.eigenvalues[::-1]
        values = [number(float(descending[k]), 5) for k in shown]
        if count > MAX_EIGENVALUES:
            values.insert(3, "…")
        rows.append((name, *values, number(evaluation.criterion, 5), number(evaluation.cost, 5)))
    if count > MAX_EIGENVALUES:
        header.insert(3, "…")
    return Block(
        "Eigenvalues of the information, and cost",
        ("trajectory", *header, "criterion", "J"),
        tuple(rows),
        colours=(INITIAL, OPTIMIZED),
    )


def bound_block(design: Design, labels: Labels) -> Block:
    """Cramer-Rao standard deviation of every parameter along both trajectories."""
    rows = []
    with np.errstate(divide="ignore", invalid="ignore"):
        for j in design.wanted:
            theta = design.theta[j]
            before, after = design.initial.std[j], design.final.std[j]
            ratio = before / after
            rows.append(
                (
                    brief(labels.parameter(j)),
                    number(float(theta), 4),
                    number(float(before)),
                    percent(float(abs(before / theta))),
                    number(float(after)),
                    percent(float(abs(after / theta))),
                    f"{number(float(ratio))}×" if np.isfinite(ratio) else number(float(ratio)),
                )
            )
        for c in design.combined:
            relative = [
                percent(abs(std / c.value)) if c.value else "–"
                for std in (c.std_initial, c.std_final)
            ]
            stds = (number(c.std_initial), relative[0], number(c.std_final), relative[1])
            rows.append(
                (
                    shorten(c.expression),
                    number(c.value, 4),
                    *stds,
                    f"{number(c.std_initial / c.std_final)}×",
                )
            )
    return Block(
        "Cramér–Rao standard deviation",
        ("parameter [unit]", "value", "std", "of value", "std", "of value", "ratio"),
        tuple(rows),
        groups=(Group("initial", 2, 3, INITIAL), Group("optimized", 4, 5, OPTIMIZED)),
    )


def design_table(design: Design, labels: Labels) -> Figure:
    """Eigenvalues and cost (paper's table I), then the predicted standard deviation of every parameter."""
    labels.check(parameters=len(design.theta))
    notes = (
        "λ in s / (unit of θ)²: information per unit of measurement rate; std in the parameter's unit.",
        BEST_CASE,
    )
    return draw_tables(
        "Designed experiment", [eigenvalue_block(design), bound_block(design, labels)], notes
    )


def matrix_block(
    study: MonteCarloStudy, labels: Labels, title: str, matrix: Callable[[str], Array]
) -> Block:
    """Upper triangle of a symmetric matrix per trajectory, side by side."""
    count = len(study.theta)
    short = [shorten(name, 16) for name in labels.parameters]
    groups, rows = [], [[brief(labels.parameter(j))] for j in range(count)]
    for k, name in enumerate(study.sets):
        text, colour = STYLES.get(name, (name, OTHER))
        groups.append(Group(text, 1 + k * count, (k + 1) * count, colour))
        values = matrix(name)
        for j in range(count):
            rows[j] += ["·" if i < j else number(float(values[j, i])) for i in range(count)]
    header = ("", *(short * len(study.sets)))
    return Block(title, header, tuple(tuple(row) for row in rows), tuple(groups))


def variance_block(study: MonteCarloStudy, labels: Labels) -> Block:
    """Variances only, one row per parameter: for studies with too many parameters to print matrices."""
    groups, rows = [], [[brief(labels.parameter(j))] for j in range(len(study.theta))]
    for k, (name, trials) in enumerate(study.sets.items()):
        text, colour = STYLES.get(name, (name, OTHER))
        groups.append(Group(text, 1 + 3 * k, 3 + 3 * k, colour))
        diagonals = [
            np.diagonal(m) for m in (trials.covariance, study.information[name], trials.crlb)
        ]
        for j, row in enumerate(rows):
            row += [number(float(d[j])) for d in diagonals]
    header = ("parameter [unit]", *(("observed", "information", "bound") * len(study.sets)))
    return Block("Variances (diagonals)", header, tuple(tuple(row) for row in rows), tuple(groups))


def efficiency_block(study: MonteCarloStudy, labels: Labels) -> Block:
    """Cramer-Rao variance over observed variance, with its 95 % interval."""
    groups, rows = [], [[brief(labels.parameter(j))] for j in range(len(study.theta))]
    for k, (name, trials) in enumerate(study.sets.items()):
        text, colour = STYLES.get(name, (name, OTHER))
        groups.append(Group(text, 1 + 2 * k, 2 + 2 * k, colour))
        for j, row in enumerate(rows):
            low, high = trials.efficiency_interval[j]
            row += [
                number(float(trials.efficiency[j])),
                f"[{number(float(low))}, {number(float(high))}]",
            ]
    header = ("parameter [unit]", *(("efficiency", "95 % interval") * len(study.sets)))
    return Block(
        "Efficiency: bound / observed variance",
        header,
        tuple(tuple(r) for r in rows),
        tuple(groups),
    )


def study_table(study: MonteCarloStudy, labels: Labels) -> Figure:
    """Monte-Carlo covariance, Fisher information, Cramer-Rao bound and efficiency (paper's tables II and III)."""
    labels.check(parameters=len(study.theta))
    notes = [
        "Symmetric matrices, upper triangle; entry i, j in unit of θᵢ × unit of θⱼ (information: its inverse)."
    ]
    if len(study.theta) <= MAX_MATRIX:
        blocks = [
            matrix_block(
                study, labels, "Monte-Carlo covariance", lambda name: study.sets[name].covariance
            ),
            matrix_block(study, labels, "Fisher information", lambda name: study.information[name]),
            matrix_block(study, labels, "Cramér–Rao bound", lambda name: study.sets[name].crlb),
        ]
    else:
        blocks = [variance_block(study, labels)]
        notes = ["Observed variance and bound in (unit of θ)², information in its inverse."]
    trials = [
        f"{STYLES.get(name, (name, OTHER))[0]} {s.trials - s.failed} of {s.trials}"
        for name, s in study.sets.items()
    ]
    notes.append(f"Usable trials: {', '.join(trials)}; measured at {study.measure_rate:g} Hz.")
    title = "Monte-Carlo study against the Cramér–Rao bound"
    return draw_tables(title, [*blocks, efficiency_block(study, labels)], notes)
