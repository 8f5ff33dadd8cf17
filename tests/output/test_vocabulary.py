"""One word and one colour for one thing: the page that explains them, and the sentences shown."""

from __future__ import annotations

import ast
import json
import pickle
import re
from collections.abc import Iterator

import pytest

from mjfim.output.page import TERMS, Term
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

# Any of these words. To parse all modules takes seconds, so only those are parsed that hold one.
ANY_REPLACED = re.compile("|".join(f"(?:{pattern})" for pattern in REPLACED), re.IGNORECASE)

# What stands between the parts of a text that is written over several lines.
BETWEEN_PARTS = re.compile(r"""["']\s+f?["']""")

# Folders whose sentences users see.
SHOWN = ("cli", "output", "records", "studies", "identification", "excitation")


@pytest.mark.parametrize("term", TERMS, ids=str)
def test_the_page_has_the_words_colours_and_meanings(term: Term) -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    (row,) = [row for row in rows if row.startswith(f"| {term} |")]
    assert set(re.findall(r"#[0-9a-f]{6}", row)) == {term.colour}

    import mjfim.output.page as shown

    meaning = row.rstrip("| ").rpartition("|")[2].strip()
    assert shown.__doc__ is not None and meaning in shown.__doc__


def sentences_of_modules() -> Iterator[tuple[str, str]]:
    """Yield the texts of the modules that show something, without docstrings, with their place."""
    for folder in SHOWN:
        for path in sorted((ROOT / "mjfim" / folder).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if not ANY_REPLACED.search(BETWEEN_PARTS.sub("", source)):
                continue
            tree = ast.parse(source)
            documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
            nodes = [node for node in ast.walk(tree) if isinstance(node, documented)]
            docstrings = {id(node.body[0].value) for node in nodes if _has_docstring(node)}  # type: ignore[attr-defined]
            for node in ast.walk(tree):
                is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
                if is_text and id(node) not in docstrings:
                    yield f"{path.name}:{node.lineno}", str(node.value)  # type: ignore[attr-defined]


def _has_docstring(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> bool:
    """Whether a module, class or function begins with an expression."""
    return bool(node.body) and isinstance(node.body[0], ast.Expr)


def sentences_of_pages() -> Iterator[tuple[str, str]]:
    """Yield the lines of the documentation and of the notebooks, with their place."""
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for k, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            yield f"{path.name}:{k}", line
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            yield path.name, "".join(cell["source"])


def test_shown_sentences_use_the_words_of_the_page() -> None:
    found = [
        f"{place}: write {word!r} instead of {match[0]!r}"
        for place, text in (*sentences_of_modules(), *sentences_of_pages())
        for pattern, word in REPLACED.items()
        if (match := re.search(pattern, text, re.IGNORECASE))
    ]
    assert found == []


@pytest.mark.parametrize("term", TERMS)
def test_a_copied_word_keeps_its_colours(term: Term) -> None:
    copied = pickle.loads(pickle.dumps(term))
    assert (copied, copied.rgb, copied.colour_name) == (term, term.rgb, term.colour_name)
