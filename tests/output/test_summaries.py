"""Summaries in the terminal, in Markdown and in figures agree."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output.rerun.text import design_text, estimate_text
from mjfim.output.rerun.text import render as render_markdown
from mjfim.output.summaries.accuracy import improvement, relative
from mjfim.output.summaries.check import describe_check
from mjfim.output.summaries.design import describe_design
from mjfim.output.summaries.estimate import describe_estimate
from mjfim.output.summaries.monte_carlo import describe_study
from mjfim.output.summaries.widths import shortened
from mjfim.output.summary_parts import Name, Quantity, Summary, capitalised
from mjfim.output.text import render
from mjfim.records.check import Roughness
from mjfim.records.design import CombinationAccuracy, Design
from mjfim.records.estimate import Estimate
from tests.support.paths import MODELS


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for 0.4 s."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    shorter = experiment.replace(horizon=0.4, descent={"max_iterations": 1})
    return DesignTask.resolve(shorter)


@pytest.fixture(scope="module")
def design(task: DesignTask) -> Design:
    """A design after one iteration."""
    return mjfim.design(task.experiment)


@pytest.fixture(scope="module")
def estimate(task: DesignTask, design: Design) -> Estimate:
    """An estimate from one recording."""
    return mjfim.identify(
        task.experiment, [mjfim.simulate(task.experiment, design.trajectory, seed=0)]
    )


def printed(summary: Summary, *, verbose: bool = False) -> str:
    """Text in a wide terminal without colours."""
    console = Console(width=200, no_color=True)
    with console.capture() as capture:
        console.print(render(summary, verbose=verbose))
    return capture.get()


def without_escapes(markdown: str) -> str:
    """Markdown without the marks that show a character as it is."""
    return re.sub(r"\\(\W|_)", r"\1", markdown)


def test_every_table_has_a_cell_for_every_column(
    task: DesignTask, design: Design, estimate: Estimate
) -> None:
    """Renderers rely on tables without missing cells."""
    study = mjfim.monte_carlo(task.experiment, {"final": design.trajectory}, trials=3)
    summaries = (
        describe_design(design, task.system.units),
        describe_estimate(estimate),
        describe_check(mjfim.check(task.experiment)),
        describe_study(study, task.system.units),
    )
    for summary in summaries:
        assert summary.tables
        for table in summary.tables:
            assert all(len(row.cells) == len(table.columns) for row in table.rows), table.title
            assert all(group.last < len(table.columns) for group in table.groups), table.title


def test_the_terminal_and_markdown_show_the_same_numbers(task: DesignTask, design: Design) -> None:
    """The Markdown also has the details."""
    summary = describe_design(design, task.system.units)
    terminal, markdown = printed(summary), design_text(design, task.system.units)
    table = summary.table("accuracy")
    for row in table.rows:
        for cell, column in zip(row.cells, table.columns, strict=True):
            assert str(cell) in markdown
            shown = [cell.name, cell.unit] if isinstance(cell, Name) else [str(cell)]
            assert column.detail or all(text in terminal for text in shown)
    assert "Eigenvalues of the Fisher information" in markdown
    assert "Eigenvalues of the Fisher information" not in terminal
    assert capitalised(design.outcome) in terminal


def test_an_estimate_names_units_bounds_and_warnings(estimate: Estimate) -> None:
    """Units, bounds and warnings are in the terminal and in the Markdown."""
    odd = replace(estimate, at_bound=("l",), misfit=True, warnings=("residuals are [odd]",))
    for text in (
        printed(describe_estimate(odd), verbose=True),
        without_escapes(estimate_text(odd, "see the report")),
    ):
        assert "N m s/rad" in text
        assert "at bound" in text
        assert "residuals are [odd]" in text
        assert "not explained by noise: the formal σ underestimates the errors" in text
    assert "at bound" not in printed(describe_estimate(estimate), verbose=True)


def test_inseparable_parameters_are_marked(task: DesignTask, design: Design) -> None:
    """The combination has a row, and nothing is divided by zero."""
    std = np.array([np.inf, 0.1, 0.1])
    combined = CombinationAccuracy(expression="m + 2 l", value=0.0, std_initial=0.4, std_final=0.1)
    blind = replace(
        design,
        initial=replace(design.initial, std=std),
        final=replace(design.final, std=std),
        combined=(combined,),
        combinations=("m and l only as m + 2 l",),
    )
    text = printed(describe_design(blind, task.system.units))
    assert "not alone" in text and "m + 2 l" in text and "÷ 4.0" in text


def test_improvements_in_words() -> None:
    """A standard deviation may become smaller, larger, or be undefined."""
    assert improvement(2.0, 0.5) == "÷ 4.0"
    assert improvement(0.5, 2.0) == "× 4.0"
    assert improvement(np.inf, 2.0) == improvement(1.0, 0.0) == "-"


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.00123, "0.12 %"), (0.994, "99 %"), (0.998, "99.8 %"), (0.9996, "100 %"), (6.32, "632 %")],
)
def test_shares_near_the_whole_are_no_powers_of_ten(share: float, text: str) -> None:
    assert str(relative(share, 1.0)) == text


def test_disagreements_of_some_hundred_percent_are_no_powers_of_ten() -> None:
    rough = Roughness(error=1.98, parameter="m", sample=3, time=0.1, causes=())
    assert "disagree by 200 % for m" in str(rough)
    assert "disagree by 2.6 % for m" in str(replace(rough, error=0.0257))


def test_cells_in_words() -> None:
    """Units are in brackets; NaN and infinity have words."""
    assert str(Name(name="m", unit="kg")) == "m (kg)" and str(Name(name="ratio")) == "ratio"
    assert str(Quantity(value=0.12345, digits=2, suffix=" %")) == "0.12 %"
    assert str(Quantity(value=np.nan)) == "-"
    assert str(Quantity(value=np.inf, infinite="not alone")) == "not alone"
    assert (str(Quantity(value=np.inf)), str(Quantity(value=-np.inf))) == ("∞", "-∞")


def test_bars_do_not_break_a_markdown_table(design: Design, task: DesignTask) -> None:
    """A vertical bar in a name is escaped."""
    odd = replace(design, parameters=("a|b", *design.parameters[1:]))
    assert r"a\|b (kg)" in render_markdown(describe_design(odd, task.system.units))


def test_long_paths_keep_their_end() -> None:
    """The end of a path distinguishes files."""
    assert shortened("logs/monday/run_1.csv", 20) == "run_1.csv"
    assert shortened("x" * 30 + "_7.csv", 10) == "…xxx_7.csv"
