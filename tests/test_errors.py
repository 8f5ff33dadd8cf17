"""Texts that messages share: unknown names, shortened texts and lists of names."""

from __future__ import annotations

from mjfim.errors import LISTED_TEXT, listed, shortened, unknown


def test_an_unknown_name_is_compared_with_the_valid_ones() -> None:
    assert unknown("joint", "slid", ["slide", "hinge"]) == (
        "unknown joint 'slid' (did you mean 'slide'?); valid: hinge, slide"
    )
    assert unknown("joint", "slid", []) == "unknown joint 'slid'; valid: none"


def test_long_texts_are_shortened() -> None:
    assert shortened("x" * 60) == "x" * 60
    assert shortened("x" * 61) == "x" * 40 + " (the beginning of 61 characters)"
    assert len(unknown("column", "x" * 100_000, ["y" * 100_000])) < 300


def test_long_lists_name_the_number_of_the_others() -> None:
    names = [f"c{i}" for i in range(2000)]
    text = listed(names)
    assert text.startswith("c0, c1, c2, ")
    shown, _, further = text.partition(" and ")
    assert len(shown) <= LISTED_TEXT
    assert further == f"{2000 - len(shown.split(', '))} more"
    assert listed(names[:3]) == "c0, c1, c2"
