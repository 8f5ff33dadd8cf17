"""Percentages and σ of one result agree in terminal, notebook, report, figures and JSON."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from numpy.testing import assert_allclose

from mjfim.output.page import number
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.output.report import report_of
from mjfim.output.words import relative
from mjfim.records.base import ShownRecord
from tests.support import results
from tests.support.pages import printed
from tests.support.results import THETA

# By result, its standard deviations in JSON.
STATED: dict[str, Any] = {
    "design": lambda stated: stated["final"]["std"],
    "check": lambda stated: [row["std"] for row in stated["parameters"]],
    "identify": lambda stated: [0.25 * (high - low) for low, high in stated["interval"]],
}
PICTURES = {"design": "accuracy", "check": "check", "identify": "accuracy"}


def texts_of(record: ShownRecord, picture: str) -> list[str]:
    """The long form in a wide terminal, the notebook, the report, and a figure."""
    artists = record.plot(picture).findobj(Text)
    texts = [printed(page_of(record), verbose=True), record._repr_html_(), report_of([record])]
    texts.append("\n".join(artist.get_text() for artist in artists))
    spaces = str.maketrans("\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}", "  ")
    return [unescape(text).translate(spaces) for text in texts]


def missing(numbers: list[str], text: str) -> list[str]:
    """The numbers that a text does not contain as whole words."""
    return [n for n in numbers if not re.search(rf"(?<![\d.]){re.escape(n)}(?![\d])", text)]


@pytest.mark.parametrize("verb", STATED)
def test_accuracies_are_those_of_the_file_everywhere(verb: str) -> None:
    record = results.MAKERS[verb]()
    std = STATED[verb](record.summary())
    shares = [relative(*pair) for pair in zip(std, THETA.tolist(), strict=True)]
    *texts, figure = texts_of(record, PICTURES[verb])
    for text in texts:
        assert missing([number(each, 2) for each in std], text) == []
        assert verb == "identify" or missing(shares, text) == []
    assert missing(shares, figure) == []


def test_a_parameter_of_a_vector_is_a_share_of_the_whole() -> None:
    made = results.design()
    tenth = relative(made.final.std[0], 10.0 * THETA[0])
    terminal, *_, figure = texts_of(replace(made, sizes=10.0 * THETA), "accuracy")
    assert missing([tenth], figure) == []
    assert f"{tenth} of {number(10.0 * THETA[0], 2)}" in terminal


def test_the_verdict_of_an_estimate_has_the_largest_percentage() -> None:
    estimate = results.estimate()
    (share,) = re.findall(r"± (\S+ %)", estimate.verdict.sentence)
    half = 0.5 * np.ptp(np.array(estimate.summary()["interval"]), axis=1)
    assert share == relative(float((half / THETA).max()), 1.0)


def test_what_would_help_is_the_same_in_json_table_and_picture() -> None:
    worth = results.worth()
    stated = worth.summary()
    target, std = (np.array([*stated[key].values()]) for key in ("target", "std"))
    without = {
        each["name"]: np.max(np.array([*each["without"].values()]) / target)
        for each in stated["sensors"]
    }
    (table,) = (each for each in page_of(worth).tables if each.title == "Sensors")
    column = table.columns.index("σ without it")
    words = {row.cells[0]: row.cells[column] for row in table.rows}
    assert set(words) == {each["name"] for each in stated["sensors"] if not each["is_added"]}
    for name, word in words.items():
        change = without[name] / np.max(std / target)
        assert word.startswith("same" if change < 1.05 else f"× {change:.1f}")

    panel = pictures_of(worth)["worth"]().panels[0]
    drawn = next(mark for mark in panel.marks if mark.label == "without it")
    shown = [(panel.y.names or [])[int(place)] for place in drawn.y]
    assert_allclose(drawn.x, [without[name] for name in shown], rtol=1e-12)
    assert shown
