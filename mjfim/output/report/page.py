"""Parts of a report, independent of HTML: its verdict, its sections, and their plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mjfim.output.summaries.verdicts import Verdict
from mjfim.output.summary_parts import Part

# Values that JSON can hold, for the plotting library.
Plotly = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Key:
    """An entry of the legend of a group of plots, which shows and hides its curves.

    Attributes:
        name: Name of the curves, by which they are found.
        role: Role of their colour.
        shape: "line", "dash", "dot", "tick", "bar" or "band".
    """

    name: str
    role: str
    shape: str = "line"


@dataclass(frozen=True, kw_only=True)
class Panel:
    """One plot.

    A colour is written as `role:<name>`; the page has a colour for each role in each theme.

    Attributes:
        title: Title above the plot, with the unit of the vertical axis.
        traces: Traces of the plotting library; `legendgroup` is the name of an entry of the legend.
        layout: Further layout.
        height: Height [CSS pixels].
        remark: A few words beside the title; may be empty.
        wide: True where the plot takes the whole width.
        narrow: True where the plot never takes more than half of the width.
        linked: Plots with the same word here show the same range of the horizontal axis.
        keys: Entries of a legend of this plot alone.
    """

    title: str
    traces: Sequence[Plotly]
    layout: Plotly = field(default_factory=dict)
    height: int = 230
    remark: str = ""
    wide: bool = False
    narrow: bool = False
    linked: str = ""
    keys: Sequence[Key] = ()


@dataclass(frozen=True, kw_only=True)
class PlotGroup:
    """Plots that belong together, under one legend.

    Attributes:
        title: Heading; may be empty.
        panels: The plots.
        keys: Entries of the legend.
        note: Remark below the plots; may be empty.
        folded: True where the reader unfolds the plots.
    """

    title: str
    panels: Sequence[Panel]
    keys: Sequence[Key] = ()
    note: str = ""
    folded: bool = False


@dataclass(frozen=True, kw_only=True)
class Section:
    """A section of a report.

    Attributes:
        title: Heading, which is also its entry in the navigation.
        parts: Tables, paragraphs, lists and plots.
    """

    title: str
    parts: Sequence[Part | PlotGroup]


@dataclass(frozen=True, kw_only=True)
class Page:
    """A report.

    Attributes:
        kind: What the report is about, such as "Design".
        verdict: The result in one sentence.
        next_steps: What the reader can do next, one sentence each.
        warnings: Sentences that the reader must not overlook.
        facts: Short facts by their name, such as the duration.
        sections: The sections, the important one first.
    """

    kind: str
    verdict: Verdict
    next_steps: Sequence[str] = ()
    warnings: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
    sections: Sequence[Section] = ()
