"""Reports: one HTML file that needs nothing else, with everything escaped."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plotly.graph_objects import Figure

from mjfim.files import write_json
from mjfim.output.page import REPORT
from mjfim.output.pages import page_of
from mjfim.output.panels import (
    Axis,
    Cells,
    Mark,
    Panel,
    Picture,
    bars,
    dots,
    hspan,
    line,
    row_axis,
    vline,
)
from mjfim.output.plots.pictures import pictures_of
from mjfim.output.plots.plotly import packed, plots_of, thinned
from mjfim.output.report import KINDS, Media, media_in, report_of, write_report
from mjfim.output.video import Video
from mjfim.records.base import ShownRecord
from tests.support import results
from tests.support.results import MAKERS

# A name that would change the page, or run, if it were not escaped.
HOSTILE = "<script>alert(1)</script>"

# Largest size of a report [bytes].
MAX_SIZE = 8_000_000


@cache
def record_of(verb: str) -> ShownRecord:
    """The made-up result of a verb."""
    return MAKERS[verb]()


@cache
def html_of(verb: str) -> str:
    """The report of the made-up result of a verb."""
    return report_of([record_of(verb)], [verb])


def own_part(html: str) -> str:
    """A report without the plotting library."""
    start = html.index("</script>", html.index('id="report-data"'))
    library = html[start:].split("<script>", 2)
    return html[:start] + library[2]


def data_of(html: str) -> dict[str, Any]:
    """The data of the plots of a report."""
    text = html.split('id="report-data">', 1)[1].split("</script>", 1)[0]
    data: dict[str, Any] = json.loads(text)
    return data


def numbers(array: dict[str, str]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype=f"<{array['dtype']}")


# ---- the file


@pytest.mark.parametrize("verb", MAKERS)
def test_a_report_needs_no_other_file_and_shows_everything(verb: str) -> None:
    html, page = html_of(verb), page_of(record_of(verb))
    data = data_of(html)

    # The part around the plotting library names no address, and scripts and styles are inline.
    assert len(html.encode()) < MAX_SIZE
    assert html.lstrip().startswith("<!DOCTYPE html>")
    assert re.findall(r"https?://", own_part(html)) == []
    assert re.findall(r"<(?:script|img|video|iframe)[^>]* src=", html) == []
    assert re.findall(r'<link[^>]*href="(?!data:)', html) == []
    assert "default-src 'none'" in html

    # The first thing is the verdict; every section has an entry in the navigation.
    places = [html.index(f'<div class="verdict {page.verdict.level}'), html.index("<nav")]
    for i, title in enumerate(page.sections):
        assert f'<a href="#section-1-{i + 1}">{title}</a>' in html
        places.append(html.index(f"<h2>{title}</h2>"))
    assert places == sorted(places)

    # The pictures of a folder stand in the report, too; joint uncertainties only in their file.
    panels = [int(number) for number in re.findall(r'data-panel="(\d+)"', html)]
    assert panels == list(range(len(data["panels"])))
    shown = [
        unescape(heading).replace("\xa0", " ")
        for heading in re.findall(r"<(?:h3|summary)>([^<]*)</", html)
    ]
    for name, make in pictures_of(record_of(verb)).items():
        assert name == "pairs" or shown.count(make().title) == 1, name

    # A role without a colour would be drawn in black on a dark page.
    text, colours = json.dumps(data["panels"]), data["palettes"]["light"]
    roles = set(re.findall(r'"role:([^"]+)"', text))
    roles |= set(re.findall(r"color: var\(--([\w-]+)\)", html)) - {"level"}
    assert roles <= set(colours) == set(data["palettes"]["dark"])

    # The classes of plotly refuse unknown names and values.
    stated = re.sub(r'"role:([^"]+)"', lambda role: json.dumps(colours[role[1]]), text)
    for panel in json.loads(stated):
        Figure(data=panel["traces"], layout=panel["layout"])


@pytest.mark.parametrize("verb", MAKERS)
def test_names_of_others_are_escaped(verb: str) -> None:
    """A name with a script stays a text, in the page and in the data of the plots."""
    names = {"name": HOSTILE} if verb in ("design", "identify", "rehearse") else {}
    record = MAKERS[verb](parameters=(HOSTILE, "<img src=x>", "a & b"), **names)
    html = report_of([record], [HOSTILE])
    assert HOSTILE not in html
    assert "<img src=x" not in html
    assert html.count("</script>") == html_of(verb).count("</script>")
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in own_part(html)
    assert "<" not in html.split('id="report-data">', 1)[1].split("</script>", 1)[0]


# ---- contents


def test_a_design_shows_its_tables_and_curves() -> None:
    """The values of a curve are those of the trajectory."""
    html = html_of("design")
    assert '<td data-label="change of σ">÷ 10.0</td>' in html
    traces = [trace for panel in data_of(html)["panels"] for trace in panel["traces"]]
    curves = [trace for trace in traces if trace.get("name") == "designed"]
    position = next(curve for curve in curves if len(numbers(curve["y"])) == 51)
    assert numbers(position["x"])[-1] == pytest.approx(results.design().trajectory.t[-1])


MARKS = [
    line([0, 1], [2, 3], "measured", label="curve", dash="--"),
    Mark(kind="steps", x=np.arange(3.0), y=np.array([5.0, 6.0])),
    dots([1], [2], "nominal", symbol="|", texts=["<odd>"]),
    bars([3.0], [0.0], "initial", left=1.0, label="bars", hollow=True),
    vline(2.0, "muted"),
    hspan(-1.0, 1.0, label="strip"),
]


def test_marks_become_traces_and_shapes() -> None:
    panel = Panel(marks=MARKS, x=Axis(label="time [s]", log=True, limits=(0.1, 10.0)))
    lower = replace(panel, x=Axis(label="time [s]"), place=(1, 0))
    picture = Picture(title="T", panels=[replace(panel, x=Axis()), lower], heights=(1.0, 5.0))
    assert [(key.label, key.kind) for key in picture.legend()] == [
        ("curve", "line"),
        ("bars", "bars"),
        ("strip", "hspan"),
    ]
    first, second = (data for _, _, data in plots_of(picture, 1000))
    curve, held, marks, bar = first["traces"]
    assert curve["line"]["dash"] == "dash" and curve["line"]["color"] == "role:measured"
    assert held["line"]["shape"] == "hv" and numbers(held["y"]).tolist() == [5.0, 6.0, 6.0]
    assert marks["text"] == ["&lt;odd&gt;"]
    assert (bar["base"], numbers(bar["x"])[0]) == ([1.0], 2.0)
    upright, strip = first["layout"]["shapes"]
    assert (upright["x0"], upright["yref"]) == (2.0, "y domain")
    assert (strip["y0"], strip["y1"]) == (-1.0, 1.0)
    # Plots above each other share the name of their axis, and their range when one is zoomed.
    assert first["layout"]["xaxis"]["title"]["text"] == "time [s]"
    assert first["linked"] == second["linked"] != ""
    assert second["height"] == 500
    ((_, is_wide, alone),) = plots_of(Picture(title="", panels=[panel]), 9)
    assert is_wide and alone["layout"]["xaxis"]["range"] == [-1.0, 1.0]


def test_cells_and_words_beside_rows() -> None:
    values, edges = np.array([[1.0, np.nan], [2.0, 3.0]]), np.array([0.0, 1.5, 3.0])
    cells = Cells(values=values, middle=1.0, texts=[["a", "b"]] * 2, edges=edges)
    names = row_axis(["x" * 40, "y"])
    panel = Panel(cells=cells, x=names, beside=[("head", "muted", ["one", "two"])], message="m")
    ((_, _, plot),) = plots_of(Picture(title="", panels=[panel]), 9)
    (heatmap,) = plot["traces"]
    assert heatmap["x"] == [0.0, 1.5, 3.0]
    assert heatmap["z"] == [[0.0, None], [1.0, 2.0]] and heatmap["text"][0] == ["a", "b"]
    layout = plot["layout"]
    assert [each["text"] for each in layout["annotations"]] == ["head", "one", "two", "m"]
    assert len(layout["yaxis"]["ticktext"][0]) < 30 and layout["margin"]["r"] > 30


# ---- long logs


def test_thinning_keeps_the_peaks() -> None:
    """One high and one low sample out of a million remain, and the ends, in order."""
    values = np.zeros(1_000_000)
    values[123_456], values[654_321] = 7.0, -5.0
    values[10:20] = np.nan
    kept = thinned(values, 1000)
    assert len(kept) <= 1000
    assert {0, 123_456, 654_321, 999_999} <= set(kept.tolist())
    assert (np.diff(kept) > 0).all()
    assert np.array_equal(thinned(values[:5], 1000), np.arange(5))


def test_numbers_are_packed_as_exactly_as_a_plot_shows_them() -> None:
    """Single precision where it is enough, and gaps stay."""
    for values, kind in ((np.array([0.0, 0.25, np.nan]), "f4"), (1e9 + np.arange(3.0), "f8")):
        array = packed(values)
        assert array["dtype"] == kind
        assert np.array_equal(numbers(array), values, equal_nan=True)


def test_an_hour_of_signals_stays_small() -> None:
    """An hour at 10 Hz with thirty curves of limits."""
    design = results.design(samples=36_000)
    many = tuple(replace(design.usage[0], name=f"joint {i}") for i in range(30))

    # A large video leaves less room.
    video = replace(film("video/mp4"), data=bytes(2_000_000))
    for media in (Media(), Media(video)):
        assert len(report_of([replace(design, usage=many)], media=media)) < MAX_SIZE


# ---- video


def film(media_type: str, caption: str = "It swings.") -> Video:
    """A made-up video."""
    content = bytes(range(256))
    return Video(data=content, media_type=media_type, caption=caption, width=640, height=360)


@pytest.mark.parametrize(
    "media",
    [
        Media(film("video/mp4", 'A "robot" <swings>.')),
        Media(film("image/webp")),
        Media(no_video="No renderer & no display."),
    ],
)
def test_a_video_or_why_there_is_none_is_found_again(media: Media, tmp_path: Path) -> None:
    html = report_of([record_of("design")], media=media)
    (tmp_path / REPORT).write_text(html, encoding="utf-8")
    assert media_in(tmp_path / REPORT) == media
    assert ('<a href="#video">' in html) is (media.video is not None)
    assert media_in(tmp_path / "none") == Media()


# ---- folders


def test_a_report_holds_every_result_of_a_folder_and_is_made_again_byte_for_byte(
    tmp_path: Path,
) -> None:
    """The design stands above its check; the video stays, and is not rendered again."""
    assert {MAKERS[verb]().__class__ for verb in MAKERS} == set(KINDS)
    check, design = results.check(), results.design()
    check.save(tmp_path)
    write_report(tmp_path, check)
    design.save(tmp_path)
    file = write_report(tmp_path, design, Media(film("video/mp4")))
    first = file.read_bytes()
    html = first.decode()
    kinds = ("Design of an experiment", "Check of an experiment")
    assert html.index(f"<h1><small>{kinds[0]}") < html.index(f"<h1><small>{kinds[1]}")
    assert f'<a href="#result-2">{kinds[1]}</a>' in html
    assert b"\r\n" not in first[:10_000]
    (tmp_path / "design.json").touch()
    for made in (check, None):
        assert write_report(tmp_path, made) == file
        assert file.read_bytes() == first


def test_a_report_has_the_name_of_its_experiment_wherever_it_is(tmp_path: Path) -> None:
    """The JSON file of a result names experiment and model; the name of the folder is not shown."""
    record = results.check()
    record.save_archive(tmp_path)
    origin = {"experiment": "../arm.toml", "model": "..\\models\\arm.xml"}
    write_json(tmp_path / "check.json", {**origin, **record.summary()})
    html = write_report(tmp_path).read_text(encoding="utf-8")
    for words in (
        "<h1><small>Check of an experiment</small>arm</h1>",
        "<dt>experiment</dt><dd>arm.toml</dd>",
        "<dt>model</dt><dd>arm.xml</dd>",
    ):
        assert words in html
    assert tmp_path.name not in html


def test_a_report_draws_every_length_of_segments_that_was_compared() -> None:
    grown = results.horizons()
    for study, is_flat in ((grown, False), (replace(grown, errors=np.ones((4, 4))), True)):
        html = report_of([results.estimate(horizons=study)])
        assert "whole recordings" in html
        assert ("an effect that does not add up" in html.replace("\n", " ")) is is_flat
