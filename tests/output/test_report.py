"""Reports: one HTML file that needs nothing else, with everything escaped."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.errors import MjfimError, RecordingError
from mjfim.files import write_json
from mjfim.output.report import REPORT, VERBS
from mjfim.output.report.build import KINDS, page_of, rewrite_reports, write_report
from mjfim.output.report.correlations import correlation_of
from mjfim.output.report.curves import correlation_panel, packed, points_per_curve, thinned
from mjfim.output.report.page import Panel, PlotGroup
from mjfim.output.report.palette import palettes
from mjfim.output.report.render import is_page_of, no_video_in, rendered, video_in
from mjfim.output.summaries.verdicts import Level, next_steps, verdict_of
from mjfim.output.video import Video
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import CampaignStatus
from mjfim.records.check import Check
from mjfim.records.design import Design, LimitUsage, Status
from mjfim.records.terms import TermTestData
from tests.support import results

# A name that would change the page, or run, if it were not escaped.
HOSTILE = "<script>alert(1)</script>"

# Largest size of a report [bytes].
MAX_SIZE = 8_000_000


@cache
def record_of(verb: str) -> ShownRecord:
    """The made-up result of a verb."""
    return results.MAKERS[verb]()


@cache
def html_of(verb: str) -> str:
    """The report of the made-up result of a verb."""
    return rendered(page_of(record_of(verb)), verb)


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
    """The numbers of an array of a plot."""
    return np.frombuffer(base64.b64decode(array["bdata"]), dtype=f"<{array['dtype']}")


# ---- the file


@pytest.mark.parametrize("verb", results.MAKERS)
def test_a_report_needs_no_other_file(verb: str) -> None:
    """The part around the plotting library names no address, and scripts and styles are inline."""
    html = html_of(verb)
    assert len(html.encode()) < MAX_SIZE
    assert html.lstrip().startswith("<!DOCTYPE html>")
    assert re.findall(r"https?://", own_part(html)) == []
    assert re.findall(r"<(?:script|img|video|iframe)[^>]* src=", html) == []
    assert re.findall(r'<link[^>]*href="(?!data:)', html) == []
    assert "default-src 'none'" in html


@pytest.mark.parametrize("verb", results.MAKERS)
def test_the_verdict_stands_above_the_sections(verb: str) -> None:
    """The first thing is the verdict; every section has an entry in the navigation."""
    html, page = html_of(verb), page_of(record_of(verb))
    places = [html.index(f'<div class="verdict {page.verdict.level.value}'), html.index("<nav")]
    for i, section in enumerate(page.sections):
        assert f'<a href="#section-{i + 1}">{section.title}</a>' in html
        places.append(html.index(f"<h2>{section.title}</h2>"))
    assert places == sorted(places)


@pytest.mark.parametrize("verb", results.MAKERS)
def test_every_plot_has_a_place_and_a_unit(verb: str) -> None:
    """The numbers of the places are those of the plots; titles name a unit in brackets."""
    html = html_of(verb)
    panels = data_of(html)["panels"]
    places = [int(number) for number in re.findall(r'data-panel="(\d+)"', html)]
    assert places == list(range(len(panels)))
    titles = re.findall(r"<figcaption><b>(.*?)</b>", html)
    assert all(re.search(r"\[.+\]", title) for title in titles), titles


@pytest.mark.parametrize("verb", results.MAKERS)
def test_every_name_in_a_legend_has_curves(verb: str) -> None:
    """A click on it would hide nothing otherwise; bands are no curves."""
    for section in page_of(record_of(verb)).sections:
        groups = [part for part in section.parts if isinstance(part, PlotGroup)]
        for legend, panels in [
            *((group.keys, group.panels) for group in groups),
            *((panel.keys, [panel]) for group in groups for panel in group.panels),
        ]:
            curves = {trace["legendgroup"] for p in panels for trace in p.traces if "name" in trace}
            names = {key.name for key in legend if key.role != "band"}
            assert names <= curves, (section.title, names - curves)


@pytest.mark.parametrize("verb", results.MAKERS)
def test_every_colour_has_a_value_in_both_themes(verb: str) -> None:
    """A role without a colour would be drawn in black on a dark page."""
    html = html_of(verb)
    data = data_of(html)
    roles = set(re.findall(r'"role:([^"]+)"', json.dumps(data["panels"])))
    roles |= set(re.findall(r"color: var\(--([\w-]+)\)", html)) - {"level"}
    assert roles <= set(data["palettes"]["light"])
    assert set(data["palettes"]["light"]) == set(data["palettes"]["dark"])


@pytest.mark.parametrize("verb", results.MAKERS)
def test_names_of_others_are_escaped(verb: str) -> None:
    """A name with a script stays a text, in the page and in the data of the plots."""
    names = {"name": HOSTILE} if verb in ("design", "identify", "robustness") else {}
    record = results.MAKERS[verb](parameters=(HOSTILE, "<img src=x>", "a & b"), **names)
    html = rendered(page_of(record), HOSTILE)
    assert HOSTILE not in html
    assert "<img src=x" not in html
    assert html.count("</script>") == html_of(verb).count("</script>")
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in own_part(html)
    assert "<" not in html.split('id="report-data">', 1)[1].split("</script>", 1)[0]


def test_a_record_without_report_is_refused() -> None:
    class Other(ShownRecord):
        """A record that nobody knows."""

    with pytest.raises(MjfimError, match="a Other has no report"):
        page_of(Other())


# ---- contents


def test_a_design_shows_its_tables_and_curves() -> None:
    """The values of a curve are those of the trajectory; the heat map holds the correlation."""
    html = html_of("design")
    data = data_of(html)
    for heading in ("Accuracy", "Motion", "Limits", "Optimisation"):
        assert f"<h2>{heading}</h2>" in html
    assert "Ready to play" in html
    assert '<td data-label="change of σ">÷ 10.0</td>' in html

    maps = [t for p in data["panels"] for t in p["traces"] if t["type"] == "heatmap"]
    assert maps[0]["z"][0][1] == pytest.approx(results.CORRELATION)
    assert maps[0]["z"][0][0] is None

    design = results.design()
    curves = [t for p in data["panels"] for t in p["traces"] if t["type"] == "scatter"]
    position = next(t for t in curves if len(numbers(t["y"])) == 51 and t["name"] == "designed")
    assert numbers(position["x"])[-1] == pytest.approx(design.trajectory.t[-1])


def test_an_estimate_shows_predictions_and_residuals() -> None:
    html = html_of("identify")
    for heading in ("Parameters", "Predictions", "Signals", "Residuals", "Search"):
        assert f"<h2>{heading}</h2>" in html
    assert "Autocorrelation of the residuals" in html
    assert "Spectrum of the residuals" in html
    assert "identified / nominal" in html and "Prediction errors of every output" in html


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({}, Level.GOOD, "σ of 1 % or less"),
        ({"limits": {"position": -0.1}}, Level.BAD, "violates limits (position)"),
        ({"status": Status.INFEASIBLE}, Level.BAD, "not ready"),
        (
            {"theta": np.array([2.0, 1.0, 1e-3])},
            Level.DOUBTFUL,
            "can be played, but it does not determine damping: σ is 500 % of its size",
        ),
        (
            {"theta": np.array([2.0, 1e-3, 1e-3])},
            Level.DOUBTFUL,
            "does not determine length, damping: σ is 1000 % of its size for length",
        ),
    ],
)
def test_the_verdict_on_a_design(changes: dict[str, Any], level: Level, words: str) -> None:
    design = results.design(**changes)
    assert verdict_of(design).level is level
    assert words in verdict_of(design).text
    assert ("Ready to play" in verdict_of(design).text) is (level is Level.GOOD)
    assert next_steps(design)


def test_a_limit_that_swings_fast_is_drawn_as_an_envelope() -> None:
    """Of 2,000 swings, the largest size in each of 150 intervals remains."""
    t = np.linspace(0.0, 2.0, 20_001)
    share = (0.5 + 0.2 * t) * np.sin(2e3 * np.pi * t)
    usage = LimitUsage(kind="force", name="motor", t=t, share=share, lower=-1.0, upper=1.0)
    panels = data_of(rendered(page_of(results.design(usage=(usage,)))))["panels"]
    panel = next(p for p in panels if p["linked"] == "limits")
    values = numbers(panel["traces"][0]["y"])
    assert len(values) == 150
    assert values.max() == pytest.approx(100.0 * np.abs(share).max())
    assert panel["layout"]["yaxis"]["range"][0] == 0.0


def test_a_joint_has_one_colour_in_all_plots_of_limits() -> None:
    """The closest of each kind differ; a share below the bound is not rounded up to it."""
    usage = results.design().usage[0]
    used = tuple(
        replace(usage, kind=kind, name=name, share=share * np.sin(usage.t))
        for kind, name, share in (
            ("position", "elbow", 0.5),
            ("position", "wrist", 0.999),
            ("force", "elbow", 0.7),
            ("force", "wrist", 0.2),
        )
    )
    sections = {s.title: s.parts for s in page_of(results.design(usage=used)).sections}
    (group,) = (part for part in sections["Limits"] if isinstance(part, PlotGroup))
    roles = [{key.name.split()[0]: key.role for key in panel.keys} for panel in group.panels]
    assert roles[0] == roles[1] == {"wrist": "series0", "elbow": "series1"}
    assert group.panels[0].keys[0].name == "wrist > 99 %"


def test_orientations_are_rotation_vectors() -> None:
    """A turn of a free body about z by up to 1 rad; its quaternion is not shown."""
    design = results.design()
    t = design.final.trajectory.t
    angle = t / t[-1]
    qpos = np.zeros((len(t), 7))
    qpos[:, 3], qpos[:, 6] = np.cos(angle / 2.0), np.sin(angle / 2.0)
    evaluations = {
        name: replace(each, trajectory=replace(each.trajectory, qpos=qpos))
        for name, each in (("initial", design.initial), ("final", design.final))
    }
    coordinates = ("x", "y", "z", "rx", "ry", "rz")
    labels = replace(
        results.labels(),
        qpos=tuple(f"b.{name} [1]" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")),
        positions=tuple(f"b.{name} [rad]" for name in coordinates),
    )
    page = page_of(results.design(**evaluations, labels=labels))
    (group,) = (
        part
        for section in page.sections
        for part in section.parts
        if isinstance(part, PlotGroup) and part.title == "Positions"
    )
    assert [panel.title for panel in group.panels] == list(labels.positions)
    np.testing.assert_allclose(group.panels[5].traces[1]["y"], angle, atol=1e-6)


def test_a_limit_far_away_is_named_and_does_not_flatten_the_motion() -> None:
    """It is drawn where the motion comes near; elsewhere its value stands above the plot."""

    def position(bound: float) -> Panel:
        usage = replace(results.design().usage[0], lower=-bound, upper=bound)
        sections = {s.title: s.parts for s in page_of(results.design(usage=(usage,))).sections}
        groups = [part for part in sections["Motion"] if isinstance(part, PlotGroup)]
        return next(group.panels[0] for group in groups if group.title == "Positions")

    near, far = position(1.125), position(50.0)
    assert len(near.layout["shapes"]) == 2
    assert not near.remark
    assert (far.layout["shapes"], far.remark) == ([], "limits -50 and 50")
    assert "yaxis" not in far.layout


def test_few_predictions_are_shown_over_the_noise() -> None:
    """One plot for each recording, with a row for each output; a mark is explained."""
    estimate = results.estimate()
    prediction = replace(estimate.predictions[0], held_out=False)
    known = results.estimate(predictions=(prediction,), sigma={"qpos:hinge": 0.5})
    sections = {section.title: section.parts for section in page_of(known).sections}
    groups = [part for part in sections["Predictions"] if isinstance(part, PlotGroup)]
    errors = next(group for group in groups if group.title.startswith("Errors"))
    (panel,) = errors.panels
    assert panel.title.endswith(" *: rms error of the prediction / σ of the noise [–]")
    assert "* predicted by a fit to the other recordings" in errors.note
    assert numbers(panel.traces[1]["x"])[0] == pytest.approx(prediction.identified.rms[0] / 0.5)


@pytest.mark.parametrize(("nominal", "kind"), [(900.0, "log"), (2.0, None)])
def test_a_nominal_model_far_away_hides_no_small_error(nominal: float, kind: str | None) -> None:
    """Errors of 1 and 900 times the noise are both seen, and so is the noise."""
    prediction = results.estimate().predictions[0]
    found = replace(
        prediction,
        identified=replace(prediction.identified, rms=np.array([1.1])),
        nominal=replace(prediction.nominal, rms=np.array([nominal])),
    )
    estimate = results.estimate(predictions=(found,), sigma={"qpos:hinge": 1.0})
    sections = {section.title: section.parts for section in page_of(estimate).sections}
    groups = [part for part in sections["Predictions"] if isinstance(part, PlotGroup)]
    (panel,) = next(group for group in groups if group.title.startswith("Errors")).panels
    axis = panel.layout["xaxis"]
    assert axis.get("type") == kind
    low, high = axis["range"] if kind is None else np.power(10.0, axis["range"])
    assert low < 1.0 and nominal < high
    assert {trace["textposition"] for trace in panel.traces} == {"none"}


def test_small_correlations_are_seen() -> None:
    """A tenth has a third of the strongest colour, and the colours beside it stay in order."""
    for theme in palettes().values():
        scale = theme["diverging"]
        places, colours = zip(*scale, strict=True)
        assert (places[0], places[-1]) == (0.0, 1.0)
        assert (np.diff(places) > 0.0).all()

        channels = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in colours])
        end, middle = channels[-1], channels[len(channels) // 2]
        at_a_tenth = [np.interp(0.55, places, channels[:, i]) for i in range(3)]
        share = np.linalg.norm(at_a_tenth - middle) / np.linalg.norm(end - middle)
        assert share == pytest.approx(np.sqrt(0.1), abs=0.02)


def test_long_names_of_correlations_become_numbers() -> None:
    """They would be cut below the columns; a correlation of -0.001 is no negative zero."""
    names = ["a", "b", "c", "damping_of_the_shoulder"]
    panel = correlation_panel(np.full((4, 4), -0.001), names, "correlation [–]")
    assert panel.layout["xaxis"]["ticktext"] == ["1", "2", "3", "4"]
    assert panel.layout["yaxis"]["ticktext"][:2] == ["a  1", "b  2"]
    assert str(panel.traces[0]["z"][0][1]) == "0.0"
    short = correlation_panel(np.eye(2), ["a", "b"], "correlation [–]")
    assert short.layout["xaxis"]["ticktext"] == ["a", "b"]


def test_a_rough_design_asks_for_another_motion_not_for_more_time() -> None:
    steps = next_steps(results.design(status=Status.ROUGH))
    assert "contacts" in steps[0]
    assert not any("more time" in step for step in steps)


@pytest.mark.parametrize(
    ("changes", "level", "words"),
    [
        ({}, Level.GOOD, "explains the recordings"),
        ({"misfit": True, "chi2": 800.0}, Level.DOUBTFUL, "2.01 times the noise"),
        ({"success": False, "status": "stopped early"}, Level.BAD, "reliable: stopped early."),
        ({"success": False, "combinations": ("a b",)}, Level.BAD, "in combination only"),
    ],
)
def test_the_verdict_on_an_estimate(changes: dict[str, Any], level: Level, words: str) -> None:
    estimate = results.estimate(**changes)
    assert verdict_of(estimate).level is level
    assert words in verdict_of(estimate).text


@pytest.mark.parametrize(
    ("verb", "changes", "level", "words"),
    [
        ("check", {}, Level.GOOD, "σ of 2 %"),
        ("check", {"refused": ("too long",), "verdict": ("a b",)}, Level.DOUBTFUL, "A b."),
        ("compare", {}, Level.GOOD, "The design is the best"),
        ("montecarlo", {}, Level.GOOD, "scatter as predicted"),
        ("robustness", {}, Level.DOUBTFUL, "of 20 robots keep all limits"),
        ("campaign", {}, Level.GOOD, "Reached"),
        ("campaign", {"status": CampaignStatus.INFEASIBLE}, Level.BAD, "No design keeps"),
        ("campaign", {"status": CampaignStatus.WAITING, "rounds": ()}, Level.GOOD, "waits"),
    ],
)
def test_the_verdict_on_a_study(
    verb: str, changes: dict[str, Any], level: Level, words: str
) -> None:
    record = results.MAKERS[verb](**changes)
    assert (verdict_of(record).level, words in verdict_of(record).text) == (level, True)
    assert rendered(page_of(record))


def test_fits_that_failed_or_scatter_too_much_put_a_study_in_doubt() -> None:
    sets = results.study().sets
    failed = {**sets, "final": replace(sets["final"], failed=3)}
    assert "3 of 200 (designed)" in verdict_of(results.study(sets=failed)).text

    # One interval of six may miss 1 by chance, and the verdict says so.
    intervals = np.array([[1.01, 1.2], [0.9, 1.1], [0.9, 1.1]])
    by_chance = replace(sets["final"], efficiency_interval=intervals)
    inside = replace(sets["initial"], efficiency_interval=np.tile([0.9, 1.1], (3, 1)))
    lucky = verdict_of(results.study(sets={"initial": inside, "final": by_chance}))
    assert lucky.level is Level.GOOD
    assert "1 of 6 intervals of 95 % misses it" in lucky.text

    wide = replace(sets["final"], efficiency_interval=np.tile([0.1, 0.2], (3, 1)))
    verdict = verdict_of(results.study(sets={**sets, "final": wide}))
    assert verdict.level is Level.DOUBTFUL
    assert "the designed trajectory" in verdict.text


def test_a_missing_term_is_the_first_next_step() -> None:
    estimate = results.estimate(misfit=True, missing_terms=(results.missing_term(),))
    assert "joint/hinge:frictionloss" in next_steps(estimate)[0]
    assert "<h2>Missing terms</h2>" in rendered(page_of(estimate))

    # Where only a part of the data was tested, the page says so.
    part = replace(estimate, tested_data=TermTestData(share=0.17, recordings=4, count=4))
    text = rendered(page_of(part)).replace("\xa0", " ")
    assert "residuals (17 % of the data, from all 4 recordings)" in text
    assert "were tested on 17 % of the data, from all 4 recordings." in text
    assert part.summary()["suspects_tested"]["share"] == 0.17
    assert estimate.summary()["suspects_tested"] is None


def test_the_correlation_of_parameters_that_are_identifiable_alone() -> None:
    """The third parameter is known in no direction; the others keep their correlation."""
    information = np.zeros((3, 3))
    information[:2, :2] = np.linalg.inv(results.covariance(np.array([2.0, 0.5])))
    found = correlation_of(information, np.array([2.0, 0.5, np.inf]))
    assert found[0, 1] == pytest.approx(results.CORRELATION)
    assert np.isnan(found[2]).all()


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
    assert packed(np.array([0.0, 0.25, np.nan]))["dtype"] == "f4"
    assert np.isnan(numbers(packed(np.array([0.0, 0.25, np.nan])))[2])
    tiny_changes = 1e9 + np.arange(3.0)
    assert np.array_equal(numbers(packed(tiny_changes)), tiny_changes)


def test_an_hour_of_signals_stays_small() -> None:
    """An hour at 10 Hz with thirty curves of limits."""
    samples = 36_000
    usage = results.design(samples=samples).usage[0]
    many = tuple(
        LimitUsage(kind="position", name=f"joint {i}", t=usage.t, share=usage.share)
        for i in range(30)
    )
    design = results.design(samples=samples, usage=many)
    html = rendered(page_of(design))
    assert len(html) < MAX_SIZE
    assert "thinned for display" in html
    assert "thinned for display" not in html_of("design")

    # A large video leaves less room.
    video = replace(film("video/mp4"), data=bytes(2_000_000))
    assert len(rendered(page_of(design), video=video)) < MAX_SIZE


def test_short_curves_leave_their_points_to_long_ones() -> None:
    assert points_per_curve([10, 10, 5000], 1020) == 1000
    assert points_per_curve([10_000], 10**6) == 4000
    assert points_per_curve([10_000] * 1000, 100) == 40


# ---- video


def film(media_type: str, caption: str = "It swings.") -> Video:
    """A made-up video."""
    content = bytes(range(256))
    return Video(data=content, media_type=media_type, caption=caption, width=640, height=360)


@pytest.mark.parametrize("media_type", ["video/mp4", "image/webp"])
def test_a_video_is_embedded_and_found_again(media_type: str) -> None:
    video = film(media_type, 'A "robot" <swings>.')
    html = rendered(page_of(record_of("design")), video=video)
    assert video_in(html) == video
    assert '<a href="#video">' in html
    assert video_in(html_of("design")) is None


def test_without_video_a_sentence_says_why() -> None:
    html = rendered(page_of(record_of("design")), no_video="No renderer & no display.")
    assert no_video_in(html) == "No renderer & no display."


# ---- folders


def test_a_report_is_made_again_byte_for_byte(tmp_path: Path) -> None:
    """Also with a video, which is not rendered again."""
    design = results.design()
    design.save(tmp_path)
    first = write_report(tmp_path, Design, film("video/mp4")).read_bytes()
    (tmp_path / "design.json").touch()
    assert [path.read_bytes() for path in rewrite_reports(tmp_path)] == [first]
    assert b"\r\n" not in first[:10_000]


def test_every_result_of_a_folder_has_a_page(tmp_path: Path) -> None:
    """A design takes the place of a check, which keeps a page of its own; both name the other."""
    assert tuple(KINDS) == VERBS
    results.check().save(tmp_path)
    assert write_report(tmp_path, Check).name == REPORT

    results.design().save(tmp_path)
    first = write_report(tmp_path, Design, film("video/mp4"))
    beside = tmp_path / "report_check.html"
    assert first.name == REPORT
    assert is_page_of(first.read_text(encoding="utf-8"), "Design of an experiment")
    assert is_page_of(beside.read_text(encoding="utf-8"), "Check of an experiment")
    assert '<a href="report_check.html">check</a>' in first.read_text(encoding="utf-8")
    assert '<a href="report.html">design</a>' in beside.read_text(encoding="utf-8")

    # A later check does not replace the page of the design, whose video remains.
    pages = {path: path.read_bytes() for path in (first, beside)}
    assert write_report(tmp_path, Check) == beside
    assert pages == {path: path.read_bytes() for path in pages}
    assert rewrite_reports(tmp_path) == [first, beside]
    assert pages == {path: path.read_bytes() for path in pages}
    assert video_in(first.read_text(encoding="utf-8")) == film("video/mp4")


def test_a_report_has_the_name_of_its_experiment_wherever_it_is(tmp_path: Path) -> None:
    """The JSON file of a result names experiment and model; the name of the folder is not shown."""
    folders = [tmp_path / "one", tmp_path / "two"]
    pages = []
    for folder in folders:
        record = results.check()
        record.save_archive(folder)
        origin = {"experiment": "../arm.toml", "model": "..\\models\\arm.xml"}
        write_json(folder / "check.json", {**origin, **record.summary()})
        pages.append(write_report(folder, Check).read_text(encoding="utf-8"))
    assert pages[0] == pages[1]
    assert "<h1><small>Check of an experiment</small>arm</h1>" in pages[0]
    assert "<dt>experiment</dt><dd>arm.toml</dd>" in pages[0]
    assert "<dt>model</dt><dd>arm.xml</dd>" in pages[0]


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"holds no result; .*design\.npz"):
        rewrite_reports(tmp_path)
    with pytest.raises(RecordingError, match="no such folder"):
        rewrite_reports(tmp_path / "nowhere")
    assert not (tmp_path / REPORT).exists()
