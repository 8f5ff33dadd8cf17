"""Figure of the selection of terms: error of left-out data with each term that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjfim.output.plots import style
from mjfim.records.estimate import Estimate
from mjfim.records.terms import Decision, SelectionStep

# Characters to which the names of terms are shortened.
TERM_WIDTH = 40

# Height of a row, and of all else [inch].
ROW_HEIGHT, FIXED_HEIGHT = 0.3, 1.4

# Errors of rejected terms above this multiple of the largest kept one are arrows at the right end.
LARGEST_DRAWN_RATIO = 1.5

# Largest number of rejected terms that have a row and a name each. More of them share the row of
# the term that was added in their place.
MAX_NAMED = 20


@style.own_style
def selection_figure(estimate: Estimate) -> Figure:
    """Draw the prediction error of left-out data against the number of added terms.

    Args:
        estimate: An estimate with a selection.
    """
    selection = estimate.selection
    assert selection is not None

    # A term with which the fit is no better has no error to draw.
    steps = [step for step in selection.steps if step.decision is not Decision.UNHELPFUL]
    rows = _rows(steps)

    figure = style.new_figure(FIXED_HEIGHT + ROW_HEIGHT * (len(rows.names) + 1))
    axes = figure.subplots()
    style.format_axes(axes, "error of left-out data [σ of the noise]")

    # The line joins the models with which the selection continued.
    placed = list(zip(steps, rows.places, strict=True))
    kept_rows = iter([row for step, row in placed if step.is_kept])
    for phase in selection.phases:
        errors = [step.error for step in phase]
        at = [next(kept_rows) for _ in phase]
        axes.plot(errors, at, "-o", color=style.IDENTIFIED_COLOUR, markersize=6.0)

    right = LARGEST_DRAWN_RATIO * max(step.error for step in steps if step.is_kept)
    if np.isnan(right):
        axes.set_xticks([])
    for step, row in placed:
        if not step.is_kept:
            is_beyond = step.error > right
            marker, error = (">", right) if is_beyond else ("x", step.error)
            axes.plot(error, row, marker, color=style.MUTED_COLOUR, markersize=6.0)

    axes.set_yticks(np.arange(len(rows.names)), rows.names)
    axes.set_ylim(len(rows.names) - 0.5, -0.5)
    for label, is_kept in zip(axes.get_yticklabels(), rows.is_kept, strict=True):
        label.set_color(style.TEXT_COLOUR if is_kept else style.MUTED_COLOUR)

    handles = [
        Line2D([], [], color=style.IDENTIFIED_COLOUR, marker="o", label="model of this step"),
        Line2D(
            [], [], color=style.MUTED_COLOUR, marker="x", linestyle="", label="term that was tried"
        ),
    ]
    note = (
        "Each part of the data is predicted by a fit to the other parts; with the right model and "
        "noise, the error is about 1 σ. A term is added if it lowers the mean loss of left-out "
        f"data by more than one standard error. {selection.ending}"
    )
    if len(selection.phases) > 1:
        note += " Errors over segments are not comparable with those over whole recordings above."
    style.add_title(figure, _title(estimate), handles, note)
    return figure


@dataclass(frozen=True, kw_only=True)
class _Rows:
    """Rows of the figure, the stated model on top.

    Attributes:
        names: Name of each row.
        is_kept: Whether the selection continued with the model of the row, by row.
        places: Row of each step.
    """

    names: list[str]
    is_kept: list[bool]
    places: list[int]


def _rows(steps: Sequence[SelectionStep]) -> _Rows:
    """Place steps in rows: each in its own one, unless there are too many of them."""
    if sum(not step.is_kept for step in steps) <= MAX_NAMED:
        return _Rows(
            names=[_label(step) for step in steps],
            is_kept=[step.is_kept for step in steps],
            places=list(range(len(steps))),
        )

    # Rejected terms share the row of the next kept step; those at the end have a row of their own.
    kept = [step for step in steps if step.is_kept]
    before = np.cumsum([0, *(step.is_kept for step in steps)])[:-1]
    names = [_label(step) for step in kept]
    has_end = not steps[-1].is_kept
    if has_end:
        names.append("no further term")
    return _Rows(
        names=names,
        is_kept=[True] * len(kept) + [False] * has_end,
        places=before.tolist(),
    )


def _title(estimate: Estimate) -> str:
    """Return the outcome in a sentence."""
    selection = estimate.selection
    assert selection is not None
    before, after = selection.errors
    if np.isnan(before):
        return "No term was tried"
    if not selection.terms:
        return f"No term was added: error of left-out data {style.format_number(before)} σ"
    count = len(selection.terms)
    noun = "term" if count == 1 else "terms"
    change = f"{style.format_number(before)} σ → {style.format_number(after)} σ"
    return f"{count} {noun} added: error of left-out data {change}"


def _label(step: SelectionStep) -> str:
    """Return the name of a step."""
    if step.decision is Decision.BEGUN:
        return "the stated model"
    signs = {Decision.REMOVED: "without ", Decision.ADDED: "+ "}
    return f"{signs.get(step.decision, '')}{style.shorten(step.description, TERM_WIDTH)}"
