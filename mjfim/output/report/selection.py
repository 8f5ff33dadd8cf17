"""The section of a report on the selection of terms."""

from __future__ import annotations

import numpy as np

from mjfim.output.report.curves import axis, curve, dots
from mjfim.output.report.page import Key, Panel, PlotGroup, Section
from mjfim.output.summaries.selection import describe_selection
from mjfim.output.vocabulary import IDENTIFIED, OTHER
from mjfim.records.terms import Selection

# Names in the legend.
KEPT = "model of this step"
TRIED = "term that was tried"


def selection_section(selection: Selection) -> Section:
    """Return the steps of a selection, in words, in a table and as a plot.

    Args:
        selection: The selection.
    """
    # Models that diverge have no finite error, and none was tried where no data could be predicted.
    finite = [step for step in selection.steps if np.isfinite(step.error)]
    kept = [step for step in finite if step.is_kept]
    if not kept:
        return Section(title="Added terms", parts=describe_selection(selection))

    line = curve(
        np.array([float(step.count) for step in kept]),
        np.array([step.error for step in kept]),
        KEPT,
        IDENTIFIED.word,
    )
    line["mode"] = "lines+markers"
    line["marker"] = {"size": 8, "color": f"role:{IDENTIFIED.word}"}
    line["text"] = [step.description or "the stated model" for step in kept]

    tried = [step for step in finite if not step.is_kept]
    crosses = dots(
        np.array([step.count + 1.0 for step in tried]),
        np.array([step.error for step in tried]),
        TRIED,
        OTHER.word,
        size=8,
        symbol="x",
        texts=[step.description for step in tried],
    )
    panel = Panel(
        title="error of left-out data [σ of the noise]",
        traces=[line, crosses] if tried else [line],
        layout={"xaxis": {**axis("number of added terms"), "dtick": 1}, "hovermode": "closest"},
    )
    keys = [Key(name=KEPT, role=IDENTIFIED.word), Key(name=TRIED, role=OTHER.word)]
    note = (
        "Each part of the data is predicted by a fit to the other parts; with the right model and "
        "noise, the error is about 1 σ."
    )
    group = PlotGroup(title="", panels=[panel], keys=keys, note=note)
    return Section(title="Added terms", parts=[*describe_selection(selection), group])
