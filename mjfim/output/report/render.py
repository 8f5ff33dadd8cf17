"""Reports as HTML: one file that holds its style, its plots and the plotting library.

The file makes no request to any network. All names and sentences are escaped, because they may come
from files of others.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import unescape
from typing import TYPE_CHECKING, Any

from mjfim.output.html import escape
from mjfim.output.report.curves import is_line, packed_trace, points_per_curve
from mjfim.output.report.page import Page, Panel, PlotGroup
from mjfim.output.report.palette import palettes
from mjfim.output.summary_parts import Emphasis, SummaryTable, capitalised
from mjfim.output.video import Video
from mjfim.output.vocabulary import shown_word

if TYPE_CHECKING:
    from jinja2 import Template

# Folder of the templates, beside this module.
PACKAGE, TEMPLATES = "mjfim.output.report", "templates"

# Class of every emphasis.
CLASSES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "strong",
    Emphasis.WEAK: "weak",
    Emphasis.WARNING: "warning-row warning",
    Emphasis.STRONG_WARNING: "warning-row warning strong",
    Emphasis.DERIVED: "derived",
}

# Largest size of a report, and size of its tables and sentences [bytes].
MAX_SIZE, TEXT_SIZE = 7_800_000, 250_000

# Largest size of a point of a curve in the file [bytes].
POINT_SIZE = 22

# Space between a number and its sign of percent or of a standard deviation.
UNIT_SPACE = re.compile(r"(?<=\d) (?=[%σ])|(?<=±) (?=\d)")

# The video of a report, and the sentence that stands there instead; the template writes both.
VIDEO = re.compile(
    r'<(?:video|img) class="robot" width="(\d+)" height="(\d+)" [^>]*'
    r'src="data:([\w/.+-]+);base64,([\w+/=]+)"'
    r'.*?<p class="note">(.*?)</p>',
    re.DOTALL,
)
NO_VIDEO = re.compile(r'<p class="note no-video">(.*?)</p>', re.DOTALL)


def rendered(
    page: Page,
    name: str = "",
    video: Video | None = None,
    no_video: str = "",
    *,
    others: Mapping[str, str] | None = None,
) -> str:
    """Return a report as one HTML file.

    Args:
        page: The report.
        name: Name of what was designed, identified or studied; may be empty.
        video: A video of the robot, or None.
        no_video: Sentence that says why there is no video; may be empty.
        others: Pages of other results in the same folder, by their verbs.
    """
    # These libraries are slow to import, and only reports need them.
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    library = get_plotlyjs()
    panels = list(_panels(page))
    limit = _limit_of(panels, len(library), video)
    number_of = {id(panel): i for i, panel in enumerate(panels)}

    colours = palettes()
    data = {"palettes": colours, "panels": [_as_json(panel, limit) for panel in panels]}
    html: str = _template("report.html.j2").render(
        page=page,
        name=name,
        video=video,
        no_video=no_video,
        others=others or {},
        palettes=colours,
        panel_number=lambda panel: number_of[id(panel)],
        is_thinned=lambda group: _is_thinned(group, limit),
        data=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        css=Markup(_template("report.css").render()),
        js=Markup(_template("report.js").render()),
        plotly=Markup(library),
    )
    return html


@cache
def _template(file: str) -> Template:
    """Return a template of this package; to compile one takes longer than to fill it.

    Args:
        file: Its name. Style and script hold no expressions.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader(PACKAGE, TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        base64=lambda content: base64.b64encode(content).decode("ascii"),
        capital=capitalised,
        colours=_plain_colours,
        column_labels=_column_labels,
        emphasis_class=CLASSES.__getitem__,
        group_heads=lambda table: list(_group_heads(table)),
        kind_of=lambda part: type(part).__name__,
        prose=lambda text: Markup(UNIT_SPACE.sub("\u00a0", escape(text))),
        sentence=_as_sentence,
        without_bullet=lambda text: text.removeprefix("• "),
    )
    return environment.get_template(file)


def is_page_of(html: str, kind: str) -> bool:
    """Whether a report is that of a kind of result.

    Args:
        html: The report.
        kind: The kind, as a page states it.
    """
    return f"<h1><small>{kind}</small>" in html


def video_in(html: str) -> Video | None:
    """Return the video that a report embeds; None without one.

    Args:
        html: The report.
    """
    found = VIDEO.search(html)
    if found is None:
        return None
    width, height, media_type, content, caption = found.groups()
    return Video(
        data=base64.b64decode(content),
        media_type=media_type,
        caption=unescape(caption),
        width=int(width),
        height=int(height),
    )


def no_video_in(html: str) -> str:
    """Return the sentence with which a report says why it has no video; may be empty.

    Args:
        html: The report.
    """
    found = NO_VIDEO.search(html)
    return "" if found is None else unescape(found.group(1))


def _panels(page: Page) -> Iterator[Panel]:
    """Yield all plots of a report in their order."""
    for section in page.sections:
        for part in section.parts:
            if isinstance(part, PlotGroup):
                yield from part.panels


def _limit_of(panels: Sequence[Panel], library: int, video: Video | None) -> int:
    """Return how many points a curve may have, so that the file is small enough.

    Args:
        panels: All plots.
        library: Size of the plotting library [bytes].
        video: The video, or None.
    """
    taken = library + TEXT_SIZE + (0 if video is None else 4 * len(video.data) // 3)
    points = max(MAX_SIZE - taken, 0) // POINT_SIZE
    lengths = [len(trace["y"]) for p in panels for trace in p.traces if is_line(trace)]
    return points_per_curve(lengths, points)


def _is_thinned(group: PlotGroup, limit: int) -> bool:
    """Whether a curve of a group of plots has more points than are drawn."""
    return any(is_line(t) and len(t["y"]) > limit for panel in group.panels for t in panel.traces)


def _as_json(panel: Panel, limit: int) -> dict[str, Any]:
    """Return what the script of the page reads of a plot."""
    return {
        "traces": [packed_trace(trace, limit) for trace in panel.traces],
        "layout": panel.layout,
        "height": panel.height,
        "linked": panel.linked,
    }


def _as_sentence(text: str) -> str:
    """Return a text with a capital first letter and a full stop."""
    return capitalised(text) + ("" if text.endswith((".", "!", "?")) else ".")


def _plain_colours(palette: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the roles that have a single colour."""
    return [(role, colour) for role, colour in palette.items() if isinstance(colour, str)]


@dataclass(frozen=True, kw_only=True)
class _GroupHead:
    """A heading above several columns.

    Attributes:
        span: Number of columns.
        trajectory: Name of the trajectory in the records; empty above other columns.
        word: The heading.
    """

    span: int
    trajectory: str
    word: str


def _column_labels(table: SummaryTable) -> list[str]:
    """Return the heading of every column with that above it, for rows that stand alone."""
    labels = [str(column.heading) for column in table.columns]
    for group in table.groups:
        for column in range(group.first, group.last + 1):
            labels[column] = f"{shown_word(group.trajectory)} {labels[column]}"
    return labels


def _group_heads(table: SummaryTable) -> Iterator[_GroupHead]:
    """Yield the headings above the columns of a table, also empty ones."""
    column = 0
    for group in table.groups:
        if group.first > column:
            yield _GroupHead(span=group.first - column, trajectory="", word="")
        span = group.last + 1 - group.first
        yield _GroupHead(span=span, trajectory=group.trajectory, word=shown_word(group.trajectory))
        column = group.last + 1
    if column < len(table.columns):
        yield _GroupHead(span=len(table.columns) - column, trajectory="", word="")
