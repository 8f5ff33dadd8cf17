"""The section of a report on the robots that are drawn from an estimate."""

from __future__ import annotations

import numpy as np

from mjfim.output.report.curves import axis, level, packed
from mjfim.output.report.page import Key, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.samples import describe_samples
from mjfim.output.vocabulary import IDENTIFIED, MEASURED
from mjfim.records.estimate import Estimate, ParameterDraws
from mjfim.records.labels import with_unit

# Largest number of parameters with a histogram.
MAX_PANELS = 24

# Fewest and most bars of a histogram.
MIN_BINS, MAX_BINS = 5, 30

# Name in the legend.
DRAWN = "drawn robots"


def samples_section(estimate: Estimate) -> Section:
    """Return the drawn robots in words, in a table and as histograms.

    Args:
        estimate: An estimate with draws.
    """
    draws = estimate.draws
    assert draws is not None
    shown = range(min(len(draws.parameters), MAX_PANELS))
    keys = [Key(name=DRAWN, role=MEASURED.word, shape="bar")]
    note = "Number of robots in each interval; the line is the centre of the distribution."
    if len(shown) < len(draws.parameters):
        note += f" Shown: the first {len(shown)} of {len(draws.parameters)} parameters."
    group = PlotGroup(title="", panels=[_panel(draws, j) for j in shown], keys=keys, note=note)
    return Section(title="Drawn robots", parts=[*describe_samples(estimate), group])


def _panel(draws: ParameterDraws, j: int) -> Panel:
    """Return the histogram of one parameter."""
    bins = int(np.clip(np.sqrt(len(draws)), MIN_BINS, MAX_BINS))
    counts, edges = np.histogram(draws.values[:, j], bins=bins)
    label = with_unit(draws.parameters[j], draws.units[j])
    bars: Plotly = {
        "type": "bar",
        "x": packed(0.5 * (edges[1:] + edges[:-1])),
        "y": packed(counts),
        "width": float(edges[1] - edges[0]),
        "name": DRAWN,
        "legendgroup": DRAWN,
        "marker": {"color": f"role:{MEASURED.word}", "line": {"width": 0}},
        "opacity": 0.6,
    }
    centre = float(draws.centre[j])
    return Panel(
        title=label,
        traces=[bars],
        layout={
            "xaxis": axis(label),
            "yaxis": axis("number of robots"),
            "bargap": 0,
            "shapes": [level(centre, IDENTIFIED.word, across="y", dash="solid")],
            "hovermode": "closest",
        },
        narrow=True,
    )
