"""Percentages and σ of one result agree in terminal, notebook, report, figures and JSON."""

from __future__ import annotations

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
from mjfim.output.page import number
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.output.report import write_report
from mjfim.output.words import relative
from mjfim.records.base import ShownRecord
from mjfim.records.check import Check
from mjfim.records.design import Design
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import read
from tests.support.pages import printed


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for 1 s."""
    tables = {"horizon": 1.0, "descent": {"max_iterations": 2}, "rehearsal": {"robots": 4}}
    return DesignTask.resolve(cart_pendulum(**tables))


@pytest.fixture(scope="module")
def design(task: DesignTask) -> Design:
    """A design after two iterations."""
    return mjfim.design(task.experiment)


@pytest.fixture(scope="module")
def check(task: DesignTask, design: Design) -> Check:
    return mjfim.check(task.experiment, trajectory=design.trajectory)


def texts_of(record: ShownRecord, folder: Path | None = None) -> list[str]:
    """The long form in a wide terminal, the notebook, and the report of a folder."""
    texts = [printed(page_of(record), verbose=True), record._repr_html_()]
    if folder is not None:
        texts.append(write_report(folder).read_text(encoding="utf-8"))
    spaces = str.maketrans("\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}\n", "   ")
    return [re.sub(" +", " ", unescape(text).translate(spaces)) for text in texts]


def in_figure(figure: Figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def missing(numbers: list[str], text: str) -> list[str]:
    """The numbers that a text does not contain as whole words."""
    return [n for n in numbers if not re.search(rf"(?<![\d.]){re.escape(n)}(?![\d])", text)]


def test_a_design_and_its_check_state_the_same_accuracy(
    task: DesignTask, design: Design, check: Check, tmp_path: Path
) -> None:
    archive.write_design(tmp_path, design, task.system)
    std, sizes = read(tmp_path / "design.json")["final"]["std"], design.sizes.tolist()
    shares = [relative(*pair) for pair in zip(std, sizes, strict=True)]
    terminal, notebook, report = texts_of(design, tmp_path)
    for text in (terminal, notebook, report, *texts_of(check)):
        assert missing([*map(number, std), *shares], text) == []
    assert missing(shares, in_figure(design.plot("accuracy"))) == []

    # A parameter of a vector is a share of the whole.
    of_vectors = replace(design, sizes=10.0 * design.sizes)
    tenth = relative(std[0], 10.0 * sizes[0])
    assert missing([tenth], in_figure(of_vectors.plot("accuracy"))) == []
    assert f"{tenth} of {number(10.0 * sizes[0], 2)}" in texts_of(of_vectors)[0]

    # The verdict names the largest of these shares.
    worst = shares[int(np.argmax(np.array(std) / design.sizes))]
    for text in (terminal, report):
        assert f"hardly determines c: σ is {worst} of its size" in text


def test_an_estimate_states_the_same_accuracy_everywhere(
    task: DesignTask, design: Design, tmp_path: Path
) -> None:
    recording = mjfim.simulate(task.experiment, design.trajectory, seed=0)
    found = mjfim.identify(task.experiment, [recording])
    estimate = replace(found, converged=True, misfit=False)
    estimate.save(tmp_path)
    stored = read(tmp_path / "estimate.json")
    honest = [0.25 * (high - low) for low, high in stored["interval"]]
    texts = texts_of(estimate, tmp_path)
    for text in texts:
        assert missing([number(value, 2) for value in (*honest, *stored["std"])], text) == []

    # Pictures of a fit need its segments and the nominal model.
    assert np.abs(estimate.nominal[0] - estimate.predicted[0]).max() > 0.0
    assert estimate.segments[0][0] == estimate.recordings[0].t[0]

    # The verdict is one sentence with one percentage.
    (share,) = re.findall(r"± (\S+ %)", estimate.verdict.sentence)
    half = 2.0 * np.array(honest) / np.abs(stored["theta"])
    assert share == relative(float(half.max()), 1.0)
    assert f"± {share}" in texts[-1]


def test_what_would_help_is_the_same_in_json_table_and_picture(check: Check) -> None:
    stated = check.summary()["worth"]
    target, std = (np.array([*stated[key].values()]) for key in ("target", "std"))
    without = {
        each["name"]: np.max(np.array([*each["without"].values()]) / target)
        for each in stated["sensors"]
    }
    (table,) = (each for each in page_of(check).tables if each.title == "Sensors")
    assert {row.cells[0] for row in table.rows} == set(without)
    for row in table.rows:
        change = without[row.cells[0]] / np.max(std / target)
        word = row.cells[table.columns.index("σ without it")]
        assert word.startswith("same" if change < 1.05 else f"× {change:.1f}")

    panel = pictures_of(check)["worth"]().panels[0]
    drawn = next(mark for mark in panel.marks if mark.label == "without it")
    shown = [(panel.y.names or [])[int(place)] for place in drawn.y]
    assert_allclose(drawn.x, [without[name] for name in shown], rtol=1e-12)
    assert shown
