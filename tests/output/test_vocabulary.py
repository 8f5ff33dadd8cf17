"""One word and one colour for one thing: the page that explains them, and the sentences shown."""

from __future__ import annotations

import json
import pickle
import re
from collections.abc import Iterator

import pytest

from mjfim.output.page import TERMS, Term
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from tests.support import results
from tests.support.pages import printed
from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "how-to" / "read-results.md"

# Words for which there is another one, and that one.
REPLACED = {
    r"optimi[sz]ed (trajectory|motion|control|design|experiment)": "designed",
    r"final (trajectory|motion|fit|design)\b": "designed, or last",
    r"errors? of (the )?guess|identified from the guess": "nominal value",
    r"from one to the next": "lag-1 correlation",
    r"\b(the|predicted|wanted|stated|of) sigma\b": "σ",
}


@pytest.mark.parametrize("term", TERMS, ids=str)
def test_the_page_has_the_words_colours_and_meanings(term: Term) -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    (row,) = [row for row in rows if row.startswith(f"| {term} |")]
    assert set(re.findall(r"#[0-9a-f]{6}", row)) == {term.colour}

    import mjfim.output.page as shown

    meaning = row.rstrip("| ").rpartition("|")[2].strip()
    assert shown.__doc__ is not None and meaning in shown.__doc__


def sentences() -> Iterator[tuple[str, str]]:
    """Yield the lines of results, of the documentation and of the notebooks, with their place."""
    for verb, make in results.MAKERS.items():
        record = make()
        yield verb, printed(page_of(record), verbose=True)
        for name, picture in pictures_of(record).items():
            drawn = picture()
            panels = [f"{panel.title} {panel.remark} {panel.message}" for panel in drawn.panels]
            marks = [key.label for key in drawn.legend()]
            yield f"{verb}, {name}", " ".join([drawn.title, drawn.note, *panels, *marks])
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            yield f"{path.name}:{k}", line
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            yield path.name, "".join(cell["source"])


def test_shown_sentences_use_the_words_of_the_page() -> None:
    found = [
        f"{place}: write {word!r} instead of {match[0]!r}"
        for place, text in sentences()
        for pattern, word in REPLACED.items()
        if (match := re.search(pattern, text, re.IGNORECASE))
    ]
    assert found == []


@pytest.mark.parametrize("term", TERMS)
def test_a_copied_word_keeps_its_colours(term: Term) -> None:
    copied = pickle.loads(pickle.dumps(term))
    assert (copied, copied.rgb, copied.colour_name) == (term, term.rgb, term.colour_name)
