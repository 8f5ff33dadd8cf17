"""Numbers with a unit."""

from __future__ import annotations

import copy
import pickle
from typing import get_args

import pytest
from pydantic_core import PydanticCustomError

from mjfim.recordings.quantities import USUAL_UNITS, Quantity, Unit, units_like
from mjfim.recordings.section import LogUnit


@pytest.mark.parametrize(
    ("text", "value", "like"),
    [
        ("180 deg", 3.141592653589793, "rad"),
        ("90°", 1.5707963267948966, "rad"),
        ("-2 rev/s", -12.566370614359172, "rad/s"),
        ("60 rpm", 6.283185307179586, "rad/s"),
        ("5cm", 0.05, "m"),
        ("+.5e1 mm", 0.005, "m"),
        ("200 g", 0.2, "kg"),
        ("3 mN m", 0.003, "N m"),
        ("3 mNm", 0.003, "N m/rad"),
        ("2 N*m*s/rad", 2.0, "N m s/rad"),
        ("10 g cm^2", 1e-6, "kg m²"),
        ("9.81 m/s**2", 9.81, "m/s²"),
        ("9.81 m/s/s", 9.81, "m/s²"),
        ("0.1 kHz", 100.0, "Hz"),
        ("2 min", 120.0, "s"),
        ("250 µs", 250e-6, "s"),
        ("20 mT", 0.02, "T"),
    ],
)
def test_numbers_become_si(text: str, value: float, like: str) -> None:
    number = Quantity.parse(text)
    assert number == pytest.approx(value, rel=1e-15)
    assert number.unit.measures(Unit.parse(like))


@pytest.mark.parametrize(
    "text",
    ["90", "deg", "90 degs", "ninety deg", "1,5 m", "1 m/", "1 m//s", "1 /s", "nan m", "1 m³x", ""],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(PydanticCustomError, match=r"should be a number|unknown unit"):
        Quantity.parse(text)


@pytest.mark.parametrize(
    ("left", "right"),
    [("Hz", "rad/s"), ("rpm", "Hz"), ("rad", "m"), ("kg", "N"), ("N", "N m"), ("m", "m/s")],
)
def test_quantities_are_told_apart(left: str, right: str) -> None:
    assert not Unit.parse(left).measures(Unit.parse(right))
    assert right not in units_like(left)


def test_every_usual_unit_is_in_the_table() -> None:
    assert all(name in units_like(name) for name in USUAL_UNITS)


def test_units_of_logs_are_those_of_numbers() -> None:
    assert set(get_args(LogUnit)) <= set(USUAL_UNITS)


def test_copies_keep_the_unit() -> None:
    number = Quantity.parse("90 deg")
    for other in (copy.deepcopy(number), pickle.loads(pickle.dumps(number))):
        assert other == number
        assert (other.text, other.unit) == ("90 deg", number.unit)
