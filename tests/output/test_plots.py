"""Figures of hand-made records: units, legends, trajectories, unusual sizes, failed trials,
singular information.
"""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import StepPatch
from matplotlib.text import Text

from mjfim.arrays import Array
from mjfim.errors import MjfimError
from mjfim.model.coordinates import QUATERNION
from mjfim.output import plots
from mjfim.output.plots.limit_usage import joint_colours
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    INITIAL_COLOUR,
    format_number,
    format_with_uncertainty,
    quotient_unit,
    squared_unit,
)
from mjfim.output.positions import rotation_vectors
from mjfim.records.design import Evaluation, LimitUsage
from mjfim.records.labels import Labels
from tests.support.made_records import make_design, make_estimate, make_labels, make_study
from tests.support.paths import ROOT

# Numbers of joints and of parameters of the records that are drawn.
SIZES = [
    (1, 1),
    pytest.param(3, 5, marks=pytest.mark.slow),
    pytest.param(14, 30, marks=pytest.mark.slow),
    pytest.param(1, 70, marks=pytest.mark.slow),
]


def all_text(figure: Figure) -> str:
    """Return all text in a figure."""
    return "\n".join(t.get_text() for t in figure.findobj(Text) if isinstance(t, Text))


def all_colours(figure: Figure) -> set[str]:
    """Return the colours of lines, patches and texts inside the axes."""
    colours = set()
    for axes in figure.axes:
        colours |= {to_hex(line.get_color()) for line in axes.get_lines()}
        colours |= {to_hex(patch.get_facecolor()) for patch in axes.patches}
        colours |= {to_hex(patch.get_edgecolor()) for patch in axes.patches}
        colours |= {to_hex(text.get_color()) for text in axes.texts}
    return colours


def render(figure: Figure, folder: Path) -> Array:
    """Save a figure, load it again, and return its pixels."""
    path = plots.save(figure, folder / "figure.png", dpi=50.0)
    pixels = np.asarray(matplotlib.image.imread(path), dtype=np.float64)
    assert pixels.std() > 0.01
    return pixels


Draw = Callable[[int, int], Figure]

FIGURES: dict[str, Draw] = {
    "trajectories": lambda n, p: plots.trajectories(make_design(n, p), make_labels(n, p)),
    "sensitivity_phase": lambda n, p: plots.sensitivity_phase(make_design(n, p), make_labels(n, p)),
    "histogram": lambda n, p: plots.histogram(make_study(p), p - 1, make_labels(n, p)),
    "convergence": lambda n, p: plots.convergence(make_design(n, p)),
    "std_bars": lambda n, p: plots.std_bars(make_design(n, p), make_labels(n, p)),
    "fit": lambda n, p: plots.fit(make_estimate(n, p), 0, make_labels(n, p), np.full(n, 0.05)),
    "parameter_intervals": lambda n, p: plots.parameter_intervals(
        make_estimate(n, p), make_labels(n, p)
    ),
}


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.parametrize(("dofs", "count"), SIZES)
def test_figure_has_units_legend_and_pixels(
    name: str, dofs: int, count: int, tmp_path: Path
) -> None:
    figure = FIGURES[name](dofs, count)
    for axes in figure.axes:
        titles = [axes.get_title(loc) for loc in ("left", "center", "right")]
        words = [*titles, axes.get_xlabel(), axes.get_ylabel()]
        rows = [label.get_text() for label in axes.get_yticklabels()]
        assert any(re.search(r"\[.+\]", word, re.DOTALL) for word in (*words, *rows)), words
    assert len(figure.legends) == 1 and figure.legends[0].get_texts()
    render(figure, tmp_path)


@pytest.mark.parametrize("name", [n for n in FIGURES if n not in ("fit", "parameter_intervals")])
def test_both_trajectories_are_drawn_in_their_colours(name: str) -> None:
    assert {INITIAL_COLOUR, DESIGNED_COLOUR} <= all_colours(FIGURES[name](2, 3))


@pytest.mark.parametrize("name", FIGURES)
def test_artists_stay_inside_the_figure(name: str) -> None:
    figure = FIGURES[name](2, 3)
    figure.canvas.draw()
    box = figure.get_tightbbox()
    assert box.x0 >= -0.01 and box.y0 >= -0.01
    assert box.x1 <= figure.get_figwidth() + 0.01 and box.y1 <= figure.get_figheight() + 0.01


