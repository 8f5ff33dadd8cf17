"""The package never executes or unpickles the content of a file, and it is light to import."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import tokenize
from unicodedata import normalize

import pytest

from tests.support.paths import ROOT

# Every source file of the package.
SOURCES = sorted((ROOT / "mjfim").rglob("*.py"))


# Libraries that only drawing and the command line need; they take seconds to import.
HEAVY_LIBRARIES = {"matplotlib", "rerun", "rich", "typer"}


# Modules whose readers can execute code that a file holds, and functions that execute text.
UNSAFE_NAMES = {
    *("pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"),
    *("eval", "exec", "__import__"),
}


def unsafe_code(source: str) -> list[str]:
    """Unsafe names in a source, and pickles that NumPy may read."""
    # Python reads names in this normal form.
    text = normalize("NFKC", source)
    found = re.findall(r"allow_pickle(?!=False\b)", text)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return found + [
        t.string for t in tokens if t.type == tokenize.NAME and t.string in UNSAFE_NAMES
    ]


def heavy_libraries_after(code: str) -> set[str]:
    """Return the heavy libraries that a new Python process has loaded after this code."""
    script = f"{code}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return HEAVY_LIBRARIES & set(done.stdout.split())


def test_nothing_unpickles_or_evaluates() -> None:
    """Experiments, recordings and archives come from others: they are data, never code."""
    assert len(SOURCES) > 10
    found = {path.name: unsafe_code(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {name: uses for name, uses in found.items() if uses} == {}


@pytest.mark.parametrize(
    "source",
    [
        "f = eval",
        "exec('x = 1')",
        "__import__('os')",
        "import os, joblib.memory",
        "def f():\n    from dill.source import getsource",
        "np.load('x', allow_pickle=True)",
        "np.load('x', allow_pickle=flag)",
        "\N{MATHEMATICAL ITALIC SMALL E}val('1')",
    ],
)
def test_unsafe_code_is_found(source: str) -> None:
    assert len(unsafe_code(source)) == 1
    assert unsafe_code("np.load('x', allow_pickle=False)  # eval") == []


def test_importing_the_package_stays_light() -> None:
    assert heavy_libraries_after("import mjfim") == set()


@pytest.mark.slow
def test_a_campaign_begins_to_compute_before_it_imports_what_draws() -> None:
    """Ctrl-C before the first computation finds no long import."""
    assert heavy_libraries_after("import mjfim.output.campaign_folder") == set()


def test_heavy_libraries_are_found() -> None:
    assert heavy_libraries_after("from matplotlib import figure") == {"matplotlib"}
