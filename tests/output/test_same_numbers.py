"""Percentages and σ of one run agree in terminal, notebook, report, figures and JSON."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output import archive
from mjfim.output.page import REPORT, number
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.output.report import write_report
from mjfim.output.words import relative
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from tests.support.cart_pendulum import cart_pendulum
from tests.support.pages import printed


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for 2 s."""
    tables = {"horizon": 1.0, "descent": {"max_iterations": 2}, "rehearsal": {"robots": 4}}
    return DesignTask.resolve(cart_pendulum(**tables))


@pytest.fixture(scope="module")
def design(task: DesignTask) -> Design:
    """A design after one iteration."""
    return mjfim.design(task.experiment)


@pytest.fixture(scope="module")
def check(task: DesignTask, design: Design) -> Check:
    return mjfim.check(task.experiment, trajectory=design.trajectory)


@pytest.fixture(scope="module")
def estimate(task: DesignTask, design: Design) -> Estimate:
    recording = mjfim.simulate(task.experiment, design.trajectory, seed=0)
    found = mjfim.identify(task.experiment, [recording])
    return replace(found, converged=True, misfit=False)


def in_terminal(record: ShownRecord) -> str:
    """The long form in a wide terminal."""
    return printed(page_of(record), verbose=True)


def texts_of(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def plain(text: str) -> str:
    """A text of HTML with its characters, and usual spaces between numbers and units."""
    return (
        unescape(text).replace("\N{NO-BREAK SPACE}", " ").replace("\N{NARROW NO-BREAK SPACE}", " ")
    )


def missing(numbers: list[str], text: str) -> list[str]:
    """The numbers that a text does not contain as whole words."""
    shown = plain(text)
    return [n for n in numbers if not re.search(rf"(?<![\d.]){re.escape(n)}(?![\d])", shown)]


def test_a_design_and_its_check_state_the_same_accuracy(
    task: DesignTask, design: Design, check: Check, tmp_path: Path
) -> None:
    archive.write_data(tmp_path, design, task.system)
    write_report(tmp_path)
    stored = json.loads((tmp_path / "design.json").read_text(encoding="utf-8"))
    std = stored["final"]["std"]
    sigmas = [number(value) for value in std]
    shares = [relative(*pair) for pair in zip(std, design.sizes.tolist(), strict=True)]

    report = (tmp_path / REPORT).read_text(encoding="utf-8")
    notebook = design._repr_html_()
    for text in (in_terminal(design), notebook, report, in_terminal(check), check._repr_html_()):
        assert missing([*sigmas, *shares], text) == []
    assert missing(shares, texts_of(design.plot("accuracy"))) == []

    # A parameter of a vector is a share of the whole.
    of_vectors = replace(design, sizes=10.0 * design.sizes)
    tenth = relative(std[0], 10.0 * design.sizes[0])
    assert missing([tenth], texts_of(of_vectors.plot("accuracy"))) == []
    assert f"{tenth} of {number(of_vectors.sizes[0], 2)}" in in_terminal(of_vectors)

    # The verdict names the largest of these shares.
    worst = shares[int(np.argmax(np.array(std) / design.sizes))]
    for text in (" ".join(in_terminal(design).split()), plain(report)):
        assert f"hardly determines c: σ is {worst} of its size" in text


def test_an_estimate_states_the_same_accuracy_everywhere(
    estimate: Estimate, tmp_path: Path
) -> None:
    estimate.save(tmp_path)
    write_report(tmp_path)
    stored = json.loads((tmp_path / "estimate.json").read_text(encoding="utf-8"))
    honest = [0.25 * (high - low) for low, high in stored["interval"]]
    sigmas = [number(value, 2) for value in (*honest, *stored["std"])]

    report = (tmp_path / REPORT).read_text(encoding="utf-8")
    for text in (in_terminal(estimate), estimate._repr_html_(), report):
        assert missing(sigmas, text) == []

    # Pictures of a fit need its segments and the nominal model.
    assert np.abs(estimate.nominal[0] - estimate.predicted[0]).max() > 0.0
    assert estimate.segments[0][0] == estimate.recordings[0].t[0]

    # The verdict is one sentence with one percentage.
    verdict = estimate.verdict.sentence
    (share,) = re.findall(r"± (\S+ %)", verdict)
    half = 2.0 * np.array(honest) / np.abs(stored["theta"])
    assert share == relative(float(half.max()), 1.0)
    assert f"± {share}" in plain(report)


def test_what_would_help_is_the_same_in_json_table_and_picture(check: Check) -> None:
    stated = check.summary()["worth"]
    target = stated["target"]

    def ratio(std: dict[str, float]) -> float:
        """Largest σ over its wanted value."""
        return max(std[name] / target[name] for name in target)

    without = {each["name"]: ratio(each["without"]) for each in stated["sensors"]}
    (table,) = (each for each in page_of(check).tables if each.title == "Sensors")
    assert {row.cells[0] for row in table.rows} == set(without)
    for row in table.rows:
        change = without[row.cells[0]] / ratio(stated["std"])
        word = row.cells[table.columns.index("σ without it")]
        assert word.startswith("same" if change < 1.05 else f"× {change:.1f}")

    panel = pictures_of(check)["worth"]().panels[0]
    assert panel.y.names is not None
    drawn = next(mark for mark in panel.marks if mark.label == "without it")
    shown = [panel.y.names[int(place)] for place in drawn.y]
    assert_allclose(drawn.x, [without[name] for name in shown], rtol=1e-12)
    assert shown
