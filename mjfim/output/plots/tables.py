"""Tables as images, ruled as in print: eigenvalues, Cramér-Rao bounds, Monte Carlo covariances."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font

from mjfim.output.plots.style import (
    LARGE_FONT,
    MUTED_COLOUR,
    NORMAL_FONT,
    NOTE_FONT,
    TEXT_COLOUR,
    format_number,
    new_figure,
    own_style,
    shorten,
    shorten_label,
    trajectory_style,
)
from mjfim.output.summaries.accuracy import BEST_CASE
from mjfim.output.summaries.design import describe_design
from mjfim.output.summaries.monte_carlo import MAX_MATRIX, describe_study
from mjfim.output.summary_parts import Cell, Name, Quantity, SummaryTable
from mjfim.records.design import Design
from mjfim.records.labels import Labels
from mjfim.records.monte_carlo import MonteCarloStudy

# Height of a row of text [inch].
ROW_HEIGHT = 0.26

# Space between two columns [inch].
COLUMN_GAP = 0.28

# Space around the tables [inch].
MARGIN = 0.3

# Space that the figure's title takes [inch].
TITLE_HEIGHT = 0.5

# Height of a line of the notes below the tables [inch].
NOTE_HEIGHT = 0.17

# Characters to which headings of columns are shortened.
HEADING_WIDTH = 16


@own_style
def design_table(design: Design, labels: Labels) -> Figure:
    """Draw eigenvalues and cost (the paper's table I), and predicted standard deviations.

    Args:
        design: The design.
        labels: Labels with the units of the parameters.
    """
    labels.check(parameters=len(design.theta))
    summary = describe_design(design, labels.parameter_units)
    notes = (
        "λ [s / (unit of θ)²]: eigenvalues of the information per unit of measurement rate; "
        "σ in the unit of the parameter.",
        BEST_CASE,
    )
    tables = [summary.table("eigenvalues"), summary.table("accuracy")]
    return draw_tables(summary.title, tables, notes)


@own_style
def study_table(study: MonteCarloStudy, labels: Labels) -> Figure:
    """Draw covariances, information, bounds and efficiency (the paper's tables II and III).

    Args:
        study: The study.
        labels: Labels with the units of the parameters.
    """
    labels.check(parameters=len(study.theta))
    summary = describe_study(study, labels.parameter_units)

    if len(study.theta) <= MAX_MATRIX:
        units = (
            "Symmetric matrices, upper triangle; entry i, j in unit of θᵢ × unit of θⱼ "
            "(information: its inverse). Variance and bound of one parameter in (unit of θ)²."
        )
    else:
        units = "Observed variance and bound in (unit of θ)², information in its inverse."
    usable = ", ".join(
        f"{_trajectory_name(name)} {trials.trials - trials.failed} of {trials.trials}"
        for name, trials in study.sets.items()
    )
    notes = (units, f"Usable trials: {usable}; measured at {study.measure_rate:g} Hz.")

    matrices = [table for table in summary.tables if table.detail]
    efficiencies = [table for table in summary.tables if not table.detail]
    return draw_tables(summary.title, [*matrices, *efficiencies], notes)


def draw_tables(title: str, tables: Sequence[SummaryTable], notes: Sequence[str]) -> Figure:
    """Draw tables one under the other, in a figure just large enough for them.

    Args:
        title: Title of the figure.
        tables: The tables.
        notes: Lines below the tables.
    """
    widths = [text_width(title, LARGE_FONT)]
    widths += [text_width(note, NOTE_FONT) for note in notes]
    widths += [column_edges(table)[-1] for table in tables]
    table_width = max(widths)

    width = table_width + 2 * MARGIN
    height = TITLE_HEIGHT + 0.1 + NOTE_HEIGHT * len(notes)
    height += sum(table_height(table) for table in tables)

    figure = new_figure(width, height)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(height, 0.0))
    axes.set_axis_off()
    axes.text(MARGIN, 0.3, title, fontsize=LARGE_FONT, color=TEXT_COLOUR, va="center")

    top = TITLE_HEIGHT
    for table in tables:
        draw_table(axes, table, top, table_width)
        top += table_height(table)
    for k, note in enumerate(notes):
        y = top + 0.1 + NOTE_HEIGHT * k
        axes.text(MARGIN, y, note, fontsize=NOTE_FONT, color=MUTED_COLOUR, va="center")
    return figure


def draw_table(axes: Axes, table: SummaryTable, top: float, width: float) -> None:
    """Draw one table; text is aligned to the left in the first column, to the right in the others.

    Args:
        axes: Axes in inches, downwards.
        table: The table.
        top: Upper edge [inch]; the title's baseline is one row below.
        width: Width to which the columns are spread [inch].
    """
    edges = [MARGIN + edge for edge in column_edges(table, width)]

    y = top + 0.7 * ROW_HEIGHT
    title_size = NORMAL_FONT + 0.5
    axes.text(
        MARGIN, y, table.title, fontsize=title_size, color=TEXT_COLOUR, va="center", weight="bold"
    )
    y += 0.75 * ROW_HEIGHT
    rule(axes, MARGIN, edges[-1], y - 0.1 * ROW_HEIGHT, 1.2)

    if table.groups:
        y += 0.45 * ROW_HEIGHT
        _draw_groups(axes, table, edges, y)
        y += 0.55 * ROW_HEIGHT

    y += 0.5 * ROW_HEIGHT
    _draw_cells(axes, _headings(table), edges, y, TEXT_COLOUR)
    rule(axes, MARGIN, edges[-1], y + 0.52 * ROW_HEIGHT, 0.7)

    y += 0.15 * ROW_HEIGHT
    for row in table.rows:
        y += ROW_HEIGHT
        # A row that belongs to one trajectory has the colour of that trajectory.
        colour = _trajectory_colour(row.trajectory) if row.trajectory else TEXT_COLOUR
        _draw_cells(axes, [_drawn(cell) for cell in row.cells], edges, y, colour)
    rule(axes, MARGIN, edges[-1], y + 0.6 * ROW_HEIGHT, 1.2)


def table_height(table: SummaryTable) -> float:
    """Return the height of a table with its title and the space below it [inch].

    Args:
        table: The table.
    """
    rows = len(table.rows) + (1 if table.groups else 0)
    return ROW_HEIGHT * (2.9 + rows)


def column_edges(table: SummaryTable, width: float = 0.0) -> list[float]:
    """Return the right edge of every column [inch], relative to the left edge of the table.

    Args:
        table: The table.
        width: Width to which the columns are spread where they need less [inch].
    """
    lines = [_headings(table), *([_drawn(cell) for cell in row.cells] for row in table.rows)]
    widths = [max(text_width(line[c]) for line in lines) for c in range(len(table.columns))]

    # Columns under a group's heading are at least as wide as the heading.
    for group in table.groups:
        span = range(group.first, group.last + 1)
        present = sum(widths[c] for c in span) + COLUMN_GAP * (len(span) - 1)
        lacking = text_width(_trajectory_name(group.trajectory)) - present
        for c in span:
            widths[c] += max(lacking, 0.0) / len(span)

    edges = np.cumsum(np.array(widths) + COLUMN_GAP) - COLUMN_GAP
    spare = max(width - float(edges[-1]), 0.0) / (len(edges) - 1)
    return [float(edge) for edge in edges + spare * np.arange(len(edges))]


def text_width(text: str, size: float = NORMAL_FONT) -> float:
    """Return the printed width of a text [inch].

    Args:
        text: The text.
        size: Size of the font [points].
    """
    font = get_font(findfont(FontProperties()))
    font.set_size(size, 72)
    font.set_text(text)
    return float(font.get_width_height()[0]) / 64.0 / 72.0


def rule(axes: Axes, first: float, last: float, y: float, width: float) -> None:
    """Draw a horizontal line.

    Args:
        axes: Axes in inches.
        first: Its left end [inch].
        last: Its right end [inch].
        y: Its height [inch].
        width: Its width [points].
    """
    axes.plot([first, last], [y, y], color=TEXT_COLOUR, linewidth=width, solid_capstyle="butt")


def _draw_groups(axes: Axes, table: SummaryTable, edges: Sequence[float], y: float) -> None:
    """Draw headings above several columns, each with a line below it."""
    for group in table.groups:
        left = edges[group.first - 1] + COLUMN_GAP if group.first else MARGIN
        right = edges[group.last]
        axes.text(
            (left + right) / 2,
            y,
            _trajectory_name(group.trajectory),
            fontsize=NORMAL_FONT,
            color=_trajectory_colour(group.trajectory),
            ha="center",
            va="center",
        )
        rule(axes, left, right, y + 0.45 * ROW_HEIGHT, 0.5)


def _draw_cells(
    axes: Axes, texts: Sequence[str], edges: Sequence[float], y: float, first_colour: str
) -> None:
    """Draw one line of a table."""
    for c, (text, edge) in enumerate(zip(texts, edges, strict=True)):
        x, side = (MARGIN, "left") if c == 0 else (edge, "right")
        colour = first_colour if c == 0 else TEXT_COLOUR
        axes.text(x, y, text, fontsize=NORMAL_FONT, color=colour, ha=side, va="center")


def _headings(table: SummaryTable) -> list[str]:
    """Return the headings of a table's columns; names of parameters are shortened."""
    headings = []
    for column in table.columns:
        text = str(column.heading)
        headings.append(shorten(text, HEADING_WIDTH) if table.groups else text)
    return headings


def _drawn(cell: Cell) -> str:
    """Return a cell as figures write it: powers of ten raised, units in brackets."""
    if isinstance(cell, Quantity):
        suffix = cell.suffix if np.isfinite(cell.value) else ""
        return format_number(cell.value, cell.digits) + suffix
    if isinstance(cell, Name):
        return shorten_label(f"{cell.name} [{cell.unit or 'model unit'}]")
    return shorten(cell)


def _trajectory_name(trajectory: str) -> str:
    """Return the name of a trajectory in figures."""
    return trajectory_style(trajectory)[0]


def _trajectory_colour(trajectory: str) -> str:
    """Return the colour of a trajectory in figures."""
    return trajectory_style(trajectory)[1]
