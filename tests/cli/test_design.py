"""`mjfim design`: its files and exit codes, and folders that it refuses."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from typer.testing import Result

from mjfim.cli import common
from mjfim.cli import design as design_verb
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots import draw
from tests.support.cli import DESIGN, done, loads, misused, names, read, run, write_experiment


def test_design_leaves_its_files_and_prints_its_summary(home: Path, designed: Result) -> None:
    """The folder holds all promised files and nothing else, and names the experiment."""
    assert designed.exit_code == 0 and "wrote" in designed.stderr
    out = home / "out"
    assert names(out) == DESIGN | {MANIFEST}
    assert all(path.stat().st_size > 0 for path in out.iterdir())
    data = read(out / "design.json")
    assert loads(designed.stdout) == data
    assert (data["status"], data["limits"]["satisfied"]) == ("converged", True)
    assert data["final"]["eigenvalues"][0] > 10 * data["initial"]["eigenvalues"][0]
    assert (out / data["experiment"]).resolve() == home / "study.toml"
    assert (out / data["model"]).resolve() == home / "cart_pendulum.xml"


LIMITED = "\n[limits]\nvelocity = { slide = 1e-3 }\nenforce = false"


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(
    ("lines", "status", "satisfied"),
    [
        (f"1{LIMITED}", "max_iterations", False),
        ("0", "max_iterations", True),
        (f"40{LIMITED}", "converged", False),
    ],
    ids=["budget-and-limits-violated", "no-improvement", "limits-violated"],
)
def test_design_that_misses_its_goal(lines: str, status: str, satisfied: bool, here: Path) -> None:
    """The exit code is 1, and the summary says why."""
    write_experiment(here, max_iterations=lines)
    data = loads(done("design study.toml -o out --json", code=1).stdout)
    assert (data["status"], data["limits"]["satisfied"]) == (status, satisfied)
    assert bool(data["warnings"]) is not satisfied


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(("most", "seconds"), [("1", ""), ("3", "\nseconds = 1e-3")])
def test_design_that_ends_at_its_budget_or_at_the_default_time_says_so(
    most: str, seconds: str, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The exit code is 0, and the outcome says how much a longer search may gain."""
    write_experiment(here, tolerance="1e-12", max_iterations=most)
    said = " ".join(done("design study.toml -o out --verbose").stdout.split())
    assert "This motion can be played" in said and "Stopped at its budget" in said
    assert re.search(r"still improving by [\d.]+ % per iteration", said)

    assert design_verb.DEFAULT_SECONDS == 120.0
    monkeypatch.setattr(design_verb, "DEFAULT_SECONDS", 1e-3)
    write_experiment(here, tolerance="1e-12", max_iterations=f"100000{seconds}")
    said = " ".join(run("design study.toml -o new").stderr.split())
    sentence = "the design ended after 0.001 s, the default time; `seconds` in the table [descent]"
    assert (sentence in said) is not bool(seconds)


@pytest.mark.usefixtures("no_files")
def test_a_force_that_is_clamped_breaks_its_limit(here: Path) -> None:
    """A trajectory that needs the clamp of a motor has to be looked at."""
    write_experiment(here, max_iterations="1\n[limits]\nenforce = false")

    # The motor is clamped, because limits are only checked here.
    model = here / "cart_pendulum.xml"
    text, old = model.read_text(encoding="utf-8"), '<motor name="force" joint="slide"/>'
    assert old in text
    weak = old.replace("/>", ' forcelimited="true" forcerange="-0.2 0.2"/>')
    model.write_text(text.replace(old, weak), encoding="utf-8")
    data = loads(done("design study.toml -o out --json", code=1).stdout)
    assert data["status"] == "converged"


@pytest.mark.slow
@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(("prior", "code"), [("", 1), ("prior = 0.1", 0)])
def test_parameters_that_do_the_same_give_the_code_of_check(
    prior: str, code: int, here: Path
) -> None:
    """The mass of the cart and the armature of its slide add up; a prior separates them."""
    more = '1\n[parameters.cart]\ntarget = "body/cart:mass"\n[parameters.rotor]\n'
    more += f'target = "joint/slide:armature"\nguess = 0.5\n{prior}'
    write_experiment(here, max_iterations=more)
    said = done("design study.toml -o out", code=code).stderr
    assert ("no control separates these parameters: cart" in said) is bool(code)
    done("check study.toml", code=code)


def test_unwritable_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message comes before the work. Root may write everywhere: the answer is made up."""
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK or path.name != "empty")
    misused(run("design study.toml -o empty/new/out"), "empty: no permission to write here")
    assert names(folder / "empty") == set()


def test_disk_full(folder: Path) -> None:
    """One message with the words of the operating system."""
    full = OSError(28, "No space left on device", "design.npz")
    with patch("numpy.savez_compressed", side_effect=full):
        result = run("design study.toml -o new")
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code in (1, 2)
    assert re.search(r"^mjfim: .*design\.npz.*No space left on device", result.stderr, re.MULTILINE)


def test_the_answer_is_printed_before_pictures_are_drawn(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is printed when all other files are written."""
    told: list[Any] = []
    monkeypatch.setattr(common, "print_result", lambda *_, **__: told.append(names(folder / "new")))
    monkeypatch.setattr(draw, "save", lambda _, path: told.append(path.name))
    done("design study.toml -o new")
    written, *drawn = told
    assert {"design.json", "design.csv", "design.rrd", "report.html"} <= written
    assert {"accuracy.png", "trajectories.png"} <= set(drawn)
