"""What a result says about one parameter, and about all of them as a table."""

from __future__ import annotations

import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.errors import MjfimError
from mjfim.records.base import ParameterValue
from tests.support import results

TARGETS = (("body/bob:mass",), ("body/bob:pos[2]", "geom/rod:size[1]"), ())


@pytest.mark.parametrize(
    ("value", "half", "unit", "text"),
    [
        (0.2031, 0.0042, "N m s/rad", "0.2031 ± 0.0042 N m s/rad"),
        (-2.0, 0.07, "kg", "−2.000 ± 0.070 kg"),
        (3.0, np.inf, "", "3.000 ± ∞"),
    ],
)
def test_a_value_prints_with_half_of_its_interval(
    value: float, half: float, unit: str, text: str
) -> None:
    interval = (value - half, value + half)
    found = ParameterValue(
        name="a", targets=(), unit=unit, value=value, std=0.5 * half, interval=interval
    )
    assert str(found) == repr(found) == text
    assert float(found) == value


@pytest.mark.parametrize("verb", ["design", "identify", "check"])
def test_a_parameter_is_found_by_its_name_and_by_what_it_sets(verb: str) -> None:
    made: Any = results.MAKERS[verb]()
    if verb == "check":
        rows = zip(made.rows, TARGETS, strict=True)
        found = replace(made, rows=tuple(replace(row, targets=each) for row, each in rows))
    else:
        found = replace(made, labels=replace(made.labels, targets=TARGETS))
    length = found["length"]
    assert (length.name, length.unit, length.value) == ("length", "m", 1.0)
    assert length.interval[0] < 1.0 < length.interval[1] and length.std > 0.0
    assert str(found["geom/rod:size[1]"]) == str(length)
    with pytest.raises(MjfimError, match=r"unknown parameter 'lenght' \(did you mean 'length'\?\)"):
        found["lenght"]
    with pytest.raises(MjfimError, match="unknown parameter"):
        found[["length"]]


def test_an_estimate_states_its_honest_accuracy() -> None:
    estimate = results.estimate(interval=np.array([[1.5, 2.5], [0.9, 1.1], [0.4, 0.6]]))
    mass = estimate["mass"]
    assert mass.interval == (1.5, 2.5)
    assert mass.std == pytest.approx(0.25)
    assert mass.further == {"formal_std": 0.02, "guess": 2.4}
    held = results.estimate(held=("mass",))["mass"]
    assert str(held) == "2.000 ± – kg" and np.isnan(held.std)


def test_a_table_is_a_data_frame_where_pandas_is_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    estimate = results.estimate()
    monkeypatch.setitem(sys.modules, "pandas", None)
    rows = estimate.table()
    assert [row["parameter"] for row in rows] == list(results.PARAMETERS)
    assert [row["value"] for row in rows] == estimate.theta.tolist()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda made: ("df", made)))
    assert estimate.table() == ("df", rows)


# ---- comparison of designs


def test_designs_are_compared_by_the_names_of_their_parameters() -> None:
    design = results.design(rehearsal=None)
    turned: Any = replace(
        design,
        parameters=design.parameters[::-1],
        final=replace(design.final, std=np.array([1.0, 2.0, 1.0]) * design.final.std[::-1]),
    )
    found = design.compare(turned)
    assert found.verdict.ok and "better 1 of 3" not in str(found)
    assert "determines 1 of 3 parameters better" in found.verdict.sentence
    back = turned.compare(design).verdict
    assert not back.ok and "determines length better" in back.sentence
    std = turned.final.std * [1.0, 1.0, 0.5]
    mixed = design.compare(replace(turned, final=replace(turned.final, std=std))).verdict.sentence
    assert "better, and this one 1 of 3 parameters" in mixed
    assert "equally well" in design.compare(design).verdict.sentence


@pytest.mark.parametrize(
    ("other", "words"),
    [("a path", "takes another Design, not a str"), (None, "no parameter in common")],
)
def test_what_cannot_be_compared_is_said(other: Any, words: str) -> None:
    design = results.design()
    other = other or replace(design, parameters=("a", "b", "c"))
    with pytest.raises(MjfimError, match=words):
        design.compare(other)
