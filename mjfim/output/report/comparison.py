"""The report of a comparison of methods."""

from __future__ import annotations

from html import escape

import numpy as np

from mjfim.output.report.curves import (
    MAX_WRITTEN_CELLS,
    axis,
    log_axis,
    row_axis,
    rows_height,
    rows_of_bars,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.comparison import budget_in_words, describe_comparison
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Quantity
from mjfim.output.vocabulary import DESIGNED, INITIAL, OTHER
from mjfim.records.comparison import DESIGN, Comparison, MethodResult

# Roles of the colours of methods by their name in the legend.
KINDS = {
    "design": DESIGNED.word,
    "baseline": INITIAL.word,
    "baseline that beats the design": OTHER.word,
    "not usable": "band",
}

# Ratio of standard deviations to the design's at which the colours of the cells end.
LARGEST_COLOURED_RATIO = 3.0


def comparison_page(comparison: Comparison) -> Page:
    """Return the report of a comparison.

    Args:
        comparison: The comparison.
    """
    summary = describe_comparison(comparison)

    # The verdict stands at the top already.
    table = summary.table("methods")
    others = [
        part
        for part in summary.parts
        if part is not table and getattr(part, "text", "") not in comparison.verdict
    ]
    sections = [Section(title="Methods", parts=[table, _method_plots(comparison), *others])]
    facts = {
        "criterion": comparison.criterion,
        "methods": str(len(comparison.rows)),
        "budget of each": budget_in_words(comparison),
        "seed": str(comparison.seed),
    }
    return Page(
        kind="Comparison with other excitations",
        verdict=verdict_of(comparison),
        next_steps=next_steps(comparison),
        warnings=comparison.verdict[1:],
        facts=facts,
        sections=sections,
    )


def _kind(comparison: Comparison, row: MethodResult) -> str:
    """Return the kind of a method, by its name in the legend."""
    if not row.sound:
        return "not usable"
    if row.method == DESIGN:
        return "design"
    return "baseline that beats the design" if row in comparison.beating else "baseline"


def _method_plots(comparison: Comparison) -> PlotGroup:
    """Return the worst standard deviation of every method, and all of them by parameter."""
    known = [row for row in comparison.rows if np.isfinite(row.worst_relative_std)]
    best_first = sorted(known, key=lambda row: row.cost)
    names = [row.title for row in best_first]
    worst = np.array([row.worst_relative_std for row in best_first])

    traces, keys = [], []
    for kind, role in KINDS.items():
        is_of_kind = np.array([_kind(comparison, row) == kind for row in best_first])
        if not is_of_kind.any():
            continue
        texts = [str(Quantity(value=value)) for value in worst]
        bars = rows_of_bars(np.where(is_of_kind, worst, np.nan), kind, role, texts=texts)
        traces.append(bars)
        keys.append(Key(name=kind, role=role, shape="bar"))

    horizontal = axis("worst relative σ [–]", rangemode="tozero")
    if worst.size and worst.max() > 8.0 * worst.min():
        horizontal = log_axis("worst relative σ [–]", worst, room=(0.5, 0.3))
    panels = [
        Panel(
            title="σ of the worst combination of parameters, relative to their scales [–]",
            traces=traces,
            layout={
                "xaxis": horizontal,
                "yaxis": row_axis(names, 26),
                "barmode": "overlay",
                "margin": {"r": 50},
            },
            height=rows_height(len(names), 32),
        )
    ]
    design = comparison.design
    if design is not None and np.isfinite(design.std[list(comparison.wanted)]).any():
        panels.append(_ratio_panel(comparison, design, best_first))
    note = "The method with the lowest cost J stands at the top."
    if comparison.weighted:
        note += " J has further terms, such as the effort, so another method may have a smaller σ."
    return PlotGroup(title="", panels=panels, keys=keys, note=note)


def _ratio_panel(comparison: Comparison, design: MethodResult, rows: list[MethodResult]) -> Panel:
    """Return a heat map of the standard deviations over those of the design."""
    wanted = list(comparison.wanted)
    names = [comparison.parameters[j] for j in wanted]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.array([row.std[wanted] / design.std[wanted] for row in rows])
        logarithms = np.log2(ratios)
    cells = [[float(v) if np.isfinite(v) else None for v in row] for row in logarithms]
    texts = [[str(Quantity(value=float(v), digits=2)) for v in row] for row in ratios]
    hover = [
        [
            f"{escape(row.title)}, {escape(name)}: {text} × σ of the design"
            for name, text in zip(names, line, strict=True)
        ]
        for row, line in zip(rows, texts, strict=True)
    ]
    reach = float(np.log2(LARGEST_COLOURED_RATIO))
    marks = [-reach, -1.0, 0.0, 1.0, reach]
    trace: Plotly = {
        "type": "heatmap",
        "z": cells,
        "text": texts,
        "hovertext": hover,
        "hoverinfo": "text",
        "colorscale": "role:diverging",
        "zmin": -reach,
        "zmax": reach,
        "xgap": 1,
        "ygap": 1,
        "colorbar": {
            "thickness": 10,
            "outlinewidth": 0,
            "tickvals": marks,
            "tickfont": {"size": 11},
            "ticktext": ["1/3", "1/2", "1", "2", "3"],
        },
    }
    if len(names) <= MAX_WRITTEN_CELLS:
        trace["texttemplate"] = "%{text}"
    columns = row_axis(names, 14)
    columns.update(range=[-0.5, len(names) - 0.5], tickangle=-45 if len(names) > 3 else 0)
    vertical = row_axis([row.title for row in rows], 18)
    vertical["range"] = [len(rows) - 0.5, -0.5]
    return Panel(
        title="σ of each parameter / σ of the design [–]",
        traces=[trace],
        layout={"xaxis": columns, "yaxis": vertical, "hovermode": "closest"},
        height=rows_height(len(rows), 32),
        narrow=True,
    )
