"""Pictures as data show what the records hold; matplotlib draws them in one style."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from mjfim.errors import MjfimError
from mjfim.files import replacing
from mjfim.output import plots, words
from mjfim.output.archive import rotation_vectors
from mjfim.output.panels import Mark, Panel, Picture, range_of_intervals
from mjfim.output.plots.design import (
    convergence,
    limits,
    sensitivity_phase,
    standard_deviations,
    trajectories,
)
from mjfim.output.plots.draw import figure_of, log_ticks, plain_number, save
from mjfim.output.plots.estimate import fit, parameter_intervals
from mjfim.output.plots.estimate_studies import pairs, selection
from mjfim.output.plots.pictures import draw, picture_names
from mjfim.output.plots.studies import check, histogram
from mjfim.records.design import CombinationAccuracy, Design, LimitUsage
from mjfim.records.estimate import Estimate
from mjfim.records.terms import Decision, Selection, SelectionStep
from tests.support import results
from tests.support.made_records import (
    make_design,
    make_estimate,
    make_labels,
    make_row,
    make_study,
)
from tests.support.paths import ROOT

LABELS = make_labels(2, 3)


def marks_of(panel: Panel, role: str, kind: str = "line") -> list[Mark]:
    """Marks of a role and a kind in a panel."""
    return [mark for mark in panel.marks if mark.role == role and mark.kind == kind]


def panel_named(picture: Picture, beginning: str) -> Panel:
    """The panel whose title begins with a text."""
    return next(panel for panel in picture.panels if panel.title.startswith(beginning))


# ---- designs


def test_trajectories_show_both_motions_and_their_information() -> None:
    design = make_design()
    picture = trajectories(design, LABELS)
    joint = panel_named(picture, "joint_0 [rad]")
    for role, evaluation in (("initial", design.initial), ("designed", design.final)):
        (curve,) = marks_of(joint, role)
        np.testing.assert_array_equal(curve.y, evaluation.trajectory.qpos[:, 0])
    (root,) = marks_of(picture.panels[-1], "designed")
    np.testing.assert_allclose(root.y**2, design.final.min_eigenvalue)
    assert [panel for panel in picture.panels if panel.is_shaded]
    assert [key.label for key in picture.legend()] == ["initial", "designed"]


def test_rotation_vectors_have_no_jumps() -> None:
    """Three turns about an oblique axis are one straight line."""
    angle = np.linspace(0.0, 6.0 * np.pi, 400)
    axis = np.array([1.0, -2.0, 2.0]) / 3.0
    turned = np.column_stack([np.cos(angle / 2.0), np.sin(angle / 2.0)[:, None] * axis])
    flipped = turned * np.where(np.arange(400) % 2, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(rotation_vectors(flipped), angle[:, None] * axis, atol=1e-6)


def test_phase_plots_are_limited_in_number_and_say_so() -> None:
    picture = sensitivity_phase(make_design(2, 9), make_labels(2, 9))
    assert len(picture.panels) == 6
    assert "Shown: 6 of 9 parameters" in picture.note


def test_convergence_shows_begin_end_and_stages() -> None:
    design = make_design()
    picture = convergence(design)
    assert all(panel.y.log for panel in picture.panels)
    cost = picture.panels[0]
    np.testing.assert_array_equal(cost.marks[0].y, [row.cost for row in design.history])
    assert "start: " in picture.legend()[0].label

    same = dataclasses.replace(
        design, initial=dataclasses.replace(design.initial, cost=design.history[0].cost)
    )
    assert convergence(same).legend()[0].label == "initial"

    rows = tuple(
        dataclasses.replace(row, rate=10.0 + k // 5) for k, row in enumerate(design.history)
    )
    staged = convergence(dataclasses.replace(design, history=rows))
    assert len(marks_of(staged.panels[0], "band", "vline")) == 1
    assert "grid becomes finer" in staged.note


@pytest.mark.parametrize("costs", [(), (1.0,), (-1.0, -2.0), (np.nan, np.nan)])
def test_convergence_of_any_history_is_drawn(costs: tuple[float, ...], tmp_path: Path) -> None:
    rows = tuple(make_row(iteration=k, cost=cost) for k, cost in enumerate(costs))
    picture = convergence(dataclasses.replace(make_design(), history=rows))
    save(picture, tmp_path / "x.png", 30.0)


@pytest.mark.parametrize("everything", [True, False])
def test_unknown_standard_deviations_are_hatched_to_the_end(*, everything: bool) -> None:
    design = make_design()
    std = np.full(3, np.inf) if everything else np.array([np.inf, 1.0, 2.0])
    design = dataclasses.replace(design, final=dataclasses.replace(design.final, std=std))
    panel = standard_deviations(design, LABELS).panels[0]
    (hatched,) = (mark for mark in panel.marks if mark.hollow)
    assert panel.x.limits is not None
    np.testing.assert_allclose(hatched.x, panel.x.limits[1])
    assert len(hatched.x) == (3 if everything else 1)


# ---- limits


def limited(amplitudes: dict[str, float], speed: float, kind: str = "force") -> Design:
    """A design with a limit of one kind on several joints."""
    t = np.linspace(0.0, 1.0, 1000)
    usage = tuple(
        LimitUsage(kind=kind, name=name, t=t, share=size * np.sin(speed * t))
        for name, size in amplitudes.items()
    )
    return dataclasses.replace(make_design(), usage=usage, limits={kind: 0.1})


def test_fast_curves_have_envelopes_and_many_of_them_rows() -> None:
    few = limits(limited({"a": 0.9, "b": 0.5}, 2000.0), LABELS).panels[0]
    assert [mark.role for mark in few.marks if mark.kind == "area"] == ["series0", "series1"]
    assert few.y.limits == (-112.0, 112.0)
    many = limits(limited(dict.fromkeys("abcd", 0.9), 2000.0), LABELS).panels[0]
    assert many.y.names == list("abcd")
    (slow,) = marks_of(limits(limited({"a": 0.9}, 3.0), LABELS).panels[0], "series0")
    assert slow.y.max() == pytest.approx(90.0, abs=0.1)


@pytest.mark.parametrize(
    ("kind", "title"),
    [
        ("force", "force: smallest margin 0.10 N m"),
        ("velocity", "velocity: smallest margin 0.10 rad/s"),
        ("clearance", "clearance: smallest margin 0.10 m"),
    ],
)
def test_margins_of_limits_have_units(kind: str, title: str) -> None:
    name = "torque" if kind == "force" else "joint_0"
    assert limits(limited({name: 0.9}, 3.0, kind), LABELS).panels[0].title == title


def test_violated_limits_are_red_and_say_so() -> None:
    design = dataclasses.replace(limited({"a": 1.2}, 3.0), limits={"force": -0.2})
    panel = limits(design, LABELS).panels[0]
    assert panel.role == "designed"
    assert "VIOLATED by 0.20" in panel.title
    assert panel.y.limits is not None
    assert panel.y.limits[1] > 120.0


# ---- estimates


def fitted(**changes: Any) -> Estimate:
    """An estimate whose outputs have a noise of 0.05."""
    made = make_estimate()
    sigma = dict.fromkeys(made.recordings[0].outputs, 0.05)
    return dataclasses.replace(made, sigma=sigma, **changes)


def test_a_fit_shows_data_residuals_and_band() -> None:
    estimate = fitted()
    picture = fit(estimate, 0, LABELS)
    curves, errors = picture.panels[:2]
    (measured,) = marks_of(curves, "measured", "dots")
    np.testing.assert_array_equal(measured.y, estimate.recordings[0].y[:, 0])
    (residual,) = marks_of(errors, "measured", "dots")
    np.testing.assert_allclose(residual.y, measured.y - estimate.predicted[0][:, 0])
    (band,) = marks_of(errors, "band", "hspan")
    sigma = estimate.sigma[estimate.recordings[0].outputs[0]]
    assert (band.y[0], band.other) == (-2.0 * sigma, np.array([2.0 * sigma]))
    assert re.match(r"residual: rms / σ = \d\.\d\d", errors.title)


def test_an_output_that_was_not_measured_says_so(tmp_path: Path) -> None:
    estimate = fitted()
    recording = estimate.recordings[0]
    y = recording.y.copy()
    y[:, 0] = np.nan
    gone = dataclasses.replace(estimate, recordings=(dataclasses.replace(recording, y=y),))
    picture = fit(gone, 0, LABELS)
    assert picture.panels[1].message == "not measured"
    save(picture, tmp_path / "x.png", 30.0)


def test_a_nominal_model_far_away_does_not_flatten_the_curves() -> None:
    estimate = fitted()
    ranges = []
    for factor in (1.2, 50.0):
        nominal = (factor * estimate.predicted[0],)
        found = fit(dataclasses.replace(estimate, nominal=nominal), 0, LABELS).panels[0].y.limits
        assert found is not None
        ranges.append(found[1] - found[0])
    assert ranges[1] < 2.5 * ranges[0]


def test_intervals_mark_bounds_and_misfit() -> None:
    estimate = make_estimate(misfit=True)
    picture = parameter_intervals(estimate, LABELS)
    (at_bound,) = (mark for mark in picture.panels[0].marks if mark.hollow)
    assert at_bound.label == "at its bound"
    assert "bias of a wrong model" in picture.note
    free = dataclasses.replace(estimate, at_bound=())
    assert "at its bound" not in [key.label for key in parameter_intervals(free, LABELS).legend()]


def test_an_unknown_parameter_is_drawn(tmp_path: Path) -> None:
    estimate = make_estimate()
    interval = estimate.interval.copy()
    interval[0] = -np.inf, np.inf
    std = np.append(np.inf, estimate.std[1:])
    picture = parameter_intervals(dataclasses.replace(estimate, std=std, interval=interval), LABELS)
    save(picture, tmp_path / "x.png", 30.0)


def test_few_wide_or_distant_intervals_do_not_widen_the_range() -> None:
    centre = np.array([0.0, 1.0, 2.0, 1e6, 1.0])
    half = np.array([1.0, 1.0, 1.0, 1.0, 500.0])
    low, high = range_of_intervals(centre, centre - half, centre + half)
    assert -4.0 < low < -1.0
    assert 3.0 < high < 6.0


@pytest.mark.parametrize(("count", "is_named"), [(3, True), (30, False)])
def test_terms_that_were_tried_have_names_unless_there_are_many(
    count: int, *, is_named: bool
) -> None:
    """A term that predicts far worse than all others is an arrow at the right end."""
    tried = [
        SelectionStep(decision=Decision.REJECTED, description=f"term {i}", error=1.5 + i)
        for i in range(count)
    ]
    begun = SelectionStep(decision=Decision.BEGUN, error=2.0)
    added = SelectionStep(decision=Decision.ADDED, description="friction", count=1, error=1.0)
    no_better = SelectionStep(decision=Decision.UNHELPFUL, description="a spring", error=np.nan)
    found = Selection(terms=(), steps=(begun, *tried, no_better, added), ending="")
    panel = selection(dataclasses.replace(make_estimate(), selection=found)).panels[0]
    middle = [f"term {i}" for i in range(count)] if is_named else []
    assert panel.y.names == ["the stated model", *middle, "+ friction"]
    curve, crosses, arrows = panel.marks
    np.testing.assert_allclose(curve.x, [2.0, 1.0])
    assert (len(crosses.x), len(arrows.x)) == (2, count - 2)


# ---- Monte Carlo studies


def test_a_histogram_is_a_density_with_its_statistics() -> None:
    picture = histogram(make_study(3, failed=7), 0, LABELS)
    for panel in picture.panels[:2]:
        bars = panel.marks[0]
        assert np.sum(bars.y * np.diff(bars.x)) == pytest.approx(1.0, abs=0.02)
        assert "200 trials, 7 failed" in panel.remark
        assert "efficiency 1.00, 95 % interval [0.800, 1.20]" in panel.remark


@pytest.mark.parametrize("survivors", [0, 1])
def test_a_histogram_of_few_trials_is_drawn(survivors: int, tmp_path: Path) -> None:
    study = make_study(2, failed=200 - survivors)
    save(histogram(study, 1, make_labels(2, 2)), tmp_path / "x.png", 30.0)


def test_outliers_and_endless_bounds_do_not_widen_a_histogram() -> None:
    study = make_study()
    estimates = study.sets["initial"].estimates.copy()
    estimates[10, 0] = 1e6
    for changes, remark in (
        ({"estimates": estimates}, "1 outside this range"),
        ({"crlb": np.full((3, 3), np.inf)}, "bound ∞"),
    ):
        changed = dataclasses.replace(study.sets["initial"], **changes)
        sets = {**study.sets, "initial": changed}
        panel = histogram(dataclasses.replace(study, sets=sets), 0, LABELS).panels[0]
        assert panel.x.limits is not None
        assert panel.x.limits[1] < 10.0
        assert remark in panel.remark


# ---- checks


def test_parameters_that_are_not_known_alone_are_hatched_and_without_correlation() -> None:
    combined = (CombinationAccuracy(expression="a + b", value=1.0, std_initial=1.0, std_final=0.5),)
    made = results.check()
    rows = tuple(dataclasses.replace(row, std=np.inf, relative=np.inf) for row in made.rows[:2])
    correlation = np.full((3, 3), np.nan)
    correlation[2, 2] = 1.0
    found = dataclasses.replace(
        made, rows=(*rows, made.rows[2]), combined=combined, correlation=correlation
    )
    bars, heat = check(found).panels
    assert bars.y.names == [*found.wanted, "a + b"]
    (hatched,) = (mark for mark in bars.marks if mark.hollow)
    assert len(hatched.x) == 2
    assert heat.cells is not None
    assert heat.cells.values.shape == (3, 3)
    assert np.isnan(heat.cells.values[:2]).all()


# ---- names and words


def test_wrong_names_labels_and_endings_are_refused(tmp_path: Path) -> None:
    design = dataclasses.replace(make_design(), labels=LABELS)
    assert picture_names(design)[0] == "trajectories"
    with pytest.raises(MjfimError, match=r"picture of a Design .*valid: convergence, "):
        draw(design, "portrait")
    with pytest.raises(MjfimError, match=r"trajectorys.*did you mean 'trajectories'"):
        design.plot("trajectorys")
    with pytest.raises(MjfimError, match=r"labels.qpos has 5 entries, the data has 2"):
        draw(dataclasses.replace(design, labels=make_labels(5, 3)))
    with pytest.raises(MjfimError, match=r"valid: .png, .svg, .pdf"):
        draw(design, "convergence", tmp_path / "x.gif")
    draw(design, "convergence", tmp_path / "x.svg")
    assert [path.name for path in tmp_path.iterdir()] == ["x.svg"]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.87398, "0.874"),
        (16482.0, "1.65×10⁴"),
        (-4.1e-5, "−4.10×10⁻⁵"),
        (0.0, "0.00"),
        (999.9, "1000"),
        (np.inf, "∞"),
        (-np.inf, "−∞"),
        (np.nan, "–"),
    ],
)
def test_numbers_have_three_digits_and_raised_powers(value: float, text: str) -> None:
    assert words.format_number(value) == text


def test_units_uncertainties_and_ticks_are_short() -> None:
    assert words.quotient_unit("rad/s", "kg m²") == "(rad/s)/(kg m²)"
    assert words.quotient_unit("", "kg") == "1/kg"
    assert words.squared_unit("kg") == "kg²"
    assert words.squared_unit("N m") == "(N m)²"
    assert words.format_with_uncertainty(0.99412, 0.0123) == "0.994 ± 0.012"
    assert words.format_with_uncertainty(1e-7, 1e-9) == "1.000×10⁻⁷ ± 1.0×10⁻⁹"
    assert words.without_zeros("0.05000") == "0.05"
    assert [plain_number(value) for value in (0.01, 300.0, 1e5)] == ["0.01", "300", "10⁵"]


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


def test_a_failed_save_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "figure.png"
    with replacing(path) as temporary:
        temporary.write_bytes(b"old")

    def fail(*_: object) -> None:
        """Run out of space."""
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        save(Figure(), path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"]


@pytest.mark.slow
def test_pictures_need_no_matplotlib_and_figures_no_pyplot() -> None:
    code = (
        "import sys\n"
        "import mjfim.output.plots.pictures\n"
        "assert 'matplotlib' not in sys.modules\n"
        "import mjfim.output.plots.draw\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    package = Path(plots.__file__).parents[1]
    pattern = re.compile(r"^(import|from) matplotlib", re.MULTILINE)
    importers = [p.name for p in package.rglob("*.py") if pattern.search(p.read_text())]
    assert importers == ["draw.py"]


def test_a_fixed_parameter_is_in_no_pair() -> None:
    """A parameter at its guess without a standard deviation has no ellipse and warns of nothing."""
    covariance = np.diag([0.0, 1e-4, 4e-4])
    values = np.array([1.0, 2.0, 3.0])
    picture = pairs(
        ["a", "b", "c"],
        ["", "", ""],
        values,
        covariance,
        "estimate",
        guess=values,
        title="",
        note="",
    )
    assert len(picture.panels) == 3  # b, c, and both
