"""Run the command line inside the test process; check its files and its errors."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
import typer.testing
from typer.main import get_command
from typer.testing import CliRunner, Result

from mjfim.cli import main as cli
from mjfim.files import replacing
from tests.support.paths import MODELS

# Files that `mjfim design` writes.
DESIGN = {
    "design.json",
    "design.npz",
    "design.csv",
    "reference.csv",
    "report.html",
    "design.rrd",
    "trajectories.png",
    "accuracy_over_time.png",
    "accuracy.png",
    "worth.png",
    "rehearsal.png",
    "valley.png",
}

# Files that `mjfim identify` writes.
ESTIMATE_DATA = {"estimate.json", "estimate.npz", "identified.xml"}
ESTIMATE = {*ESTIMATE_DATA, "report.html", "estimate.rrd"} | {
    f"{name}.png"
    for name in (
        "fit",
        "parameters",
        "accuracy",
        "predictions",
        "pairs",
        "deciding_seconds",
        "residual_torque",
    )
}

# Files that `mjfim montecarlo` writes for the cart-pendulum.
STUDY = {
    "montecarlo.json",
    "montecarlo.npz",
    "report.html",
    "overview.png",
    "histogram_m.png",
    "histogram_l.png",
    "histogram_c.png",
}

# Command that runs `mjfim` in a new process, where every warning is an error.
PROCESS = [sys.executable, "-W", "error", "-m", "mjfim"]


# The command of an app. Typer's runner builds it from the signatures of all verbs at each call,
# which takes longer than most calls.
command_of = cache(get_command)


def run(*words: object, answers: str | None = None) -> Result:
    """Run `mjfim` with these words in this process.

    Args:
        *words: The words; the first one may be several, with blanks between them.
        answers: Standard input.
    """
    split = [*" ".join(map(str, words[:1])).split(), *map(str, words[1:])]
    with patch.object(typer.testing, "_get_command", command_of):
        return CliRunner().invoke(cli.app, split, input=answers)


def called_here(words: Sequence[str], *, folder: Path, **_: Any) -> SimpleNamespace:
    """A call of `scripts.verbs.call_verb` that runs in this process."""
    with contextlib.chdir(folder):
        result = run(*words)
    return SimpleNamespace(returncode=result.exit_code, stdout=result.stdout, stderr=result.stderr)


def done(*words: object, code: int = 0) -> Result:
    """Run `mjfim` with these words in this process, and assert its exit code."""
    result = run(*words)
    assert result.exit_code == code, result.output
    return result


def write_wrong_guess(path: Path, first: str = "") -> Path:
    """Write a quick study with a wrong guess, for campaigns; its model and control stand beside it.

    Args:
        path: The new experiment file.
        first: Its first line.

    Returns:
        The path.
    """
    text = (MODELS / "cart_pendulum_guess.toml").read_text(encoding="utf-8")
    for old, new in (
        ("horizon = 4.0", "horizon = 1.0"),
        ('"cart_pendulum.csv"', '{ kind = "sine", amplitude = 2.0, frequency = 0.8 }'),
        ("starts = 4", "starts = 1"),
        ("tolerance = 1e-7", "tolerance = 1e-3"),
        ("max_iterations = 200", "max_iterations = 30"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(f"{first}\n{text}", encoding="utf-8")
    return path


def write_experiment(home: Path, **lines: str) -> Path:
    """Write the study of the paper with a short horizon and a loose tolerance.

    Args:
        home: Folder that receives the experiment, its model and its initial control.
        **lines: New values of single keys of the experiment file; `start` is the initial control.

    Returns:
        Path of the experiment file.

    Raises:
        ValueError: A key is missing in the experiment file or stands there more than once.
    """
    for file in ("cart_pendulum.xml", "cart_pendulum.csv"):
        if not (home / file).exists():
            shutil.copy(MODELS / file, home)

    text = (MODELS / "cart_pendulum.toml").read_text(encoding="utf-8")
    values = {"horizon": "1.0", "tolerance": "0.1", "max_iterations": "40", **lines}

    for key, value in values.items():
        # The cost also has a key `control`; only the initial control is a string.
        name, quote = ("control", '"') if key == "start" else (key, "")
        pattern = rf"^{name} = {quote}.*$"
        text, count = re.subn(pattern, f"{name} = {value}", text, flags=re.MULTILINE)
        if count != 1:
            raise ValueError(f"{key} does not stand exactly once in the experiment file")

    path = home / "study.toml"
    path.write_text(f"rehearsal.robots = 4\n{text}", encoding="utf-8")
    return path


def loads(text: str) -> dict[str, Any]:
    """Parse a JSON object."""
    return json.loads(text)


def read(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds one object."""
    return loads(path.read_text(encoding="utf-8"))


def names(folder: Path) -> set[str]:
    """Names of all entries of a folder, hidden files too."""
    return {path.name for path in folder.iterdir()}


def misused(result: Result, *fragments: str) -> None:
    """Assert that a run ended with exit code 2 and one message of one line on stderr.

    Lines to be copied may follow; they are indented.

    Args:
        result: Result of the run.
        *fragments: Words that the message contains.
    """
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("mjfim: ")
    assert result.stderr.count("mjfim: ") == 1
    lines = result.stderr.strip().splitlines()
    assert len([line for line in lines if not line.startswith("  ")]) == 1, result.stderr
    assert "Traceback" not in result.stderr
    assert [f for f in fragments if f not in result.stderr] == []


def write_empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write empty files in place of figures, which take seconds to draw."""

    def touch(figure: object, path: Path, dpi: float = 0.0) -> Path:
        with replacing(path):
            return path

    # Imported here, because most tests draw nothing and matplotlib takes a while to import.
    from mjfim.output.plots import draw

    monkeypatch.setattr(draw, "save", touch)
