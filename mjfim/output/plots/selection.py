"""Figure of the selection of terms: held-out error against the number of terms."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mjfim.output.plots import style
from mjfim.records.estimate import Estimate
from mjfim.records.selection import Decision, SelectionStep

# Characters to which the names of terms are shortened.
TERM_WIDTH = 40

# Distance of the name of a term from its mark [points].
NAME_DISTANCE = 8

# Errors of rejected terms above this multiple of the largest kept one are drawn at the upper end.
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
    rejected = [step for step in selection.steps if not step.is_kept]

    figure = style.new_figure(3.6)
    axes = figure.subplots()
    style.format_axes(axes, "number of added terms", "error of left-out data [σ of the noise]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))

    errors = np.array([step.error for step in kept])
    counts = np.array([step.count for step in kept])
    axes.plot(counts, errors, "-o", color=style.IDENTIFIED_COLOUR, markersize=6.0)
    top = LARGEST_DRAWN_RATIO * float(errors.max())
    for step in rejected:
        error = min(step.error, top)
        axes.plot(step.count + 1, error, "x", color=style.MUTED_COLOUR, markersize=6.0)

    for step in kept:
        axes.annotate(
            _label(step),
            (step.count, step.error),
            (NAME_DISTANCE, NAME_DISTANCE),
            textcoords="offset points",
            fontsize=style.SMALL_FONT,
            color=style.TEXT_COLOUR,
        )

    # Names stand to the right of their marks.
    most = max(step.count + (not step.is_kept) for step in selection.steps)
    axes.set_xlim(-0.2, most + 0.9)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.12 * (high - low))

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
    style.add_title(figure, _title(estimate), handles, note)
    return figure


def _title(estimate: Estimate) -> str:
    """Return the outcome in a sentence."""
    selection = estimate.selection
    assert selection is not None
    before, after = selection.errors
    if not selection.terms:
        return f"No term was added: held-out error {before:.3g} σ"
    count = len(selection.terms)
    noun = "term" if count == 1 else "terms"
    return f"{count} {noun} added: held-out error {before:.3g} σ → {after:.3g} σ"


def _label(step: SelectionStep) -> str:
    """Return the name of a step."""
    if step.decision is Decision.BEGUN:
        return "the stated model"
    sign = "without" if step.decision is Decision.REMOVED else "+"
    return f"{sign} {style.shorten(step.description, TERM_WIDTH)}"