def test_trajectories_show_the_final_information() -> None:
    text = all_text(plots.trajectories(make_design(), make_labels(2, 3)))
    assert format_number(1.0) in text and format_number(0.1) in text


def test_trajectories_with_more_positions_than_velocities_are_drawn() -> None:
    design = make_design(6, 3)

    def free(e: Evaluation) -> Evaluation:
        quaternion = np.hstack([e.trajectory.qpos, np.ones((51, 1))])
        return dataclasses.replace(e, trajectory=dataclasses.replace(e.trajectory, qpos=quaternion))

    design = dataclasses.replace(design, initial=free(design.initial), final=free(design.final))
    labels = dataclasses.replace(make_labels(6, 3), qpos=tuple(f"q{i} [1]" for i in range(7)))
    assert len(plots.trajectories(design, labels).axes) == 7 + 6 + 1 + 1

    # Where the labels name a quaternion, its rotation vector is drawn.
    named = tuple(f"q{i}.{part} [1]" for i, part in enumerate(("x", "y", "z", *QUATERNION)))
    labels = dataclasses.replace(labels, qpos=named)
    assert len(plots.trajectories(design, labels).axes) == 6 + 6 + 1 + 1
    assert plots.sensitivity_phase(design, labels).axes


def test_phase_plots_are_limited_in_number_and_say_so() -> None:
    figure = plots.sensitivity_phase(make_design(14, 30), make_labels(14, 30))
    assert len(figure.axes) == 6
    assert "6 of 420 pairs" in " ".join(all_text(figure).split())
    for axes in figure.axes:
        for ticks, ends in (
            (axes.get_xticks(), axes.get_xlim()),
            (axes.get_yticks(), axes.get_ylim()),
        ):
            assert sum(ends[0] <= tick <= ends[1] for tick in ticks) <= 4


def test_phase_plots_do_not_draw_rounding_errors() -> None:
    """A sensitivity far below the largest one has no panel."""
    design = make_design(2, 3)
    evaluations = {}
    for key in ("initial", "final"):
        psi = getattr(design, key).sensitivity.copy()
        psi[:, [0, 2], 1] *= 1e-9
        evaluations[key] = dataclasses.replace(getattr(design, key), sensitivity=psi)

    assert len(plots.sensitivity_phase(design, make_labels(2, 3)).axes) == 6
    figure = plots.sensitivity_phase(dataclasses.replace(design, **evaluations), make_labels(2, 3))
    assert len(figure.axes) == 5


def test_the_units_of_a_figure_do_not_choose_its_phase_plots() -> None:
    """A joint in other units has other sensitivities and other speeds."""
    design = make_design(3, 4)
    evaluations = {}
    for key in ("initial", "final"):
        evaluation = getattr(design, key)
        psi, qvel = evaluation.sensitivity.copy(), evaluation.trajectory.qvel.copy()
        psi[:, [1, 4]] *= 1e3
        qvel[:, 1] *= 1e3
        trajectory = dataclasses.replace(evaluation.trajectory, qvel=qvel)
        evaluations[key] = dataclasses.replace(evaluation, sensitivity=psi, trajectory=trajectory)

    other = dataclasses.replace(design, **evaluations)
    labels = make_labels(3, 4)
    names = [
        [axes.get_xlabel().partition("\n")[0] for axes in plots.sensitivity_phase(d, labels).axes]
        for d in (design, other)
    ]
    assert names[0] == names[1]


def test_rotation_vectors_have_no_jumps() -> None:
    """Three turns about an oblique axis are one straight line."""
    angle = np.linspace(0.0, 6.0 * np.pi, 400)
    axis = np.array([1.0, -2.0, 2.0]) / 3.0
    turned = np.column_stack([np.cos(angle / 2.0), np.sin(angle / 2.0)[:, None] * axis])
    flipped = turned * np.where(np.arange(400) % 2, 1.0, -1.0)[:, None]
    np.testing.assert_allclose(rotation_vectors(flipped), angle[:, None] * axis, atol=1e-6)


