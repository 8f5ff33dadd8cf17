"""What a program imports before it is known what is wanted: nothing that takes long.

Which modules are imported is asserted, instead of a time, which depends on the computer.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from mjfim.cli.main import ORDER, app
from mjfim.parallel import cores
from tests.support.cli import MODELS, done, run, write_experiment
from tests.support.paths import ROOT

# Packages that take long to import, and that no help and no message about misuse needs.
SLOW = (
    "PIL",
    "av",
    "jinja2",
    "matplotlib",
    "mujoco",
    "multiprocessing",
    "numpy",
    "plotly",
    "psutil",
    "pyarrow",
    "rerun",
    "scipy",
)

# Packages and modules that only drawing, recordings or parts of the statistics need.
UNUSED_WITHOUT_FOLDER = (
    "PIL",
    "av",
    "jinja2",
    "matplotlib",
    "plotly",
    "rerun",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
)

# A program that calls the command line several times, and prints after each call its exit code and
# which of the modules that it is asked about are imported.
CALLS = """
import contextlib, io, json, sys

words, modules = json.loads(sys.argv[1])
import mjfim

report = [["import mjfim", 0, [name for name in modules if name in sys.modules]]]
from mjfim.__main__ import main

for call in words:
    sys.argv[1:], code = call, 0
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            main()
    except SystemExit as end:
        code = end.code
    report.append([" ".join(call), code, [name for name in modules if name in sys.modules]])
print(json.dumps(report))
"""


def imported(calls: list[list[str]], modules: tuple[str, ...]) -> list[tuple[str, int, list[str]]]:
    """Each call with its exit code and the modules that are imported after it."""
    asked = json.dumps([calls, modules])
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", CALLS, asked],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=True,
        timeout=120.0,
    )
    return [tuple(row) for row in json.loads(done.stdout)]


def verbs() -> dict[str, Any]:
    """The verbs of the command line by their names."""
    return dict(get_command(app).commands)  # type: ignore[attr-defined]


def test_help_and_misuse_import_nothing_slow() -> None:
    helps = [["--help"], *([name, "--help"] for name in verbs())]
    misuses = [
        ["dessign"],
        ["design", "--unknown"],
        ["check", "gone.toml"],
        ["list", "gone.xml"],
        ["identify", str(MODELS / "cart_pendulum.toml"), "gone.csv", "-o", "out"],
        ["simulate", str(MODELS / "cart_pendulum.toml"), "gone.npz"],
    ]
    report = imported([*helps, *misuses], SLOW)
    assert [row for row in report if row[2]] == []
    assert [code for _, code, _ in report] == [0] * (1 + len(helps)) + [2] * len(misuses)


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["design", "identify", "list", "validate", "check"])
def test_a_verb_imports_what_it_needs_only(verb: str, tmp_path: Path) -> None:
    """Nothing that draws or fits, where nothing is drawn or fitted."""
    experiment = str(write_experiment(tmp_path, horizon="0.4", max_iterations="1"))
    log, out = str(tmp_path / "log.csv"), ["-o", str(tmp_path / "out")]
    done("simulate", experiment, "-o", log)
    words = {"list": [str(tmp_path / "cart_pendulum.xml")], "identify": [experiment, log, *out]}
    # On several processors, another process draws the pictures of a design.
    drawing = [] if cores() > 1 else ["matplotlib"]
    unused = {
        "design": {"scipy.optimize", "scipy.signal", "scipy.spatial", "scipy.stats", "pandas"}
        | {"mjfim.identification", "matplotlib"} - {*drawing},
        "identify": {"mjfim.excitation"},
        "check": {*UNUSED_WITHOUT_FOLDER},
    }.get(verb, {*UNUSED_WITHOUT_FOLDER, "mjfim.identification"})
    call = [verb, *words.get(verb, [experiment, *(out if verb == "design" else [])])]
    report = imported([call], tuple(unused))
    assert [row[1:] for row in report] == [(0, []), (0, [])]


def test_help_lists_every_verb_with_its_first_sentence() -> None:
    """Square brackets are markup of the help, which would leave out what stands in backticks."""
    result = run("--help")
    assert (result.exit_code, result.stderr) == (0, "")
    shown = " ".join(re.sub(r"[│╭╮╰╯─]", " ", result.stdout).split())
    assert set(verbs()) == set(ORDER)
    for name, command in verbs().items():
        paragraph = " ".join(command.help.split("\n\n")[0].split())
        assert f" {name} {paragraph}" in shown
        own = " ".join(run(name, "--help").stdout.split())
        assert "``" not in own, name
        for option in ("--json", "--verbose", "--threads"):
            is_shared = any(option in each.opts for each in command.params)
            assert (option in own.partition(" Also ")[2]) == is_shared, (name, option)
            assert f"{option}" in shown
