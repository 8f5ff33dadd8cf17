"""Summaries fit into terminals of 80 and 120 columns: nothing is cut, the short form is short."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from rich.cells import cell_len

from mjfim.output.condensed import condensed
from mjfim.output.presentation import describe
from mjfim.output.summary_parts import (
    Emphasis,
    Listing,
    Name,
    Paragraph,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.output.terminal_tables import fold
from mjfim.output.text import MAX_LINES, render
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check, ParameterCheck, SelfTest
from mjfim.records.comparison import Comparison
from mjfim.records.estimate import Estimate, Prediction, PredictionErrors
from mjfim.records.robustness import AssessedLimit, RobotConditions, Robustness
from mjfim.records.trajectory import Recording
from tests.support.made_records import make_comparison, make_method_result

# A name of 40 characters, and many of them.
LONG = "left_forearm_and_hand_with_gripper_mass_"
MANY = tuple(f"{LONG[:-2]}{j:02d}" for j in range(30))
FEW = ("m", "l", "c")

# Begins of the first row of the first table.
BEGINS = ("m ", "nominal", "▶", "left_")

DERIVED = Emphasis.DERIVED

WARNING = (
    "not smooth: derivatives with two different difference steps disagree by 2.6 % for "
    f"{MANY[0]}, first at sample 174; σ and the design are unreliable"
)


def an_estimate(names: tuple[str, ...]) -> Estimate:
    """An estimate with 12 outputs and predictions of 9 recordings."""
    p, outputs = len(names), tuple(f"qvel:{name}" for name in MANY[:12])
    theta = np.geomspace(1e-7, 4500.0, p) * np.where(np.arange(p) % 2, 1.0, -1.0)
    errors = [
        PredictionErrors(name="", outputs=outputs, rms=np.full(12, rms), mae=np.full(12, rms))
        for rms in (0.012345, 0.12345)
    ]
    predictions = tuple(
        Prediction(
            name=f"last 25 % of logs/of_the_third_day/with_the_payload_of_2_kg_{k}.csv",
            identified=errors[0],
            nominal=errors[1],
            held_out=k > 3,
        )
        for k in range(9)
    )
    rms = dict.fromkeys(outputs, 0.0123)
    recording = Recording(
        t=np.arange(3.0), ctrl=np.zeros((2, 1)), y=np.zeros((3, 12)), outputs=outputs
    )
    return Estimate(
        parameters=names,
        theta=theta,
        std=np.abs(theta) * 1.2345e-3,
        covariance=np.eye(p),
        initial_theta=1.1 * theta,
        chi2=2000.0,
        dof=1000,
        status="converged: the step vanished",
        success=True,
        misfit=True,
        iterations=12,
        residual_rms=rms,
        at_bound=names[-1:],
        predicted=(np.zeros((3, 12)),),
        recordings=(recording,),
        warnings=(WARNING,) * 6,
        predictions=predictions,
        units=("kg m²/rad",) * p,
    )


def a_check(names: tuple[str, ...]) -> Check:
    """A check with three findings."""
    rows = tuple(
        ParameterCheck(
            name=name,
            unit="kg m²",
            value=-1.2345e-7,
            nuisance=j == 1,
            size=1.2345e-7,
            std=np.inf if j == 2 else 1.2345e-9,
            relative=0.01,
            wanted=1.2345e-9,
            stated=False,
            repetitions=123456,
            seconds=1234567.0,
        )
        for j, name in enumerate(names)
    )
    p = len(names)
    return Check(
        source="the initial control",
        horizon=4.9,
        rows=rows,
        wanted=names,
        information=np.eye(p),
        eigenvalues=np.geomspace(1e-9, 1e9, p),
        correlation=np.eye(p),
        confounded=(),
        not_separable=(),
        not_excited=(),
        self_test=SelfTest(roughness=None, recursion=1e-7, slope=1e-7),
        verdict=(WARNING,) * 3,
    )


def a_comparison(names: tuple[str, ...]) -> Comparison:
    """Four methods under limits."""
    p = len(names)
    rows = (
        make_method_result(
            method,
            0.123456 * (1 + k),
            title=title,
            criterion=12.3456,
            std=np.full(p, 1.2345e-5),
            min_eigenvalue=0.1,
            worst_relative_std=0.12345,
            seconds=60.0,
            steps=123456789,
            margins={"control_rate": 0.1},
            relative_margins={"control_rate": 0.01234},
        )
        for k, (method, title) in enumerate(
            (("design", "this design"), ("a", "multisine, best of 8"), ("b", "Fourier series"))
        )
    )
    return make_comparison(
        *rows,
        source="an experiment",
        parameters=names,
        units=("kg m²",) * p,
        scale=np.ones(p),
        seconds=60.0,
        steps=1e6,
        weighted=True,
    )


def a_robustness(names: tuple[str, ...]) -> Robustness:
    """Four robots that exceed a limit of every joint."""
    p = len(names)
    limits = tuple(
        AssessedLimit(kind="control_rate", name=name, lower=-1.0, upper=1.0, scale=1.0)
        for name in names
    )
    return Robustness(
        conditions=RobotConditions(),
        names=names,
        units=("kg m²",) * p,
        limits=limits,
        wrong=np.full(p, 0.2),
        z=np.ones((4, p)),
        error=np.full((4, p), 1.2345e-5),
        std=np.full((4, p), 1.2345e-5),
        predicted=np.full(p, 1.2345e-5),
        joint=(4, 4),
        margins=np.full((4, p), -0.1),
        planned=np.full(p, 0.1),
        fit=1.0,
        misfits=0,
        restarted=0,
        troubles={},
    )


RECORDS = (an_estimate, a_check, a_comparison, a_robustness)


def printed(summary: Summary, width: int, *, verbose: bool = False) -> list[str]:
    """Lines in a terminal of some width."""
    return [line for line, _ in render(summary, verbose=verbose).lines(width)]


def letters(text: str) -> str:
    """A text without spaces and line breaks, because sentences and names may be folded."""
    return "".join(text.split())


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("names", [FEW, MANY, MANY[:3]], ids=["few", "many", "long"])
@pytest.mark.parametrize("make", RECORDS)
def test_the_short_form_is_short_and_cuts_nothing(
    make: Callable[[tuple[str, ...]], ShownRecord], names: tuple[str, ...], width: int
) -> None:
    summary = describe(make(names))
    lines = printed(summary, width)
    assert 0 < len(lines) <= MAX_LINES
    assert max(map(cell_len, lines)) <= width
    assert not any("…" in line for line in lines)

    # It begins with the verdict, and shows the first parameter or method.
    assert letters("".join(lines)).startswith(letters(summary.outcome)[1:], 1)
    assert any(line.startswith(BEGINS) for line in lines)


@pytest.mark.parametrize("make", [a_check, an_estimate])
def test_ten_parameters_are_shown_beside_long_sentences(
    make: Callable[[tuple[str, ...]], ShownRecord],
) -> None:
    """As on an arm with servos: names of 24 characters, and a verdict of four lines."""
    names = tuple(f"Wrist_Pitch_frictionlos{j}" for j in range(10))
    remark = "dry friction of Elbow, dry friction of Jaw"
    verdict = WARNING.replace("; σ and", f" (t = 1.9 s; {remark}); σ and")
    summary = replace(describe(make(names)), outcome=verdict)
    lines = printed(summary, 80)
    assert len(lines) <= MAX_LINES
    assert [line.split()[0] for line in lines if line.startswith("Wrist")] == list(names)

    # The short form says that something is missing, and the long form has it.
    assert letters(lines[0]) in letters(verdict.capitalize())
    shown = " ".join(lines)
    assert "column" in shown and "ends of sentences" in shown and remark not in shown
    long = printed(summary, 80, verbose=True)
    assert letters(remark) in letters("".join(long))


@pytest.mark.parametrize(
    ("sentence", "most", "shown"),
    [
        ("short enough (with a remark); with a clause", 2, None),
        ("The worst of all is m (largest for the arm, 15 times). It keeps all limits", 1,
         "The worst of all is m. It keeps all limits"),
        ("The result is not smooth at the sample 17 (t = 1 s); σ is unreliable, because of it", 1,
         "The result is not smooth at the sample 17 (t = 1 s)"),
        ("a list of some members\n  of a group that stays as it is", 1, None),
        ("unbreakable words only, which have neither clause nor remark and stay whole", 1, None),
    ],
)  # fmt: skip
def test_sentences_lose_remarks_and_then_clauses(
    sentence: str, most: int, shown: str | None
) -> None:
    assert condensed(sentence, 60, most) == (shown or sentence)


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("names", [FEW, MANY], ids=["few", "many"])
@pytest.mark.parametrize("make", RECORDS)
def test_the_long_form_has_all_numbers_and_names(
    make: Callable[[tuple[str, ...]], ShownRecord], names: tuple[str, ...], width: int
) -> None:
    summary = describe(make(names))
    lines = printed(summary, width, verbose=True)
    assert max(map(cell_len, lines)) <= width
    assert not any("…" in line or "--verbose" in line for line in lines)

    shown = {part for line in lines for part in line.replace(",", "").split()}
    numbers = {part for table in summary.tables for part in numbers_in(table)}
    assert numbers and numbers <= shown
    assert letters(summary.outcome)[1:] in letters("".join(lines))


def numbers_in(table: SummaryTable) -> list[str]:
    """The words of the numbers of a table, which are never folded."""
    numbers = [k for k, column in enumerate(table.columns) if not column.left]
    cells = [str(row.cells[k]).replace(",", "") for row in table.rows for k in numbers]
    return [part for cell in cells for part in cell.split()]


def test_combinations_are_shown_before_further_findings_and_explanations() -> None:
    """They are results, although they stand below the table."""
    items = ("a, b, c only as\n  a + b = 1\n  b + c = 2",)
    found = Listing(title="Combinations:", items=items, emphasis=DERIVED)
    rows = tuple(Row(cells=(f"p{k}",)) for k in range(10))
    table = SummaryTable(key="t", title="Values", columns=columns("parameter"), rows=rows)
    findings = Listing(title="Findings", items=(WARNING,))
    lines = printed(Summary(title="", outcome="Done", parts=(findings, table, found)), 80)
    assert "    b + c = 2" in lines and "p9" in lines and "Findings" not in lines


def test_units_have_a_column() -> None:
    table = SummaryTable(
        key="t",
        title="",
        columns=columns("parameter", "value"),
        rows=(Row(cells=(Name(name="mass", unit="kg"), Quantity(value=2.0))),),
    )
    lines = printed(Summary(title="", outcome="", parts=(table,)), 80)
    assert lines[0].split() == ["parameter", "unit", "value"]
    assert lines[2].split() == ["mass", "kg", "2"]


def test_a_wide_table_with_few_rows_is_transposed() -> None:
    headings = [f"sensor_of_joint_{k}" for k in range(12)]
    row = Row(cells=("log.csv", *(Quantity(value=0.1 + k, digits=4) for k in range(12))))
    table = SummaryTable(key="t", title="", columns=columns("log", *headings), rows=(row,))
    lines = printed(Summary(title="", outcome="", parts=(table,)), 80, verbose=True)
    assert lines[0].split() == ["log", "log.csv"]
    assert lines[-1].split() == ["sensor_of_joint_11", "11.1"]


def test_rows_with_a_warning_are_shown_first() -> None:
    rows = [Row(cells=(f"p{k}",)) for k in range(60)]
    rows[-1] = replace(rows[-1], emphasis=Emphasis.WARNING)
    table = SummaryTable(key="t", title="", columns=columns("parameter"), rows=tuple(rows))
    lines = printed(Summary(title="", outcome="", parts=(table,)), 80)
    assert "p59" in lines
    assert (
        lines[-1] == f"Not shown here: {60 - len(lines) + 3} parameters; --verbose shows everything"
    )


def test_explanations_are_left_out_before_results() -> None:
    rows = tuple(Row(cells=(f"p{k}",)) for k in range(MAX_LINES - 5))
    table = SummaryTable(key="t", title="", columns=columns("parameter"), rows=rows)
    note = Paragraph(text="words " * 100, emphasis=Emphasis.WEAK)
    lines = printed(Summary(title="", outcome="Done", parts=(note, table)), 80)
    assert f"p{MAX_LINES - 6}" in lines and not any("words" in line for line in lines)


def test_lists_keep_their_first_sentences() -> None:
    listing = Listing(title="Findings", items=tuple(f"• {k}: {WARNING}" for k in range(20)))
    lines = printed(Summary(title="", outcome="Done", parts=(listing,)), 80)
    assert any("• 0:" in line for line in lines)
    assert "sentences; --verbose shows everything" in lines[-1]


@pytest.mark.parametrize(
    ("text", "width", "lines"),
    [
        ("one two three", 8, ["one two", "three"]),
        ("left_forearm_mass", 12, ["left_", "forearm_mass"]),
        ("x" * 30, 12, ["x" * 12, "x" * 12, "x" * 6]),
        ("lasts for 3 s", 11, ["lasts for", "3 s"]),
        ("enough (19 s) here", 11, ["enough", "(19 s) here"]),
        ("a\nb", 80, ["a", "b"]),
        ("", 80, [""]),
    ],
)
def test_lines_end_at_spaces_and_in_names_at_separators(
    text: str, width: int, lines: list[str]
) -> None:
    assert fold(text, width) == lines


def test_symbols_and_paths_at_the_begin_of_a_verdict_stay_as_they_are() -> None:
    for begin, shown in (("done", "Done"), ("σ falls", "σ falls"), ("a/b.toml is", "a/b.toml is")):
        assert printed(Summary(title="", outcome=begin, parts=()), 80) == [shown]


def test_a_prediction_without_error_has_no_ratio() -> None:
    """A log that was simulated without noise may be predicted exactly by both models."""
    found = an_estimate(MANY[:3])
    (first, *_) = found.predictions
    exact = replace(first.nominal, rms=np.zeros(12), mae=np.zeros(12))
    predictions = (replace(first, nominal=exact, identified=exact),)

    summary = describe(replace(found, predictions=predictions))
    text = "\n".join(line for line, _ in render(summary, verbose=True).lines(120))
    assert "nan" not in text.lower()
