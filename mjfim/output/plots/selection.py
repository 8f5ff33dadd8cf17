"""Figure of the selection of terms: held-out error against the number of terms."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mjfim.output.plots import style
from mjfim.records.estimate import Estimate
from mjfim.records.selection import Decision, SelectionStep

# Characters to which the names of terms are shortened.
TERM_WIDTH = 40

# Height of a row, and of all else [inch].
ROW_HEIGHT, FIXED_HEIGHT = 0.3, 1.4

# Errors of rejected terms above this multiple of the largest kept one are drawn at the right end.
LARGEST_DRAWN_RATIO = 1.5


@style.own_style
def selection_figure(estimate: Estimate) -> Figure:
    """Draw the prediction error of left-out data against the number of added terms.

    Args:
        estimate: An estimate with a selection.
    """
    selection = estimate.selection
    assert selection is not None
    kept = [step for step in selection.steps if step.is_kept]

    figure = style.new_figure(FIXED_HEIGHT + ROW_HEIGHT * (len(kept) + 1))
    axes = figure.subplots()
    style.format_axes(axes, "error of left-out data [σ of the noise]")

    # A row for each kept step, the stated model on top; the crosses of a row are the terms that
    # were tried in its place.
    first = 0
    for phase in selection.phases:
        rows = first + np.arange(len(phase))
        errors = [step.error for step in phase]
        axes.plot(errors, rows, "-o", color=style.IDENTIFIED_COLOUR, markersize=6.0)
        first += len(phase)
    right = LARGEST_DRAWN_RATIO * max(step.error for step in kept)
    if np.isnan(right):
        axes.set_xticks([])
    row = 0
    for step in selection.steps:
        if step.is_kept:
            row += 1
        else:
            axes.plot(min(step.error, right), row, "x", color=style.MUTED_COLOUR, markersize=6.0)

    # Terms that were tried at the end, and not added, have a row of their own.
    has_end = not selection.steps[-1].is_kept
    names = [_label(step) for step in kept] + (["no further term"] if has_end else [])
    axes.set_yticks(np.arange(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)

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


def _title(estimate: Estimate) -> str:
    """Return the outcome in a sentence."""
    selection = estimate.selection
    assert selection is not None
    before, after = selection.errors
    if np.isnan(before):
        return "No term was tried"
    if not selection.terms:
        return f"No term was added: held-out error {before:.3g} σ"
    count = len(selection.terms)
    noun = "term" if count == 1 else "terms"
    return f"{count} {noun} added: held-out error {before:.3g} σ → {after:.3g} σ"


def _label(step: SelectionStep) -> str:
    """Return the name of a step."""
    if step.decision is Decision.BEGUN:
        return "the stated model"
    signs = {Decision.REMOVED: "without ", Decision.ADDED: "+ "}
    return f"{signs.get(step.decision, '')}{style.shorten(step.description, TERM_WIDTH)}"