def test_histogram_reports_failed_trials_and_efficiency() -> None:
    text = all_text(plots.histogram(make_study(3, failed=7), 0, make_labels(2, 3)))
    assert "200 trials, 7 failed" in text
    assert "efficiency 1.00, 95 % interval [0.800, 1.20]" in text


def test_histogram_is_a_density() -> None:
    figure = plots.histogram(make_study(), 0, make_labels(2, 3))
    for axes in figure.axes[:2]:
        bars = axes.patches[0]
        assert isinstance(bars, StepPatch)
        heights, edges, _ = bars.get_data()
        assert np.sum(heights * np.diff(edges)) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("survivors", [0, 1])
@pytest.mark.slow
def test_histogram_is_drawn_when_nearly_all_trials_fail(survivors: int, tmp_path: Path) -> None:
    study = make_study(2, failed=200 - survivors)
    render(plots.histogram(study, 1, make_labels(2, 2)), tmp_path)


def test_histogram_ignores_outliers_in_its_range() -> None:
    study = make_study()
    estimates = study.sets["initial"].estimates.copy()
    estimates[10, 0] = 1e6
    sets = {
        **study.sets,
        "initial": dataclasses.replace(study.sets["initial"], estimates=estimates),
    }
    figure = plots.histogram(dataclasses.replace(study, sets=sets), 0, make_labels(2, 3))
    assert figure.axes[0].get_xlim()[1] < 10.0
    assert "1 outside this range" in all_text(figure)


def test_histogram_without_a_finite_bound(tmp_path: Path) -> None:
    study = make_study()
    endless = dataclasses.replace(
        study.sets["initial"], crlb=np.full((3, 3), np.inf), efficiency=np.full(3, np.nan)
    )
    figure = plots.histogram(
        dataclasses.replace(study, sets={**study.sets, "initial": endless}), 0, make_labels(2, 3)
    )
    assert "bound ∞" in all_text(figure)
    render(figure, tmp_path)


def test_study_of_one_trajectory_is_drawn(tmp_path: Path) -> None:
    study = make_study()
    alone = dataclasses.replace(study, sets={"final": study.sets["final"]})
    render(plots.histogram(alone, 0, make_labels(2, 3)), tmp_path)


@pytest.mark.parametrize("everything", [False, True])
def test_bars_of_singular_information_are_drawn(everything: bool, tmp_path: Path) -> None:
    design = make_design()
    std = np.full(3, np.inf) if everything else np.array([np.inf, 0.1, 0.1])
    design = dataclasses.replace(design, initial=dataclasses.replace(design.initial, std=std))
    if everything:
        design = dataclasses.replace(design, final=dataclasses.replace(design.final, std=std))
    bars = plots.std_bars(design, make_labels(2, 3))
    assert "∞" in all_text(bars)
    render(bars, tmp_path)


def test_zero_parameter_has_no_relative_accuracy(tmp_path: Path) -> None:
    design = dataclasses.replace(make_design(), theta=np.array([0.0, 1.0, 2.0]))
    render(plots.std_bars(design, make_labels(2, 3)), tmp_path)
    estimate = dataclasses.replace(make_estimate(), initial_theta=np.array([0.0, 1.0, 2.0]))
    figure = plots.parameter_intervals(estimate, make_labels(2, 3))
    assert "nominal value of 0" in all_text(figure)
    render(figure, tmp_path)


@pytest.mark.slow
def test_convergence_of_empty_short_and_negative_histories(tmp_path: Path) -> None:
    design = make_design()
    negative = tuple(dataclasses.replace(row, cost=-1.0, slope=0.0) for row in design.history)
    for history in ((), design.history[:1], negative):
        render(plots.convergence(dataclasses.replace(design, history=history)), tmp_path)


def test_the_first_iterate_is_called_initial_only_where_it_is() -> None:
    """A search from another start than the initial control names that start."""
    design = dataclasses.replace(make_design(), found_by="multisine 4 of 9")
    first = design.history[0]

    for cost, label in ((design.initial.cost, "initial"), (7e7, "start: multisine 4 of 9")):
        history = (dataclasses.replace(first, cost=cost), *design.history[1:])
        figure = plots.convergence(dataclasses.replace(design, history=history))
        texts = [text.get_text() for legend in figure.legends for text in legend.get_texts()]
        assert label in texts


