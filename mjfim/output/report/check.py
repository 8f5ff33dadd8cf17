"""The report of a check."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.output.report.curves import (
    correlation_panel,
    dots,
    log_axis,
    row_axis,
    rows_height,
    rows_of_bars,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Section
from mjfim.output.summaries.accuracy import relative
from mjfim.output.summaries.check import describe_check
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Listing, Part, Quantity
from mjfim.output.vocabulary import INITIAL
from mjfim.records.check import Check

# Ratio of the wanted to the predicted standard deviation below which the mark of the wanted one
# would stand in the text behind the bar.
CROSSED_RATIO = 4.0

# Names of the curves in the legend.
PREDICTED, WANTED = "predicted σ", "wanted σ"


def check_page(check: Check) -> Page:
    """Return the report of a check.

    Args:
        check: The check.
    """
    # The findings stand in full at the top, or below the table.
    summary = describe_check(check)
    table = summary.table("accuracy")
    others = [part for part in summary.parts if part is not table and not _is_verdict(part)]
    findings = [] if not check.ok else [Listing(title="", items=_sentences(check.verdict))]
    accuracy = [table, *findings, *_accuracy_plots(check), *others]
    sections = [Section(title="Accuracy", parts=accuracy)]
    if check.violations:
        sections.append(Section(title="Limits", parts=[_violations(check)]))

    facts = {
        "checked": check.source,
        "duration": f"{check.horizon:g} s",
        "parameters": str(len(check.rows)),
        "condition of the information": str(Quantity(value=check.condition)),
    }
    return Page(
        kind="Check of an experiment",
        verdict=verdict_of(check),
        next_steps=next_steps(check),
        warnings=() if check.ok else _sentences(check.verdict[1:]),
        facts=facts,
        sections=sections,
    )


def _sentences(verdict: Sequence[str]) -> tuple[str, ...]:
    """Return the sentences of a verdict with a capital first letter and a full stop."""
    return tuple(f"{sentence[:1].upper()}{sentence[1:]}." for sentence in verdict)


def _is_verdict(part: Part) -> bool:
    """Whether a part of the summary is the list of findings."""
    return isinstance(part, Listing) and part.title == "Further findings"


def _accuracy_plots(check: Check) -> Iterator[Part | PlotGroup]:
    """Yield predicted and wanted standard deviations, and the correlations of the estimates."""
    rows = [row for row in check.rows if not row.nuisance]
    names = [row.name for row in rows]
    sizes = np.array([row.size or np.nan for row in rows])
    predicted = 100.0 * np.array([row.std for row in rows]) / sizes
    wanted = 100.0 * np.array([row.wanted for row in rows]) / sizes
    bars = np.where(np.isfinite(predicted), predicted, np.nan)

    texts = [str(relative(row.std, row.size)) for row in rows]
    targets = [f"{row.name}: wanted {relative(row.wanted, row.size)}" for row in rows]
    places = np.arange(float(len(rows)))
    marks = dots(wanted, places, WANTED, "text", size=16, symbol="line-ns-open", texts=targets)
    marks["marker"]["line"] = {"width": 2.5, "color": "role:text"}
    drawn = rows_of_bars(bars, PREDICTED, INITIAL.word, texts=texts)
    is_crossed = (wanted > bars) & (wanted < CROSSED_RATIO * bars)
    drawn["textposition"] = ["inside" if crossed else "outside" for crossed in is_crossed]
    drawn["insidetextanchor"] = "end"
    traces = [drawn, marks]
    panels = [
        Panel(
            title="predicted σ [% of the parameter's size]",
            traces=traces,
            layout={
                "xaxis": log_axis("σ / size [%]", np.append(bars, wanted), room=(0.5, 0.3)),
                "yaxis": row_axis(names),
                "hovermode": "closest",
                "bargap": 0.35,
            },
            height=rows_height(len(names), 38),
        )
    ]
    if len(check.wanted) > 1 and np.isfinite(check.correlation).any():
        title = "correlation of the estimates [–]"
        panels.append(correlation_panel(check.correlation, check.wanted, title))

    keys = [
        Key(name=PREDICTED, role=INITIAL.word, shape="bar"),
        Key(name=WANTED, role="text", shape="tick"),
    ]
    note = (
        "No bar: the parameter is not identifiable alone. Pairs with a correlation near ±1 are "
        "hardly distinguishable."
    )
    yield PlotGroup(title="", panels=panels, keys=keys, note=note)


def _violations(check: Check) -> Listing:
    """Return the limits that the motion of the initial control violates."""
    return Listing(
        title="The motion of the initial control violates limits; a design looks for one inside:",
        items=tuple(str(violation) for violation in check.violations),
    )
