"""Pictures as data show what the records hold; matplotlib draws them in one style."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import MjfimError
from mjfim.output.archive import rotation_vectors
from mjfim.output.panels import Mark, Panel, Picture, range_of_intervals
from mjfim.output.plots.design import (
    accuracy,
    accuracy_over_time,
    convergence,
    limits,
    trajectories,
)
from mjfim.output.plots.draw import figure_of, log_ticks, save
from mjfim.output.plots.estimate import accuracy as accuracy_of_estimate
from mjfim.output.plots.estimate import fit, parameter_intervals
from mjfim.output.plots.estimate_studies import Spread, estimate_pairs, pairs, selection
from mjfim.output.plots.pictures import draw, picture_names, pictures_of, usual
from mjfim.output.plots.studies import check, histogram
from mjfim.output.report import report_of
from mjfim.output.words import (
    format_number,
    format_with_uncertainty,
    quotient_unit,
    relative,
    squared_unit,
    without_zeros,
)
from mjfim.records.base import listed_values
from mjfim.records.design import LimitUsage
from mjfim.records.estimate import Estimate
from mjfim.records.terms import Decision, Selection, SelectionStep
from mjfim.records.trajectory import with_unit
from tests.support import results
from tests.support.made_records import (
    make_design,
    make_estimate,
    make_labels,
    make_row,
    make_study,
)

LABELS = make_labels(2, 3)


def marks_of(panel: Panel, role: str, kind: str = "line") -> list[Mark]:
    return [mark for mark in panel.marks if mark.role == role and mark.kind == kind]


def arrows_of(panel: Panel) -> list[float]:
    """Rows with an arrow at the right edge."""
    (arrows,) = (mark for mark in panel.marks if mark.symbol == ">")
    rows: list[float] = arrows.y.tolist()
    return rows


# ---- designs


def test_trajectories_show_both_motions() -> None:
    design = make_design()
    picture = trajectories(design, LABELS)
    joint = next(panel for panel in picture.panels if panel.title.startswith("joint_0 [rad]"))
    for role, evaluation in (("initial", design.initial), ("designed", design.final)):
        (curve,) = marks_of(joint, role)
        assert_array_equal(curve.y, evaluation.trajectory.qpos[:, 0])
    assert [panel for panel in picture.panels if panel.is_shaded]
    assert [key.label for key in picture.legend()] == ["initial", "designed"]


def test_rotation_vectors_have_no_jumps() -> None:
    """Three turns about an oblique axis are one straight line."""
    angle = np.linspace(0.0, 6.0 * np.pi, 400)[:, None]
    axis = np.array([1.0, -2.0, 2.0]) / 3.0
    turned = np.hstack([np.cos(angle / 2.0), np.sin(angle / 2.0) * axis])
    turned[::2] *= -1.0
    assert_allclose(rotation_vectors(turned), angle * axis, atol=1e-6)


def test_convergence_shows_begin_end_and_stages() -> None:
    design = make_design()
    picture = convergence(design)
    assert all(panel.y.log for panel in picture.panels)
    assert_array_equal(picture.panels[0].marks[0].y, [row.cost for row in design.history])
    assert "start: " in picture.legend()[0].label

    rows = tuple(replace(row, rate=10.0 + k // 5) for k, row in enumerate(design.history))
    staged = convergence(replace(design, history=rows))
    assert len(marks_of(staged.panels[0], "band", "vline")) == 1
    assert "grid becomes finer" in staged.note


@pytest.mark.parametrize("std", [np.full(3, np.inf), np.array([np.inf, 1.0, 2.0])])
def test_parameters_that_are_not_determined_are_arrows_at_the_edge(std: np.ndarray) -> None:
    design = make_design()
    design = replace(design, final=replace(design.final, std=std))
    assert arrows_of(accuracy(design, LABELS).panels[0]) == np.flatnonzero(np.isinf(std)).tolist()
    message = accuracy_over_time(design, LABELS).panels[0].message
    assert message == ("no parameter is determined alone" if np.isinf(std).all() else "")


def test_accuracies_are_dots_in_percent_beside_what_is_wanted() -> None:
    """A parameter whose nominal value is 0 has no percent, only its standard deviation."""
    labels = replace(LABELS, wanted=np.array([0.02, np.inf, 0.3]))
    design = replace(make_design(), labels=labels, theta=np.array([2.0, 0.0, 3.0]))
    panel, std = accuracy(design, labels).panels[0], design.stated_std
    (final,) = marks_of(panel, "designed", "dots")
    assert_allclose(final.x, 100.0 * std[[0, 2]] / design.sizes[[0, 2]])
    assert final.y.tolist() == [0.0, 2.0]
    (tick,) = marks_of(panel, "text", "dots")
    assert_allclose(tick.x, [2.0, np.nan, 15.0])
    assert panel.beside[1][2][1] == f"{std[1]:.3g}"


def test_curves_over_time_meet_the_wanted_accuracy_at_their_dots() -> None:
    labels = replace(LABELS, wanted=np.array([0.12, 0.09, np.inf]))
    design = replace(make_design(), labels=labels)
    panel = accuracy_over_time(design, labels).panels[0]
    assert panel.y.log
    for j, goal in ((0, 12.0), (1, 6.0)):
        _, curve = marks_of(panel, f"series{j}")
        (dot,) = marks_of(panel, f"series{j}", "dots")
        assert_allclose([dot.x[0], dot.y[0]], [curve.x[curve.y <= goal][0], goal])
        assert curve.label.endswith(relative(design.stated_std[j], design.sizes[j]))
    assert marks_of(panel, "series2", "dots") == []


# ---- limits


def limits_panel(kind: str, margin: float, speed: float, **amplitudes: float) -> Panel:
    t = np.linspace(0.0, 1.0, 1000)
    usage = tuple(
        LimitUsage(kind=kind, name=name, t=t, share=size * np.sin(speed * t))
        for name, size in amplitudes.items()
    )
    return limits(replace(make_design(), usage=usage, limits={kind: margin}), LABELS).panels[0]


def test_fast_curves_have_envelopes_and_many_of_them_rows() -> None:
    few = limits_panel("force", 0.1, 2000.0, a=0.9, b=0.5)
    assert [mark.role for mark in few.marks if mark.kind == "area"] == ["series0", "series1"]
    assert few.y.limits == (-112.0, 112.0)
    many = limits_panel("force", 0.1, 2000.0, **dict.fromkeys("abcd", 0.9))
    assert many.y.names == list("abcd")
    (slow,) = marks_of(limits_panel("force", 0.1, 3.0, a=0.9), "series0")
    assert slow.y.max() == pytest.approx(90.0, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "name", "margin", "title"),
    [
        ("force", "torque", 0.1, "force: smallest margin 0.10 N m"),
        ("velocity", "joint_0", 0.1, "velocity: smallest margin 0.10 rad/s"),
        ("clearance", "joint_0", 0.1, "clearance: smallest margin 0.10 m"),
        ("force", "torque", -0.2, "force: VIOLATED by 0.20 N m"),
    ],
)
def test_margins_of_limits_have_units_and_violated_limits_are_red(
    kind: str, name: str, margin: float, title: str
) -> None:
    panel = limits_panel(kind, margin, 3.0, **{name: 1.0 - 5.0 * margin / 4.0})
    assert panel.title == title
    assert (panel.role == "designed") is (margin < 0.0)
    assert panel.y.limits is not None
    assert (panel.y.limits[1] > 120.0) is (margin < 0.0)


# ---- estimates


def fitted(**changes: Any) -> Estimate:
    """An estimate whose outputs have a noise of 0.05."""
    made = make_estimate()
    return replace(made, sigma=dict.fromkeys(made.recordings[0].outputs, 0.05), **changes)


def test_a_fit_shows_data_residuals_and_band() -> None:
    estimate = fitted()
    curves, errors = fit(estimate, 0, LABELS).panels[:2]
    (measured,) = marks_of(curves, "measured", "dots")
    assert_array_equal(measured.y, estimate.recordings[0].y[:, 0])
    (residual,) = marks_of(errors, "measured", "dots")
    assert_allclose(residual.y, measured.y - estimate.predicted[0][:, 0])
    (band,) = marks_of(errors, "band", "hspan")
    assert (band.y[0], band.other) == (-0.1, np.array([0.1]))
    assert re.match(r"residual: rms / σ = \d\.\d\d", errors.title)

    # A nominal model far away does not flatten the curves.
    far = fitted(nominal=(50.0 * estimate.predicted[0],))
    ranges = [fit(each, 0, LABELS).panels[0].y.limits for each in (estimate, far)]
    assert np.ptp(np.array(ranges[1])) < 3.0 * np.ptp(np.array(ranges[0]))


def test_intervals_mark_bounds_and_misfit() -> None:
    estimate = make_estimate(misfit=True)
    picture = parameter_intervals(estimate, LABELS)
    (at_bound,) = (mark for mark in picture.panels[0].marks if mark.hollow)
    assert at_bound.label == "at its bound"
    assert "bias of a wrong model" in picture.note
    free = replace(estimate, at_bound=())
    assert "at its bound" not in [key.label for key in parameter_intervals(free, LABELS).legend()]


def test_few_wide_or_distant_intervals_do_not_widen_the_range() -> None:
    centre = np.array([0.0, 1.0, 2.0, 1e6, 1.0])
    half = np.array([1.0, 1.0, 1.0, 1.0, 500.0])
    low, high = range_of_intervals(centre, centre - half, centre + half)
    assert -4.0 < low < -1.0 and 3.0 < high < 6.0


@pytest.mark.parametrize(("count", "is_named"), [(3, True), (30, False)])
def test_terms_that_were_tried_have_names_unless_there_are_many(
    count: int, *, is_named: bool
) -> None:
    """A term that predicts far worse than all others is an arrow at the right end."""

    def step(decision: Decision, name: str, error: float) -> SelectionStep:
        return SelectionStep(decision=decision, description=name, error=error, count=1)

    steps = [step(Decision.REJECTED, f"term {i}", 1.5 + i) for i in range(count)]
    steps.append(step(Decision.UNHELPFUL, "a spring", np.nan))
    steps.append(step(Decision.ADDED, "friction", 1.0))
    found = Selection(terms=(), steps=(step(Decision.BEGUN, "", 2.0), *steps), ending="")
    panel = selection(replace(make_estimate(), selection=found)).panels[0]
    middle = [f"term {i}" for i in range(count)] if is_named else []
    assert panel.y.names == ["the stated model", *middle, "+ friction"]
    curve, crosses, arrows = panel.marks
    assert_allclose(curve.x, [2.0, 1.0])
    assert (len(crosses.x), len(arrows.x)) == (2, count - 2)


# ---- results at the edge of what there is


def without_an_output() -> Picture:
    """A fit of a recording in which one output was not measured."""
    (recording,) = fitted().recordings
    y = recording.y * [np.nan, 1.0]
    picture = fit(fitted(recordings=(replace(recording, y=y),)), 0, LABELS)
    assert picture.panels[1].message == "not measured"
    return picture


def of_an_unknown_parameter() -> Picture:
    """Intervals, one of which is endless."""
    made = make_estimate()
    interval = np.vstack([[-np.inf, np.inf], made.interval[1:]])
    std = np.append(np.inf, made.std[1:])
    return parameter_intervals(replace(made, std=std, interval=interval), LABELS)


def of_costs(*costs: float) -> Picture:
    """The convergence of a search with these costs."""
    rows = tuple(make_row(iteration=k, cost=cost) for k, cost in enumerate(costs))
    return convergence(replace(make_design(), history=rows))


@pytest.mark.parametrize(
    "picture",
    [
        without_an_output,
        of_an_unknown_parameter,
        of_costs,
        lambda: of_costs(1.0),
        lambda: of_costs(-1.0, -2.0),
        lambda: of_costs(np.nan, np.nan),
        lambda: histogram(make_study(2, failed=200), 1, make_labels(2, 2)),
        lambda: histogram(make_study(2, failed=199), 1, make_labels(2, 2)),
    ],
)
def test_little_or_strange_results_are_drawn(
    picture: Callable[[], Picture], tmp_path: Path
) -> None:
    save(picture(), tmp_path / "x.png", 30.0)


# ---- Monte Carlo studies


def test_a_histogram_is_a_density_with_its_statistics() -> None:
    for panel in histogram(make_study(3, failed=7), 0, LABELS).panels[:2]:
        bars = panel.marks[0]
        assert np.sum(bars.y * np.diff(bars.x)) == pytest.approx(1.0, abs=0.02)
        assert "200 trials, 7 failed" in panel.remark
        assert "efficiency 1.00, 95 % interval [0.800, 1.20]" in panel.remark


def test_outliers_and_endless_bounds_do_not_widen_a_histogram() -> None:
    study = make_study()
    found = study.sets["initial"]
    estimates = np.vstack([[1e6, 1.0, 1.0], found.estimates[1:]])
    for changed, remark in (
        (replace(found, estimates=estimates), "1 outside this range"),
        (replace(found, crlb=np.full((3, 3), np.inf)), "bound ∞"),
    ):
        sets = {**study.sets, "initial": changed}
        panel = histogram(replace(study, sets=sets), 0, LABELS).panels[0]
        assert panel.x.limits is not None and panel.x.limits[1] < 10.0
        assert remark in panel.remark


# ---- checks


def test_parameters_that_are_not_known_alone_are_arrows_and_without_correlation() -> None:
    combined = tuple(listed_values(["a + b"], [""], np.ones(1), np.full(1, 0.5)))
    made = results.check()
    rows = tuple(replace(row, std=np.inf, relative=np.inf) for row in made.rows[:2])
    correlation = made.correlation.copy()
    correlation[0] = np.nan
    found = replace(made, rows=(*rows, made.rows[2]), combined=combined, correlation=correlation)
    rows_of_dots, heat = check(found).panels
    assert rows_of_dots.y.names == [*(with_unit(row.name, row.unit) for row in found.rows), "a + b"]
    assert arrows_of(rows_of_dots) == [0.0, 1.0]

    # The colours of correlations are proportional to them.
    assert heat.cells is not None
    off_diagonal = ~np.eye(3, dtype=bool)
    assert_array_equal(heat.cells.values[off_diagonal], correlation[off_diagonal])


# ---- estimates beside what was predicted and published

DESIGN = results.design()


@pytest.fixture(scope="module")
def beside() -> Estimate:
    """An estimate with priors, bounds and published values, beside the design that was played."""
    labels = replace(
        make_labels(2, 3),
        parameters=results.PARAMETERS,
        wanted=np.array([0.05, np.inf, np.inf]),
        published=np.array([1.02, np.nan, np.nan]),
        bounds=np.array([[0.0, 1.01], [-np.inf, np.inf], [0.0, np.inf]]),
    )
    made = results.estimate(labels=labels, prior=np.diag([0.0, 25.0, 0.0]))
    return made.with_prediction(DESIGN)


def test_an_estimate_stands_beside_the_accuracy_that_was_predicted(beside: Estimate) -> None:
    assert_allclose(beside.prediction, np.linalg.inv(DESIGN.final.information), rtol=1e-9)
    checked = results.check()
    found = results.estimate().with_prediction(checked).predicted_std
    assert_allclose(found, [row.std for row in checked.rows])
    other = replace(DESIGN, parameters=("mass", "else", "damping"))
    found = results.estimate().with_prediction(other).predicted_std
    assert np.isnan(found).tolist() == [False, True, False]


def test_predicted_formal_honest_and_published_are_on_one_line(beside: Estimate) -> None:
    panel = accuracy_of_estimate(beside, beside.labels or LABELS).panels[0]
    size = np.abs(beside.theta)
    shares = {
        "predicted σ": DESIGN.stated_std / size,
        "formal σ": beside.std / size,
        "honest σ": 0.25 * np.ptp(beside.interval, axis=1) / size,
        "to published": [abs(1.02 - beside.theta[0]) / size[0]],
    }
    for label, share in shares.items():
        (mark,) = (mark for mark in panel.marks if mark.label == label)
        assert_allclose(mark.x, 100.0 * np.array(share))
    texts = {heading: written for heading, _, written in panel.beside}
    honest = np.array(beside.summary()["honest_std"]) / size
    assert texts["honest σ"] == [relative(share, 1.0) for share in honest.tolist()]
    (tick,) = marks_of(panel, "text", "dots")
    assert_allclose(tick.x, [5.0 / size[0], np.nan, np.nan])


def test_pairs_show_the_honest_covariance_priors_bounds_and_the_prediction(
    beside: Estimate,
) -> None:
    wide = 4.0 * beside.covariance
    made = replace(beside, honest_covariance=wide)
    picture = estimate_pairs(made, made.labels or LABELS)
    labels = {mark.label for mark in picture.legend()}
    assert {"honest 1 σ", "formal 2 σ", "predicted 2 σ", "prior 2 σ"} <= labels
    first, pair = picture.panels[:2]

    # The edge of 2 σ, in honest standard deviations: a plain quadratic form is 4 along it.
    unit = np.sqrt(np.diag(wide))
    edges = [mark for mark in pair.marks if mark.kind == "line"]
    for mark, matrix in zip(edges, (wide, made.covariance, DESIGN.covariance), strict=True):
        points = np.stack([mark.x, mark.y]) * unit[:2, None]
        form = np.sum(points * np.linalg.solve(matrix[:2, :2], points), axis=0)
        assert_allclose(form, 4.0, rtol=1e-6)
    (strip,) = (mark for mark in first.marks if mark.kind == "vspan")
    assert_allclose(strip.x, (1.01 - made.theta[0]) / unit[0])


def test_a_nominal_value_of_zero_has_no_percent() -> None:
    made = make_estimate(3)
    guess = made.initial_theta * [1.0, 0.0, 1.0]
    of_whole = replace(made, initial_theta=guess, sizes=2.0 * np.abs(made.theta))
    assert (of_whole.guess_sizes == 0.0).tolist() == [False, True, False]


def test_a_fixed_parameter_is_in_no_pair() -> None:
    """A parameter at its guess without a standard deviation has no ellipse and warns of nothing."""
    values = np.array([1.0, 2.0, 3.0])
    estimate = Spread(values, np.diag([0.0, 1e-4, 4e-4]), "identified", "honest")
    nominal = Spread(values, np.full((3, 3), np.nan), "nominal", "nominal", symbol="x")
    picture = pairs(["a", "b", "c"], ["", "", ""], [estimate, nominal], title="", note="")
    assert len(picture.panels) == 3  # b, c, and both


# ---- which pictures are files


def test_pictures_of_the_search_are_files_only_on_request() -> None:
    for record, folded in ((results.design(), "convergence"), (results.estimate(), "spectra")):
        assert folded in picture_names(record)
        assert folded not in usual(record)
        title = pictures_of(record)[folded]().title
        assert f"<details><summary>{title}</summary>" in report_of([record])


def test_the_largest_pictures_of_a_large_result_are_files_only_on_request() -> None:
    """The first one of each kind is drawn before others of its kind."""
    small, large = make_study(3), make_study(40)
    assert usual(small).keys() == pictures_of(small).keys()
    every, chosen = list(pictures_of(large)), list(usual(large))
    assert chosen == every[: len(chosen)] and "overview" in chosen
    assert 5 < len(chosen) < 40
    long = usual(make_design(30, 24))
    assert "trajectories" not in long and {"accuracy", "accuracy_over_time"} <= long.keys()


# ---- names and words


def test_wrong_names_and_endings_are_refused(tmp_path: Path) -> None:
    design = replace(make_design(), labels=LABELS)
    assert picture_names(design)[0] == "trajectories"
    with pytest.raises(MjfimError, match="a object has no figures"):
        picture_names(object())  # type: ignore[arg-type]
    with pytest.raises(MjfimError, match=r"picture of a Design .*valid: accuracy, "):
        draw(design, "portrait")
    with pytest.raises(MjfimError, match=r"trajectorys.*did you mean 'trajectories'"):
        design.plot("trajectorys")
    with pytest.raises(MjfimError, match=r"valid: .png, .svg, .pdf"):
        draw(design, "convergence", tmp_path / "x.gif")
    draw(design, "convergence", tmp_path / "x.svg")
    assert [path.name for path in tmp_path.iterdir()] == ["x.svg"]


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (format_number(0.87398), "0.874"),
        (format_number(-4.1e-5), "−4.10×10⁻⁵"),
        (format_number(999.9), "1000"),
        (format_number(-np.inf), "−∞"),
        (format_number(np.nan), "–"),
        (quotient_unit("rad/s", "kg m²"), "(rad/s)/(kg m²)"),
        (quotient_unit("", "kg"), "1/kg"),
        (squared_unit("N m"), "(N m)²"),
        (format_with_uncertainty(0.99412, 0.0123), "0.994 ± 0.012"),
        (format_with_uncertainty(1e-7, 1e-9), "1.000×10⁻⁷ ± 1.0×10⁻⁹"),
        (without_zeros("0.05000"), "0.05"),
    ],
)
def test_numbers_have_three_digits_and_raised_powers(shown: str, text: str) -> None:
    assert shown == text


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.9, 1.5, [0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5]), (0.8, 1500.0, [1.0, 10.0, 100.0, 1000.0])],
)
def test_logarithmic_axes_have_round_ticks(low: float, high: float, expected: list[float]) -> None:
    assert log_ticks(low, high) == pytest.approx(expected)


# ---- style and files

# Settings that a `matplotlibrc` may hold and that would be seen in every figure.
OTHER_SETTINGS = {
    "font.size": 20.0,
    "font.family": "monospace",
    "axes.facecolor": "black",
    "lines.linewidth": 8.0,
    "savefig.facecolor": "red",
    "axes.unicode_minus": False,
    "savefig.bbox": "tight",
}


@pytest.mark.slow
def test_settings_of_the_user_change_no_figure_and_stay(tmp_path: Path) -> None:
    picture = convergence(make_design())
    save(picture, tmp_path / "plain.png")
    with mpl.rc_context(OTHER_SETTINGS):
        save(figure_of(picture), tmp_path / "other.png")
        assert mpl.rcParams["font.size"] == 20.0
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "other.png").read_bytes()
