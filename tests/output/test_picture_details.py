"""Details of figures: shares of limits, percentages, ends of searches, ticks, few results."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from mjfim.output import plots, vocabulary
from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.plots.design import panel_columns
from mjfim.output.plots.style import log_ticks, plain_number, without_zeros
from mjfim.output.report.build import page_of
from mjfim.output.report.render import rendered
from mjfim.records import estimate as records_of_estimates
from mjfim.records.campaign import Campaign, CampaignStatus, Round
from mjfim.records.comparison import DESIGN
from mjfim.records.design import Design, LimitUsage
from mjfim.records.robustness import RobotConditions, Robustness
from tests.support.made_records import (
    make_comparison,
    make_design,
    make_estimate,
    make_labels,
    make_method_result,
)


def all_text(figure: Figure) -> str:
    """Return all text in a figure."""
    return "\n".join(t.get_text() for t in figure.findobj(Text) if isinstance(t, Text))


def names_of_rows(axes: Axes) -> list[str]:
    """Return the texts beside the rows of a panel."""
    return [label.get_text() for label in axes.get_yticklabels()]


# ---- designs


def made_limits(amplitudes: dict[str, float]) -> Design:
    """Make a design whose forces change faster than a curve can show."""
    t = np.linspace(0.0, 1.0, 1000)
    forces = tuple(
        LimitUsage(kind="force", name=name, t=t, share=amplitude * np.sin(1000.0 * t + i))
        for i, (name, amplitude) in enumerate(amplitudes.items())
    )
    position = LimitUsage(kind="position", name="joint_0", t=t[::2], share=0.5 * t[::2])
    limits = {"force": 0.05, "position": 0.5}
    return dataclasses.replace(make_design(), usage=(*forces, position), limits=limits)


def test_many_fast_forces_have_a_row_each() -> None:
    design = made_limits({"torque": 0.9, "b": 0.8, "c": 0.7})
    position, force = plots.limits(design, make_labels(2, 3)).axes
    assert names_of_rows(force) == ["torque", "b", "c"]
    assert len(force.collections) == 3
    assert position.get_xlim() == force.get_xlim()

    # A row begins at its own line, and its full height is the bound.
    tops = [path.get_extents().height for c in force.collections for path in c.get_paths()]
    np.testing.assert_allclose(np.array(tops) / tops[0], np.array([0.9, 0.8, 0.7]) / 0.9, rtol=0.01)


def test_few_fast_forces_stay_together() -> None:
    design = made_limits({"torque": 0.9, "b": 0.8})
    force = plots.limits(design, make_labels(2, 3)).axes[1]
    assert names_of_rows(force)[0].startswith("−")
    assert "Filled" in all_text(plots.limits(design, make_labels(2, 3)))


def test_margins_of_forces_have_units() -> None:
    design = made_limits({"torque": 0.9})
    assert "force: smallest margin 0.050 N m" in all_text(plots.limits(design, make_labels(2, 3)))


def test_a_random_search_at_the_end_is_marked_and_has_no_slope() -> None:
    design = make_design()
    rows = [dataclasses.replace(row, slope=np.nan) for row in design.history[-3:]]
    searched = dataclasses.replace(design, history=(*design.history[:-3], *rows))
    figure = plots.convergence(searched)
    cost, slope, eigenvalue = figure.axes
    assert cost.get_xlim() == slope.get_xlim() == eigenvalue.get_xlim()
    assert "random search" in all_text(figure)
    assert "random search" not in all_text(plots.convergence(design))

    # A search may go on by descents.
    middle = dataclasses.replace(design.history[4], slope=np.nan)
    both = (*design.history[:4], middle, *searched.history[5:])
    panel = plots.convergence(dataclasses.replace(design, history=both)).axes[1]
    shaded = [patch for patch in panel.patches if isinstance(patch, Rectangle)]
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in shaded]
    np.testing.assert_allclose(spans, [(3.5, 4.5), (6.5, panel.get_xlim()[1])])

    # The designed trajectory has a dot where it has a value.
    dots = [sum(line.get_marker() == "o" for line in axes.get_lines()) for axes in figure.axes]
    assert dots == [2, 1, 2]


@pytest.mark.parametrize(
    ("counts", "columns"), [((2, 1), 2), ((4, 4), 4), ((6, 6, 6), 3), ((7, 7, 7), 4), ((9, 8), 3)]
)
def test_panels_of_a_robot_leave_few_places_empty(counts: tuple[int, ...], columns: int) -> None:
    assert panel_columns(counts) == columns


def test_notes_explain_only_what_is_drawn() -> None:
    design = make_design()
    assert "blue box" in all_text(plots.sensitivity_phase(design, make_labels(2, 3)))
    same = dataclasses.replace(design, initial=design.final)
    assert "blue box" not in all_text(plots.sensitivity_phase(same, make_labels(2, 3)))


# ---- estimates


def test_an_estimate_far_from_its_guess_does_not_hide_the_others() -> None:
    made = make_estimate(2, 5)
    guess = made.theta * np.array([1.01, 1.01, 1.01, 1.01, 0.001])
    estimate = dataclasses.replace(made, initial_theta=guess)
    axes = plots.parameter_intervals(estimate, make_labels(2, 5)).axes[0]
    low, high = axes.get_xlim()
    assert high - low < 200.0


def test_the_legend_has_bounds_only_where_an_estimate_is_at_one() -> None:
    for at_bound in ((), ("link_0.damping",)):
        estimate = dataclasses.replace(make_estimate(), at_bound=at_bound)
        figure = plots.parameter_intervals(estimate, make_labels(2, 3))
        texts = [text.get_text() for text in figure.legends[0].get_texts()]
        assert ("at its bound" in texts) == bool(at_bound)


def test_values_of_a_pair_have_the_same_decimals() -> None:
    made = make_estimate()
    estimate = dataclasses.replace(
        made, theta=np.array([1.0, 1.0, -0.001]), covariance=np.diag([0.025, 0.025, 0.001]) ** 2
    )
    figure = plots.estimate_pairs(estimate, make_labels(2, 3))
    lowest = figure.axes[-1]
    lowest.set_xticks([-2.0, 2.0])
    assert [text.get_text() for text in lowest.get_xticklabels()] == ["−0.003", "0.001"]
    assert "link_2.damping" in lowest.get_xlabel()


def test_a_nominal_model_nearby_is_drawn_as_a_whole() -> None:
    made = make_estimate()
    size = float(np.abs(made.predicted[0][:, 0]).max())
    for factor, inside in ((1.5, True), (50.0, False)):
        estimate = dataclasses.replace(made, nominal=(factor * made.predicted[0],))
        axes = plots.fit(estimate, 0, make_labels(2, 3), [0.05, 0.05]).axes[0]
        assert (axes.get_ylim()[1] > factor * size) == inside


@pytest.mark.parametrize(
    ("rows", "trace", "reason"),
    [
        (10, 2, "more than 10 rows together"),
        (1000, 2, "its simulation diverges"),
        (1000, 0, "an earlier version of mjfim saved the estimate"),
    ],
)
def test_a_figure_says_why_it_has_no_nominal_model(
    rows: int, trace: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records_of_estimates, "MAX_NOMINAL_ROWS", rows)
    sigma = {"qpos:joint_0": 0.05, "qpos:joint_1": 0.05}
    estimate = dataclasses.replace(
        make_estimate(), trace=np.ones((trace, 3)), residual_rms=sigma, sigma=sigma
    )
    texts = all_text(plots.fit(estimate, 0, make_labels(2, 3), [0.05, 0.05]))
    assert reason in " ".join(texts.split())
    assert reason in rendered(page_of(estimate))

    # An estimate with a nominal model needs no reason.
    shown = dataclasses.replace(estimate, nominal=estimate.predicted)
    assert "is not drawn" not in all_text(plots.fit(shown, 0, make_labels(2, 3), [0.05, 0.05]))


# ---- studies


def test_robots_without_limits_have_no_panel_of_limits() -> None:
    runs, count = 4, 2
    result = Robustness(
        conditions=RobotConditions(),
        names=("a", "b"),
        units=("kg", "kg"),
        limits=(),
        wrong=np.full(count, 0.2),
        z=np.zeros((runs, count)),
        error=np.full((runs, count), 0.01),
        std=np.full((runs, count), 0.01),
        predicted=np.full(count, 0.01),
        joint=(runs, runs),
        margins=np.zeros((runs, 0)),
        planned=np.zeros(0),
        fit=1.0,
        misfits=0,
        restarted=0,
        troubles={},
    )
    figure = plots.robustness_figure(result)
    assert len(figure.axes) == 3

    # The note says "red: outside": dots that let the paper shine through would be orange.
    far = plots.robustness_figure(dataclasses.replace(result, z=np.full((runs, count), 3.0)))
    dots = [line for line in far.axes[0].get_lines() if line.get_marker() == "o"]
    red = [line for line in dots if line.get_color() == vocabulary.DESIGNED.colour]
    assert red and all((line.get_alpha() or 1.0) > 0.9 for line in red)
    assert "planned" not in all_text(figure)
    assert "states no limits" in all_text(figure)


def test_a_campaign_of_one_round_counts_in_whole_rounds() -> None:
    found = make_estimate()
    first = Round(
        number=1,
        theta=found.theta,
        predicted=0.03 * found.theta,
        control=np.zeros((2, 1)),
        recordings=found.recordings,
        estimate=found,
    )
    campaign = Campaign(
        parameters=found.parameters,
        wanted=0.01 * found.theta,
        rounds=(first,),
        status=CampaignStatus.EXHAUSTED,
    )
    parameters = CampaignParameters(
        names=found.parameters,
        units=("kg",) * 3,
        guess=found.initial_theta,
        interest=(0,),
        true=None,
    )
    figure = plots.campaign_figure(campaign, parameters)
    assert "1 round of design" in all_text(figure)
    assert figure.axes[0].get_xticks().tolist() == [1.0]


@pytest.mark.parametrize("limited", [False, True])
def test_a_comparison_shows_margins_or_the_cost(limited: bool) -> None:
    margins = {"control": 0.1} if limited else {}
    rows = (
        make_method_result(method, cost, margins=margins, relative_margins=margins)
        for method, cost in ((DESIGN, 1.25), ("chirp", 1.5))
    )
    comparison = make_comparison(*rows)
    text = all_text(plots.compare_figure(comparison))
    assert ("J 1.25" in text) != limited
    assert ("10 % control" in text) == limited

    # The verdict is the title.
    assert comparison.verdict[0].removesuffix(".")[:40] in text


# ---- ticks and numbers


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.8, 1.6, [0.8, 1.0, 1.2, 1.4, 1.6]),
        (0.9, 11.0, [1.0, 3.0, 10.0]),
        (0.05, 200.0, [0.1, 1.0, 10.0, 100.0]),
    ],
)
def test_logarithmic_axes_have_round_ticks(low: float, high: float, expected: list[float]) -> None:
    np.testing.assert_allclose(log_ticks(low, high), expected)


def test_numbers_of_ticks_and_guesses_are_short() -> None:
    assert plain_number(1e-7) == "10⁻⁷"
    assert plain_number(3e-7) == "3×10⁻⁷"
    assert without_zeros("0.05000") == "0.05"
    assert without_zeros("2000") == "2000"
    assert without_zeros("4.800×10⁻⁴") == "4.8×10⁻⁴"
