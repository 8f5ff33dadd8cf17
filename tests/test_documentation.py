"""The Python code, commands and experiment files in README.md and docs/ run; links point to files.

A block that cannot run here carries the comment `<!-- not run: reason -->` on a line above it.
Python blocks stand alone. Commands of one file run one after another in one folder that holds a
copy of models/. They run in the test process, because a new process takes two seconds to import
everything, and with smaller budgets than a reader's (`QUICKER`). A TOML block with the key `model`
is an experiment beside models/; the TOML blocks after it extend it.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import mjfim
from mjfim.cli import design as design_verb
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment import System
from mjfim.studies import first_experiment
from tests.support import cli
from tests.support.markdown import CodeBlock, code_blocks, linked_files
from tests.support.paths import MODELS, ROOT
from tests.support.quicker import QUICKER, quicker, quicker_models

# All documents of the repository.
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

# Experiment that TOML blocks extend in a file that states no complete experiment before them.
DEFAULT_EXPERIMENT = MODELS / "cart_pendulum.toml"

# Signs that the shell would replace or obey in the words of a command.
SHELL_SIGNS = re.compile(r"[|&;<>()$`*?\[{~!]")

# One or two names in backquotes, the word `in`, and a file of the package in backquotes.
NAMED_CODE = re.compile(r"`([\w.]+)`(?: and `([\w.]+)`)? in `(mjfim/[\w/]+\.py)`")


def runnable(path: Path, language: str) -> list[CodeBlock]:
    """Return the blocks of one language of a file that are not marked as `not run`."""
    blocks = [block for block in code_blocks(path) if block.language == language]
    return [block for block in blocks if not block.skip_reason]


def commands(block: CodeBlock) -> list[tuple[str, int]]:
    """Return the commands of a shell block with their exit codes.

    A comment such as `exits with 1` behind a command states a code other than 0.
    """
    lines = block.text.replace("\\\n", " ").splitlines()
    found = []

    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            stated = re.search(r"#.*\bexits with (\d+)", line)
            found.append((line, int(stated[1]) if stated else 0))

    return found


def experiments(path: Path) -> list[tuple[str, mjfim.Experiment]]:
    """Return the name and the experiment of every TOML block of a file.

    The experiment is the block alone, or the experiment before it extended by the block.
    """
    whole = tomllib.loads(DEFAULT_EXPERIMENT.read_text(encoding="utf-8"))
    found = []

    for block in runnable(path, "toml"):
        tables = tomllib.loads(block.text)
        if "model" in tables:
            whole = tables
        stated = mjfim.Experiment(**whole, directory=MODELS)
        found.append((block.name, stated.replace(**tables)))

    return found


def run(command: list[str], folder: Path, code: int = 0) -> None:
    """Run a command with this package and this Python first; assert its exit code.

    Warnings are errors.

    Args:
        command: Program and arguments.
        folder: Working directory; its subfolder `bin` receives `mjfim` and `python`.
        code: Expected exit code.
    """
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)

    for name, words in (("python", ""), ("mjfim", "-m mjfim ")):
        script = programs / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words}"$@"\n', encoding="utf-8")
        script.chmod(0o755)

    environment = {
        **os.environ,
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "PYTHONWARNINGS": "error",
    }
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, env=environment, check=False
    )
    assert done.returncode == code, done.stdout + done.stderr


def run_line(line: str, folder: Path, code: int = 0) -> None:
    """Run a line of a shell block; assert its exit code.

    `mjfim` runs in this process if the line is nothing but its words.

    Args:
        line: The line.
        folder: Working directory.
        code: Expected exit code.
    """
    program, *words = shlex.split(line, comments=True)
    if program != "mjfim" or SHELL_SIGNS.search(" ".join(words)):
        run(["bash", "-c", line], folder, code)
        return

    with contextlib.chdir(folder):
        done = cli.run(*words)
    assert done.exit_code == code, f"{done.output}{done.exception!r}"


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with copies of models/ and scripts/, where results may be written."""
    shutil.copytree(ROOT / "scripts", tmp_path / "scripts")
    quicker_models(tmp_path / "models")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    "block",
    [block for path in DOCUMENTS for block in runnable(path, "python")],
    ids=lambda block: block.name,
)
def test_python_blocks_run(block: CodeBlock, checkout: Path) -> None:
    """Those that start processes run in a new one."""
    if "__main__" in block.text:
        run([sys.executable, "-c", quicker(block.text)], checkout)
        return

    with contextlib.chdir(checkout):
        exec(compile(quicker(block.text), block.name, "exec"), {"__name__": "__main__"})


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize(
    "path", [path for path in DOCUMENTS if runnable(path, "sh")], ids=lambda path: path.name
)
def test_shell_blocks_run(path: Path, checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are made, and not rendered."""
    monkeypatch.setattr(design_verb, "DEFAULT_SECONDS", 2.0)
    monkeypatch.setattr(first_experiment, "SECONDS", 2.0)
    for block in runnable(path, "sh"):
        for line, code in commands(block):
            run_line(quicker(line), checkout, code)


@pytest.mark.parametrize(
    "stated",
    [pytest.param(stated, id=name) for path in DOCUMENTS for name, stated in experiments(path)],
)
def test_toml_blocks_are_experiments(stated: mjfim.Experiment) -> None:
    if stated.horizon is None:
        assert System.resolve(stated).parameters.names
        return

    task = DesignTask.resolve(stated)
    assert evaluate_task(task, task.initial).cost < float("inf")


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_links_point_to_files(path: Path) -> None:
    assert [target for target in linked_files(path) if not target.exists()] == []


@pytest.mark.parametrize("path", [*DOCUMENTS, ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_named_code_exists(path: Path) -> None:
    """The files of the package that a document names exist, with the functions and classes."""
    text = path.read_text(encoding="utf-8")
    named_files = set(re.findall(r"mjfim/[\w/]+\.py", text))
    assert [name for name in sorted(named_files) if not (ROOT / name).exists()] == []

    missing = []
    for *names, file in NAMED_CODE.findall(text):
        source = (ROOT / file).read_text(encoding="utf-8")
        parts = [part for name in names if name for part in name.split(".")]
        missing += [
            f"{part} in {file}"
            for part in parts
            if not re.search(rf"\b(?:def|class) {part}\b|^\s*{part}\b", source, re.MULTILINE)
        ]
    assert missing == []


# ---- the checks themselves, on small documents


def test_every_budget_stands_somewhere() -> None:
    files = [*DOCUMENTS, *MODELS.glob("*.toml"), *(ROOT / "docs" / "notebooks").glob("*.ipynb")]
    texts = [path.read_text(encoding="utf-8").replace('\\"', '"') for path in files]
    assert [stated for stated in QUICKER if not any(stated in text for text in texts)] == []


@pytest.mark.parametrize("line", ["mjfim check gone.toml", "mjfim check gone.toml > out.txt"])
def test_a_failing_command_is_noticed(line: str, tmp_path: Path) -> None:
    """It is so in this process and in a shell."""
    run_line(f"{line}  # exits with 2", tmp_path, code=2)
    with pytest.raises(AssertionError, match=r"gone\.toml|returncode"):
        run_line(line, tmp_path)