def test_convergence_of_one_iterate_on_two_levels(tmp_path: Path) -> None:
    """A search that is stopped early has no range of iterations."""
    design = make_design()
    history = (design.history[0], design.history[0])
    render(plots.convergence(dataclasses.replace(design, history=history)), tmp_path)


def test_convergence_is_logarithmic() -> None:
    assert [axes.get_yscale() for axes in plots.convergence(make_design()).axes] == ["log"] * 3


def test_fit_draws_data_residuals_and_band() -> None:
    estimate = make_estimate()
    figure = plots.fit(estimate, 0, make_labels(2, 3), [0.05, 0.05])
    left, right = figure.axes[:2]
    np.testing.assert_array_equal(left.get_lines()[0].get_ydata(), estimate.recordings[0].y[:, 0])
    np.testing.assert_array_equal(left.get_lines()[1].get_ydata(), estimate.predicted[0][:, 0])
    assert right.patches[0].get_extents().height > 0.0
    assert "±2σ" in all_text(figure)


@pytest.mark.slow
def test_fit_without_measurements_of_an_output(tmp_path: Path) -> None:
    estimate = make_estimate()
    y = estimate.recordings[0].y.copy()
    y[:, 1] = np.nan
    estimate = dataclasses.replace(
        estimate, recordings=(dataclasses.replace(estimate.recordings[0], y=y),)
    )
    figure = plots.fit(estimate, 0, make_labels(2, 3), [0.05, 0.05])
    assert "not measured" in all_text(figure)
    render(figure, tmp_path)


def test_unnamed_output_shows_its_column() -> None:
    labels = dataclasses.replace(make_labels(2, 3), outputs={})
    assert "qpos:joint_0 [model unit]" in all_text(
        plots.fit(make_estimate(), 0, labels, [0.05, 0.05])
    )


def test_intervals_flag_bounds_and_misfit() -> None:
    text = all_text(
        plots.parameter_intervals(make_estimate(misfit=True), make_labels(2, 3))
    ).replace("\n", " ")
    assert text.count("N m s/rad   (at its bound)") == 1
    assert "kg   (at its bound)" not in text
    assert "no interval covers the bias of a wrong model" in text


def test_intervals_with_infinite_std(tmp_path: Path) -> None:
    for std in ([np.inf, 0.1, 0.1], [np.inf] * 3):
        figure = plots.parameter_intervals(
            dataclasses.replace(make_estimate(), std=np.array(std)), make_labels(2, 3)
        )
        assert "± ∞" in all_text(figure)
        render(figure, tmp_path)


@pytest.mark.parametrize(
    "misuse",
    [
        lambda: plots.trajectories(make_design(3, 3), make_labels(2, 3)),
        lambda: plots.std_bars(make_design(2, 3), make_labels(2, 4)),
        lambda: plots.histogram(make_study(), 3, make_labels(2, 3)),
        lambda: plots.fit(make_estimate(), 1, make_labels(2, 3), [0.05, 0.05]),
        lambda: plots.fit(make_estimate(), 0, make_labels(2, 3), [0.05]),
        lambda: plots.save(Figure(), "figure.jpg"),
        lambda: Labels(qpos=(), positions=(), velocities=(), controls=(), parameters=("m",)),
    ],
)
def test_misuse_raises_an_error(misuse: Callable[[], object]) -> None:
    with pytest.raises(MjfimError):
        misuse()


def test_save_writes_a_png_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = plots.save(plots.convergence(make_design()), tmp_path / "convergence.png")
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert [p.name for p in tmp_path.iterdir()] == ["convergence.png"]


