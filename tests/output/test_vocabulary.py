"""One word and one colour for one thing: the page that explains them."""

from __future__ import annotations

import pickle
import re

import pytest

from mjfim.output.page import TERMS, Term
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "how-to" / "read-results.md"


@pytest.mark.parametrize("term", TERMS, ids=str)
def test_the_page_has_the_words_colours_and_meanings(term: Term) -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    (row,) = [row for row in rows if row.startswith(f"| {term} |")]
    assert set(re.findall(r"#[0-9a-f]{6}", row)) == {term.colour}

    import mjfim.output.page as shown

    meaning = row.rstrip("| ").rpartition("|")[2].strip()
    assert shown.__doc__ is not None and meaning in shown.__doc__


@pytest.mark.parametrize("term", TERMS)
def test_a_copied_word_keeps_its_colours(term: Term) -> None:
    copied = pickle.loads(pickle.dumps(term))
    assert (copied, copied.rgb, copied.colour_name) == (term, term.rgb, term.colour_name)
