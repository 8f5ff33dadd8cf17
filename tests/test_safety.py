"""The package never executes or unpickles the content of a file, and it is light to import."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from unicodedata import normalize

import pytest

from tests.support.paths import ROOT

# Every source file of the package.
SOURCES = sorted((ROOT / "mjfim").rglob("*.py"))

# Modules whose readers can execute code that a file holds.
PICKLING_MODULES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}

# Built-in functions that execute text.
EXECUTING_FUNCTIONS = {"eval", "exec", "__import__"}

# What an unsafe source contains; most sources do not, and need not be parsed.
UNSAFE_WORDS = re.compile(
    rf"\b({'|'.join([*PICKLING_MODULES, *EXECUTING_FUNCTIONS, 'allow_pickle'])})\b"
)

# Libraries that only drawing and the command line need; they take seconds to import.
HEAVY_LIBRARIES = {"matplotlib", "rerun", "rich", "typer"}


def unsafe_code(source: str) -> list[str]:
    """Return the unsafe uses in a source, with their line numbers.

    Pickling modules, functions that execute text and pickles in NumPy files are unsafe.
    """
    found = []

    # Python reads names in this normal form.
    if not UNSAFE_WORDS.search(normalize("NFKC", source)):
        return found

    for node in ast.walk(ast.parse(source)):
        names = set()

        if isinstance(node, ast.Import):
            names = {alias.name.split(".")[0] for alias in node.names} & PICKLING_MODULES
        elif isinstance(node, ast.ImportFrom):
            names = {(node.module or "").split(".")[0]} & PICKLING_MODULES
        elif isinstance(node, ast.Name):
            names = {node.id} & EXECUTING_FUNCTIONS
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            # Only the literal False refuses pickles for certain.
            refused = isinstance(node.value, ast.Constant) and node.value.value is False
            names = set() if refused else {"allow_pickle"}

        line = node.value.lineno if isinstance(node, ast.keyword) else getattr(node, "lineno", 0)
        found += [f"line {line}: {name}" for name in sorted(names)]

    return found


def heavy_libraries_after(code: str) -> set[str]:
    """Return the heavy libraries that a new Python process has loaded after this code."""
    script = f"{code}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return HEAVY_LIBRARIES & set(done.stdout.split())


def test_nothing_unpickles_or_evaluates() -> None:
    """Experiments, recordings and archives come from others: they are data, never code."""
    found = {
        path.relative_to(ROOT).as_posix(): unsafe_code(path.read_text(encoding="utf-8"))
        for path in SOURCES
    }

    assert len(found) > 10
    assert {name: uses for name, uses in found.items() if uses} == {}


@pytest.mark.parametrize(
    "source",
    [
        "eval('1')",
        "exec('x = 1')",
        "f = eval",
        "__import__('os')",
        "import pickle",
        "import os, joblib.memory",
        "from pickle import loads",
        "def f():\n    from dill.source import getsource",
        "import numpy as np\nnp.load('x', allow_pickle=True)",
        "np.load('x', allow_pickle=flag)",
        "\N{MATHEMATICAL ITALIC SMALL E}val('1')",
    ],
)
def test_unsafe_code_is_found(source: str) -> None:
    """Each of these sources holds one unsafe use."""
    assert len(unsafe_code(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "np.load('x', allow_pickle=False)",
        "import re\nre.compile('x')",
        "from mjfim.arrays import Array",
    ],
)
def test_safe_code_is_accepted(source: str) -> None:
    """A refused pickle and ordinary imports are not reported."""
    assert unsafe_code(source) == []


def test_importing_the_package_stays_light() -> None:
    """`import mjfim` loads no library that only figures and the command line need."""
    assert heavy_libraries_after("import mjfim") == set()


@pytest.mark.slow
def test_a_campaign_begins_to_compute_before_it_imports_what_draws() -> None:
    """Ctrl-C before the first computation finds no long import."""
    assert heavy_libraries_after("import mjfim.output.campaign_folder") == set()


def test_heavy_libraries_are_found() -> None:
    """A new process reports a heavy library that its code imports."""
    assert heavy_libraries_after("from matplotlib import figure") == {"matplotlib"}