def test_failed_save_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "figure.png"
    path.write_bytes(b"old")

    def print_half(_: FigureCanvasAgg, name: Path) -> None:
        """Write a part of the file before the disk is full."""
        Path(name).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(FigureCanvasAgg, "print_png", print_half)
    with pytest.raises(OSError, match="disk full"):
        plots.save(Figure(), path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["figure.png"]


def test_pyplot_is_never_imported() -> None:
    code = (
        "import sys; from mjfim.output.plots import *; sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_only_the_plot_modules_import_matplotlib() -> None:
    own = Path(plots.__file__).parent
    others = [p for p in own.parent.rglob("*.py") if own not in p.parents]
    assert others
    assert [
        p.name
        for p in others
        if re.search(r"^\s*(import|from) matplotlib", p.read_text(), re.MULTILINE)
    ] == []


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
def test_number_has_three_digits_and_raised_powers(value: float, text: str) -> None:
    assert format_number(value) == text


def test_units_of_quotients_and_variances() -> None:
    assert quotient_unit("m", "kg") == "m/kg"
    assert quotient_unit("rad/s", "N m s/rad") == "(rad/s)/(N m s/rad)"
    assert quotient_unit("m", "") == "m"
    assert (
        squared_unit("kg") == "kg²" and squared_unit("N m") == "(N m)²" and squared_unit("") == ""
    )


def test_value_is_rounded_to_its_uncertainty() -> None:
    assert format_with_uncertainty(0.99412, 0.0121) == "0.994 ± 0.012"
    assert format_with_uncertainty(1.0, np.inf) == "1.000 ± ∞"


# ---- settings of the user


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


def test_settings_of_the_user_change_no_figure_and_stay(tmp_path: Path) -> None:
    """A `matplotlibrc` in the current folder sets them where Python imports matplotlib."""
    design = make_design()
    plots.save(plots.std_bars(design, make_labels(2, 3)), tmp_path / "plain.png")

    with matplotlib.rc_context(OTHER_SETTINGS):
        plots.save(plots.std_bars(design, make_labels(2, 3)), tmp_path / "other.png")
        assert {key: matplotlib.rcParams[key] for key in ("font.size", "axes.facecolor")} == {
            "font.size": 20.0,
            "axes.facecolor": "black",
        }

    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "other.png").read_bytes()


@pytest.mark.parametrize("name", plots.__all__)
def test_every_plotting_function_draws_in_its_own_style(name: str) -> None:
    assert "own_style" in getattr(plots, name).__code__.co_qualname


@pytest.mark.slow
def test_a_matplotlibrc_of_the_current_folder_changes_no_figure(tmp_path: Path) -> None:
    """In Python, without the command line, matplotlib reads this file when it is imported."""
    settings = "font.size: 20\naxes.facecolor: black\nsavefig.facecolor: red\n"
    script = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "from mjfim.output import plots\n"
        "from tests.support.made_records import make_design\n"
        "plots.save(plots.convergence(make_design()), 'figure.png')\n"
    )

    pictures = []
    for name, text in (("plain", ""), ("other", settings)):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "matplotlibrc").write_text(text, encoding="utf-8")
        subprocess.run([sys.executable, "-c", script, str(ROOT)], cwd=folder, check=True)
        pictures.append((folder / "figure.png").read_bytes())

    assert pictures[0] == pictures[1]


# ---- limits


def test_a_joint_has_one_colour_and_fast_curves_have_envelopes() -> None:
    t = np.linspace(0.0, 1.0, 1000)
    shares = {
        ("position", "a"): 0.5 * t,
        ("position", "b"): 0.999 * t,
        ("force", "b"): 0.3 * np.sin(1000.0 * t),
        ("force", "a"): 0.2 * np.sin(3.0 * t),
    }
    usage = tuple(
        LimitUsage(kind=kind, name=name, t=t, share=share) for (kind, name), share in shares.items()
    )
    limits = {"position": 0.02, "force": 0.7}
    design = dataclasses.replace(make_design(), usage=usage, limits=limits)
    labels = dataclasses.replace(make_labels(2, 3), positions=("a [rad]", "b [rad]"))
    figure = plots.limits(design, labels)

    colours = joint_colours(design)
    assert len(set(colours.values())) == 2
    position, force = figure.axes
    drawn = [to_hex(line.get_color()) for line in position.get_lines()]
    assert set(colours.values()) <= set(drawn)
    assert len(force.collections) == 1
    assert to_hex(force.collections[0].get_facecolor()[0]) == colours["b"]

    text = all_text(figure)
    assert "position: smallest margin 0.020 rad" in text
    assert "largest: b > 99 %, a 50 %" in text
