"""The report of a folder: one file that holds its style, its plots and the plotting library.

The file makes no request to any network. All names and sentences are escaped, because they may come
from files of others.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any, NamedTuple

from mjfim.errors import RecordingError, first_ones, listed
from mjfim.files import read_json, replacing
from mjfim.output.page import (
    OTHER,
    REPORT,
    TERMS,
    Emphasis,
    Page,
    Plot,
    Text,
    as_sentence,
    capitalised,
)
from mjfim.output.pages import page_of
from mjfim.output.panels import CELL_COLOURS, ROLES, Picture
from mjfim.output.plots.pictures import kind_of_picture, pictures_of
from mjfim.output.plots.plotly import Plot as PanelPlot
from mjfim.output.plots.plotly import plots_of
from mjfim.output.video import Video
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.rehearsal import Rehearsal
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import Campaign, Comparison, MonteCarloStudy
from mjfim.records.worth import Watch, Worth

if TYPE_CHECKING:
    from jinja2 import Template
    from markupsafe import Markup


# Colours of page and plots that belong to no term of the vocabulary, by their role.
LIGHT = {
    "page": "#ffffff",
    "card": "#f6f7f8",
    "text": "#222222",
    "muted": "#5c6268",
    "grid": "#e2e5e8",
    "band": "#d9dcdf",
    "white": "#ffffff",
    "good": "#1a7f4b",
    "doubtful": "#9a6700",
    "bad": "#c0281a",
    "link": "#0a5fa5",
}
DARK = {
    "page": "#16191d",
    "card": "#20252b",
    "text": "#e6e8ea",
    "muted": "#a3abb3",
    "grid": "#333a42",
    "band": "#3a424b",
    "white": "#16191d",
    "good": "#4fc78a",
    "doubtful": "#e0b04c",
    "bad": "#ff8072",
    "link": "#7dbdf5",
}

# Colours of negative, small and positive values of cells on a dark page.
CELLS_DARK = ("#2a73b5", "#262b31", "#c2412f")

# How much lighter the colours of curves without a role are on a dark page.
LIGHTER = 0.35


def palettes() -> dict[str, dict[str, Any]]:
    """Return the colours by theme, `light` and `dark`, and role."""
    places = (0.0, 0.5, 1.0)
    light: dict[str, Any] = {
        **ROLES,
        **LIGHT,
        "diverging": list(zip(places, CELL_COLOURS, strict=True)),
    }
    dark: dict[str, Any] = {
        **{role: _lighter(colour) for role, colour in ROLES.items()},
        **{term: term.colour_on_dark for term in (*TERMS, OTHER)},
        **DARK,
        "diverging": list(zip(places, CELLS_DARK, strict=True)),
    }
    return {"light": light, "dark": dark}


def _lighter(colour: str) -> str:
    """A colour that can be read on a dark page."""
    channels = bytes.fromhex(colour.removeprefix("#"))
    return f"#{bytes(round(c + LIGHTER * (255 - c)) for c in channels).hex()}"


# Folder of the templates, beside this module.
PACKAGE, TEMPLATES = "mjfim.output", "templates"

# Names of commands, keys and files in sentences.
CODE = re.compile(r"`([^`\n]+)`")

# Characters that Markdown would take for its own marks; an underscore only at the edge of a word.
MARKS = re.compile(r"[\\|*`<>\[\]~]|(?<!\w)_|_(?!\w)")

# Space between a number and its sign of percent or of a standard deviation.
UNIT_SPACE = re.compile(r"(?<=\d) (?=[%σ])|(?<=±) (?=\d)")

# Style of every emphasis in a notebook, which keeps no style sheets.
STYLES = {
    Emphasis.NORMAL: "",
    Emphasis.STRONG: "font-weight: bold",
    Emphasis.WEAK: "opacity: 0.7",
    Emphasis.WARNING: "border-left: 0.25em solid #cc8800; padding-left: 0.5em",
    Emphasis.DERIVED: "font-style: italic",
}


def as_html(record: ShownRecord) -> str:
    """Write the page of a record for a notebook: verdict and warnings first, then its parts."""
    html: str = template("notebook.html.j2").render(page=page_of(record), styles=STYLES)
    return html


@cache
def template(file: str) -> Template:
    """Return a template of this package; to compile one takes longer than to fill it."""
    # Slow to import, and only reports and notebooks need it.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(PACKAGE, TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        capital=capitalised,
        kind_of=lambda part: type(part).__name__,
        markdown=_markdown,
        prose=_prose,
        sentence=as_sentence,
    )
    return environment.get_template(file)


def _markdown(text: str) -> Markup:
    """A text on one line, without a character that Markdown takes for a mark."""
    from markupsafe import Markup

    return Markup(MARKS.sub(lambda mark: f"\\{mark[0]}", " ".join(text.split())))


def _prose(text: str) -> Markup:
    """A text as HTML: words in backquotes are code, and numbers stay with their units."""
    from markupsafe import Markup, escape

    spaced = UNIT_SPACE.sub("\u00a0", str(escape(text)))
    return Markup(CODE.sub(r"<code>\1</code>", spaced).replace("\n", "<br/>"))


# Results that have a report; of several in a folder, the first one stands at the top.
KINDS: tuple[type[ShownRecord], ...] = (
    Campaign,
    Estimate,
    Design,
    Comparison,
    RobotComparison,
    MonteCarloStudy,
    Rehearsal,
    Check,
    Worth,
    Watch,
)

# Longest list of recordings among the facts [characters].
MAX_RECORDINGS_TEXT = 60

# Largest size of a report, and size of its tables and sentences [bytes].
MAX_SIZE, TEXT_SIZE = 7_800_000, 250_000

# Largest size of a point of a curve in the file [bytes], and fewest and most points of a curve.
POINT_SIZE, FEWEST_POINTS, MOST_POINTS = 22, 40, 4000

# The video of a report, and the sentence that stands there instead; the template writes both.
VIDEO = re.compile(
    r'<(?:video|img) class="robot" width="(\d+)" height="(\d+)" [^>]*'
    r'src="data:([\w/.+-]+);base64,([\w+/=]+)"'
    r'.*?<p class="note">(.*?)</p>',
    re.DOTALL,
)
NO_VIDEO = re.compile(r'<p class="note no-video">(.*?)</p>', re.DOTALL)


class Result(NamedTuple):
    """A result in a report: its words, what it is named after, and its plots by their names."""

    page: Page
    name: str
    pictures: Mapping[str, Sequence[tuple[Picture, Sequence[PanelPlot]]]]
    said: set[str]


class Media(NamedTuple):
    """The video of a report, or why there is none."""

    video: Video | None = None
    no_video: str = ""


def kinds_in(folder: Path) -> list[type[ShownRecord]]:
    """Return the kinds of the results that a folder holds, that of the main result first.

    Raises:
        RecordingError: There is no such folder, or it holds no result.
    """
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder")
    found = [kind for kind in KINDS if (folder / f"{kind.file_stem}.npz").is_file()]
    if not found:
        names = listed([f"{kind.file_stem}.npz" for kind in KINDS])
        raise RecordingError(f"{folder}: holds no result; a report needs one of {names}")
    return found


def write_report(folder: Path, made: ShownRecord | None = None, media: Media | None = None) -> Path:
    """Write the report of a folder, as its files give it.

    Args:
        folder: The folder.
        made: A result that was just written; others are read. Default: all are read.
        media: The video; default: that of the present report.

    Returns:
        The report.

    Raises:
        RecordingError: A result cannot be read, or there is none.
    """
    file = folder / REPORT
    design = folder if (folder / "design.npz").is_file() else None
    records: list[ShownRecord] = []
    names = []
    pages = []
    for kind in kinds_in(folder):
        # A result of an earlier version, which cannot be read, is left out beside a new one.
        try:
            record = made.as_saved() if isinstance(made, kind) else kind.load(folder)
        except RecordingError:
            if made is None:
                raise
            continue
        records.append(record)
        stated = _stated(folder, record)
        names.append(_name(folder, record, stated))
        experiment = stated.get("experiment")
        place = None if experiment is None else os.path.normpath(folder / experiment)
        page = page_of(record, experiment=place, design=design)
        pages.append(replace(page, facts={**_origin(record, stated), **page.facts}))
    html = report_of(records, names, media or media_in(file), pages)
    with replacing(file) as temporary:
        temporary.write_text(html, encoding="utf-8", newline="\n")
    return file


def report_of(
    records: Sequence[ShownRecord],
    names: Sequence[str] = (),
    media: Media | None = None,
    pages: Sequence[Page] = (),
) -> str:
    """Return the report of some results as HTML.

    Args:
        records: The results, the main one first.
        names: What each of them is named after.
        media: The video of the report.
        pages: Page of each result; default: one without the paths of files.
    """
    # These libraries are slow to import, and only reports need them.
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    library, media = get_plotlyjs(), media or Media()
    pages = pages or [page_of(record) for record in records]
    drawn = [_pictures(record, page) for record, page in zip(records, pages, strict=True)]
    limit = _limit_of([each for some in drawn for each in some.values()], len(library), media)
    results = [
        Result(
            page=page,
            name=names[i] if names else "",
            pictures={
                part: [(each, plots_of(each, limit)) for each in some]
                for part, some in drawn[i].items()
            },
            said={part.text for part in page.parts if isinstance(part, Text)},
        )
        for i, page in enumerate(pages)
    ]
    panels = [
        data
        for result in results
        for some in result.pictures.values()
        for _, plots in some
        for _, _, data in plots
    ]
    number_of = {id(data): i for i, data in enumerate(panels)}
    data = {"palettes": palettes(), "panels": panels}
    video = media.video
    html: str = template("report.html.j2").render(
        results=results,
        video=video,
        no_video=media.no_video,
        encoded="" if video is None else base64.b64encode(video.data).decode("ascii"),
        palettes=palettes(),
        number_of=lambda panel: number_of[id(panel)],
        data=htmlsafe_json_dumps(data, separators=(",", ":"), allow_nan=False),
        css=Markup(template("report.css").render()),
        js=Markup(template("report.js").render()),
        plotly=Markup(library),
    )
    return html


def _pictures(record: ShownRecord, page: Page) -> dict[str, list[Picture]]:
    """The pictures of a page, by their names in it."""
    pictures = pictures_of(record)
    return {
        part.name: [make() for name, make in pictures.items() if kind_of_picture(name) == part.name]
        for part in page.every_part
        if isinstance(part, Plot)
    }


def _limit_of(pictures: Sequence[Sequence[Picture]], library: int, media: Media) -> int:
    """Number of points that a curve may have, so that the file is small enough."""
    taken = library + TEXT_SIZE
    if media.video is not None:
        taken += 4 * len(media.video.data) // 3
    shown = [picture for some in pictures for picture in some]
    curves = sum(len(panel.marks) for picture in shown for panel in picture.panels)
    share = max(MAX_SIZE - taken, 0) // POINT_SIZE // max(curves, 1)
    return min(max(share, FEWEST_POINTS), MOST_POINTS)


def media_in(file: Path) -> Media:
    """Return the video that a report embeds, or the sentence why it has none."""
    html = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    sentence, found = NO_VIDEO.search(html), VIDEO.search(html)
    if found is None:
        return Media(no_video="" if sentence is None else unescape(sentence.group(1)))
    width, height, media_type, content, caption = found.groups()
    video = Video(
        data=base64.b64decode(content),
        media_type=media_type,
        caption=unescape(caption),
        width=int(width),
        height=int(height),
    )
    return Media(video)


# ---- what a result is named after


def _stated(folder: Path, record: ShownRecord) -> dict[str, str]:
    """The paths of the experiment and of the model that the JSON file of a result names."""
    try:
        saved = read_json(folder / f"{record.file_stem}.json")
    except RecordingError:
        return {}
    paths = {key: saved.get(key) for key in ("experiment", "model")}
    # The file may have been written on another system.
    return {
        key: PureWindowsPath(path).as_posix()
        for key, path in paths.items()
        if path and isinstance(path, str)
    }


def _origin(record: ShownRecord, stated: Mapping[str, str]) -> dict[str, str]:
    """The experiment, the model and the recordings of a result, as far as they are known."""
    found = {key: PurePosixPath(path).name for key, path in stated.items()}
    if isinstance(record, Estimate):
        names = [PurePath(recording.name).name for recording in record.recordings]
        found["recordings"] = first_ones(names, longest=MAX_RECORDINGS_TEXT)
    return {key: name for key, name in found.items() if name}


def _name(folder: Path, record: ShownRecord, stated: Mapping[str, str]) -> str:
    """Name of a result: that of the experiment, else of the recordings or the folder."""
    if "experiment" in stated:
        return PurePosixPath(stated["experiment"]).stem
    if isinstance(record, Estimate):
        return first_ones([PurePath(recording.name).name for recording in record.recordings])
    if isinstance(record, Comparison):
        return PurePath(record.source).stem
    if isinstance(record, RobotComparison):
        return " and ".join(record.names)
    return folder.resolve().name
