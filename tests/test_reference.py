"""The reference pages say what the package is today."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import mjfim
from mjfim.records.base import Record
from scripts import reference
from tests.support.made_records import make_comparison, make_design, make_estimate, make_study

PAGES = sorted(reference.FOLDER.glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_generated_parts_are_current(page: Path) -> None:
    """Write them again with `python -m scripts.reference`."""
    text = page.read_text(encoding="utf-8")
    assert text.count("<!-- generated: ") == text.count("<!-- end -->")
    assert reference.written(text) == text


def test_the_json_schema_is_current() -> None:
    assert reference.SCHEMA.read_text(encoding="utf-8") == reference.schema_text()


def test_every_public_name_is_described() -> None:
    text = (reference.FOLDER / "python.md").read_text(encoding="utf-8")
    assert set(mjfim.__all__) <= set(re.findall(r"^(?:def|class) (\w+)", text, re.MULTILINE))


@pytest.mark.parametrize(
    "result",
    [make_design(), make_estimate(), make_study(), make_comparison()],
    ids=lambda result: type(result).__name__,
)
def test_every_key_of_a_json_file_is_described(result: Record) -> None:
    text = (reference.FOLDER / "output-files.md").read_text(encoding="utf-8")
    assert [key for key in result.summary() if f"`{key}`" not in text] == []
