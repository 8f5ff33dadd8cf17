"""The section of a report on the length of the segments."""

from __future__ import annotations

import numpy as np

from mjfim.output.report.curves import axis, curve
from mjfim.output.report.page import Key, Panel, PlotGroup, Section
from mjfim.output.summaries.horizons import describe_horizons
from mjfim.output.vocabulary import IDENTIFIED, OTHER
from mjfim.records.estimate import HorizonStudy

# Names in the legend.
CHOSEN = "chosen length"
OTHERS = "other lengths"


def horizons_section(study: HorizonStudy) -> Section:
    """Return the comparison of lengths, in words, in a table and as a plot.

    Args:
        study: The comparison.
    """
    traces = []
    for i, errors in enumerate(study.errors):
        is_chosen = i == study.chosen
        role = IDENTIFIED.word if is_chosen else OTHER.word
        line = curve(np.log10(study.lengths), errors, CHOSEN if is_chosen else OTHERS, role)
        line["mode"] = "lines+markers"
        line["marker"] = {"size": 8 if is_chosen else 5, "color": f"role:{role}"}
        line["text"] = [f"fit over {study.name_of(i)}"] * len(errors)
        traces.append(line)

    ticks = {
        "tickvals": np.log10(study.lengths).tolist(),
        "ticktext": [f"{length:.2g}" for length in study.lengths],
    }
    panel = Panel(
        title="error of left-out data [σ of the noise]",
        traces=traces,
        layout={
            "xaxis": {**axis("time over which is predicted [s]"), **ticks},
            "hovermode": "closest",
        },
    )
    keys = [Key(name=CHOSEN, role=IDENTIFIED.word), Key(name=OTHERS, role=OTHER.word)]
    note = (
        "Each part of the data is predicted by fits to the other parts; with the right model and "
        "noise, the error is about 1 σ over any time."
    )
    group = PlotGroup(title="", panels=[panel], keys=keys, note=note)
    return Section(title="Length of the segments", parts=[*describe_horizons(study), group])
