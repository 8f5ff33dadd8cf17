"""Short texts of records."""

from __future__ import annotations

from enum import Enum

import numpy as np

import mjfim
from mjfim.arrays import Array, record
from mjfim.records.base import Record
from mjfim.records.trajectory import Trajectory


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
    text = repr(Thing(table={"a": 1}, array=np.zeros((400, 3))))
    lines = text.splitlines()
    assert lines[0] == "Thing("
    assert "  array=<array of shape (400, 3)>" in lines
    assert "  colour=Colour.RED" in lines
    assert "  few=(1, 2)" in lines
    assert "  many=(0, 1, 2, 3, ...)" in lines
    assert "  table=<1 entries>" in lines
    assert max(map(len, lines)) < 80


def test_saved_records_use_it() -> None:
    trajectory = Trajectory(
        t=np.arange(1001.0),
        qpos=np.zeros((1001, 2)),
        qvel=np.zeros((1001, 2)),
        act=np.zeros((1001, 0)),
        ctrl=np.zeros((1000, 1)),
    )
    assert len(repr(trajectory)) < 400
    assert "<array of shape (1000, 1)>" in repr(trajectory)


def test_only_public_names_are_listed() -> None:
    listed = dir(mjfim)
    assert {name for name in listed if not name.startswith("__")} == set(mjfim.__all__)
