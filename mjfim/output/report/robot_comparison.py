"""The report of a comparison of two robots."""

from __future__ import annotations

import numpy as np

from mjfim.output.report.curves import (
    axis,
    band,
    dots,
    error_bars,
    level,
    row_axis,
    rows_height,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Section
from mjfim.output.summaries.robot_comparison import describe_robots
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Part
from mjfim.output.vocabulary import DESIGNED, IDENTIFIED
from mjfim.records.robots import RobotComparison, p_text

# Names in the legend.
CHANGED, EQUAL = "differs", "no difference found"


def robots_page(comparison: RobotComparison) -> Page:
    """Return the report of a comparison of two robots.

    Args:
        comparison: The comparison.
    """
    summary = describe_robots(comparison)
    parts: list[Part | PlotGroup] = list(summary.parts)
    if comparison.parameters:
        parts.append(_differences(comparison))

    first, second = comparison.names
    facts = {
        f"recordings of {first}": str(comparison.recordings[0]),
        f"recordings of {second}": str(comparison.recordings[1]),
        "compared parameters": str(len(comparison.parameters)),
        "all parameters together": p_text(comparison.joint_p),
    }
    return Page(
        kind="Comparison of two robots",
        verdict=verdict_of(comparison),
        next_steps=next_steps(comparison),
        warnings=summary.warnings,
        facts=facts,
        sections=[Section(title="Differences", parts=parts)],
    )


def _differences(comparison: RobotComparison) -> PlotGroup:
    """Return the plot of all differences with their intervals."""
    order = comparison.order.tolist()
    size = np.where(comparison.detectable > 0.0, comparison.detectable, np.nan)
    groups = {
        (CHANGED, DESIGNED.word): [j for j in order if j in comparison.changed],
        (EQUAL, IDENTIFIED.word): [j for j in order if j not in comparison.changed],
    }
    traces = []
    for (name, role), members in groups.items():
        if not members:
            continue
        rows = np.array([order.index(j) for j in members], dtype=float)
        centre = (comparison.difference / size)[members]
        low, high = (comparison.interval[members] / size[members, None]).T
        texts = [comparison.sentence(j) for j in members]
        trace = dots(centre, rows, name, role, size=9, texts=texts)
        trace["error_x"] = error_bars(role, high - centre, centre - low, width=6)
        traces.append(trace)

    panel = Panel(
        title="difference / difference that would be found, with 95 % interval [–]",
        traces=traces,
        layout={
            "xaxis": axis("difference / difference that would be found [–]"),
            "yaxis": row_axis([comparison.parameters[j] for j in order]),
            "shapes": [band(-1.0, 1.0, across="y"), level(0.0, "text", across="y")],
            "hovermode": "closest",
        },
        height=rows_height(len(order), 44),
        wide=True,
    )
    keys = [Key(name=name, role=role) for (name, role), members in groups.items() if members]
    note = (
        "A difference outside the strip would have been found with a probability of 80 % or more."
    )
    return PlotGroup(title="", panels=[panel], keys=keys, note=note)
