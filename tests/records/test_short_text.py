"""Short texts of records."""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array, record
from mjfim.records.base import Record


class Colour(Enum):
    RED = "a long sentence"


@record
class Thing(Record):
    number: float = 1.5
    words: str = "x" * 1000
    colour: Colour = Colour.RED
    few: tuple[int, ...] = (1, 2)
    many: tuple[int, ...] = tuple(range(1000))
    table: dict[str, int]
    array: Array


def test_each_field_is_one_short_line() -> None:
    text = repr(Thing(table={"a": 1}, array=np.arange(1200.0).reshape(400, 3)))
    lines = text.splitlines()
    assert lines[0] == "Thing("
    assert "  array=<400 × 3 numbers, 0 to 1.2e+03>" in lines
    assert "  colour=Colour.RED" in lines
    assert "  few=(1, 2)" in lines
    assert "  many=(0, 1, 2, 3, ...)" in lines
    assert "  table=<1 entries>" in lines
    assert max(map(len, lines)) < 80


@pytest.mark.parametrize(
    ("array", "text"),
    [
        ([0.203, 12345.0], "[0.203, 12345]"),
        ([[1.0, 0.5], [0.5, np.inf]], "[[1, 0.5], [0.5, inf]]"),
        ([], "[]"),
        (np.full(40, np.nan), "<40 numbers>"),
        (np.linspace(1.0, 9.0, 13), "<13 numbers, 1 to 9>"),
    ],
)
def test_a_small_array_shows_its_numbers(array: Any, text: str) -> None:
    assert f"  array={text}" in repr(Thing(table={}, array=np.array(array))).splitlines()


def test_an_experiment_shows_what_is_stated() -> None:
    values = {"model": "arm.xml", "rate": 50.0, "parameters": {"a": "joint/a:damping"}}
    shown = "parameters={'a': ParameterSpec(target='joint/a:damping')}"
    assert str(mjfim.Experiment(**values)) == f"model='arm.xml' rate=50.0 {shown}"
