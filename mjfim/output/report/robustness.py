"""The report of a robustness study."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import NORMAL_95
from mjfim.output.report.curves import (
    axis,
    band,
    dots,
    level,
    row_axis,
    rows_height,
    rows_of_bars,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.robustness import describe_robustness, robustness_sentences
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Listing, Part
from mjfim.output.vocabulary import DESIGNED, INITIAL, MEASURED
from mjfim.records.robustness import (
    CONFIDENCE,
    REQUIRED_COVERAGE,
    Robustness,
)

# Largest error and smallest margin on the axes; what lies beyond is drawn there.
LARGEST_DRAWN_ERROR, LEAST_DRAWN_MARGIN = 5.0, -100.0

# Names of the curves in the legends.
KEEPING, EXCEEDING, PLANNED = "robot, all keep the limit", "robot, some exceed it", "planned"
INSIDE, OUTSIDE = "inside the interval", "outside"


def robustness_page(result: Robustness) -> Page:
    """Return the report of a robustness study.

    Args:
        result: The study.
    """
    summary = describe_robustness(result)
    conclusions = Listing(title="", items=tuple(robustness_sentences(result)))
    sections = [Section(title="Conclusions", parts=[conclusions])]
    if result.limits:
        sections.append(
            Section(title="Limits", parts=[summary.table("limits"), _limit_plot(result)])
        )
    accuracy: list[Part | PlotGroup] = [summary.table("unknowns")]
    if len(result.z):
        accuracy.append(_error_plots(result))
    sections.append(Section(title="Accuracy", parts=accuracy))

    conditions = result.conditions
    facts = {
        "robots": str(result.runs),
        "error of the parameters": f"{100 * conditions.wrong:g} %",
        "delay of the control": f"{1e3 * conditions.latency:g} ms",
        "control": "with feedback" if conditions.feedback else "open loop",
        "noise / stated noise": f"{conditions.loudness:g}",
    }
    return Page(
        kind="A design on robots that differ from the model",
        verdict=verdict_of(result),
        next_steps=next_steps(result),
        facts=facts,
        sections=sections,
    )


def _spread(count: int) -> np.ndarray:
    """Return shifts within a row, so that all dots of it are visible."""
    return np.asarray(np.random.default_rng(0).uniform(-0.25, 0.25, count))


def _limit_plot(result: Robustness) -> PlotGroup:
    """Return the margins of every limit on every robot."""
    percent = 100.0 * np.maximum(result.margins, LEAST_DRAWN_MARGIN / 100.0)
    names = [f"{limit.kind.replace('_', ' ')} {limit.name}" for limit in result.limits]
    traces: list[Plotly] = []
    for is_kept, name, role in (
        (True, KEEPING, INITIAL.word),
        (False, EXCEEDING, DESIGNED.word),
    ):
        columns = [i for i in range(len(names)) if bool(result.kept[:, i].all()) is is_kept]
        if not columns:
            continue
        rows = [i + _spread(result.runs) for i in columns]
        trace = dots(
            np.concatenate(percent[:, columns].T), np.concatenate(rows), name, role, size=5
        )
        trace["opacity"] = 0.6
        traces.append(trace)

    texts = [
        f"{name}: planned {100.0 * p:.1f} %" for name, p in zip(names, result.planned, strict=True)
    ]
    places = np.arange(float(len(names)))
    planned = dots(
        100.0 * result.planned, places, PLANNED, "text", size=18, symbol="line-ns-open", texts=texts
    )
    planned["marker"]["line"] = {"width": 2.5, "color": "role:text"}
    low = min(-5.0, float(percent.min(initial=0.0)) - 5.0)
    high = max(100.0, 100.0 * float(result.planned.max(initial=0.0)) + 5.0)
    panel = Panel(
        title="margin of every limit on every robot [% of half of the range]",
        traces=[*traces, planned],
        layout={
            "xaxis": axis("margin [%]; negative: exceeded", range=[low, high]),
            "yaxis": row_axis(names, 26),
            "shapes": [band(low, 0.0, "forbidden", across="y")],
            "hovermode": "closest",
        },
        height=rows_height(len(names), 28),
        wide=True,
    )
    present = {trace["legendgroup"] for trace in traces}
    keys = [Key(name=PLANNED, role="text", shape="dot")]
    for name, role in ((KEEPING, INITIAL.word), (EXCEEDING, DESIGNED.word)):
        if name in present:
            keys.append(Key(name=name, role=role, shape="dot"))
    return PlotGroup(title="", panels=[panel], keys=keys)


def _error_plots(result: Robustness) -> PlotGroup:
    """Return the errors of all estimates, and how often the intervals hold the true values."""
    names = list(result.names)
    z = np.clip(result.z, -LARGEST_DRAWN_ERROR, LARGEST_DRAWN_ERROR)
    rows = np.concatenate([j + _spread(len(z)) for j in range(len(names))])
    errors = np.concatenate(z.T)
    is_inside = np.abs(errors) <= NORMAL_95
    traces = []
    for chosen, name, role in (
        (is_inside, INSIDE, MEASURED.word),
        (~is_inside, OUTSIDE, DESIGNED.word),
    ):
        trace = dots(errors[chosen], rows[chosen], name, role, size=5)
        trace["opacity"] = 0.6
        traces.append(trace)

    reach = LARGEST_DRAWN_ERROR + 0.3
    strip = Panel(
        title="errors of the estimates [σ]",
        traces=traces,
        layout={
            "xaxis": axis("(estimate − true value) / σ [–]", range=[-reach, reach]),
            "yaxis": row_axis(names),
            "shapes": [band(-NORMAL_95, NORMAL_95, across="y")],
            "hovermode": "closest",
        },
        height=rows_height(len(names), 44),
    )
    share = np.where(result.identified, 100.0 * result.inside / max(result.runs, 1), np.nan)
    texts = [f"{value:.0f} %" if np.isfinite(value) else "" for value in share]
    coverage = Panel(
        title="95 % intervals that hold the true value [% of the robots]",
        traces=[rows_of_bars(share, "coverage", "series7", texts=texts)],
        layout={
            "xaxis": axis("robots [%]", range=[0, 115]),
            "yaxis": row_axis(names),
            "shapes": [
                level(100.0 * CONFIDENCE, "text", across="y", dash="solid"),
                level(100.0 * REQUIRED_COVERAGE, "text", across="y"),
            ],
            "hovermode": "closest",
        },
        height=rows_height(len(names), 44),
    )
    keys = [
        Key(name=INSIDE, role=MEASURED.word, shape="dot"),
        Key(name=OUTSIDE, role=DESIGNED.word, shape="dot"),
    ]
    note = (
        f"Errors beyond ± {LARGEST_DRAWN_ERROR:g} σ are drawn there. Lines of the coverage: 95 %, "
        f"and the {100.0 * REQUIRED_COVERAGE:g} % that are required (dashed)."
    )
    return PlotGroup(title="", panels=[strip, coverage], keys=keys, note=note)
