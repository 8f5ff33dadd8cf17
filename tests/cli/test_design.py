"""`mjfim design`: its files and exit codes, and experiments and folders that it refuses."""

from __future__ import annotations

import os
import re
from pathlib import Path
from unittest.mock import patch

import pytest
from typer.testing import Result

from mjfim.cli import common
from mjfim.cli import design as design_verb
from mjfim.output.manifest import MANIFEST
from mjfim.output.plots import draw
from tests.support.cli import (
    DESIGN,
    done,
    loads,
    misused,
    names,
    read,
    run,
    write_experiment,
)


def test_design_leaves_its_files(home: Path, designed: Result) -> None:
    """The folder holds all promised files and nothing else."""
    assert designed.exit_code == 0
    assert names(home / "out") == DESIGN | {MANIFEST}
    assert all(path.stat().st_size > 0 for path in (home / "out").iterdir())
    data = read(home / "out" / "design.json")
    assert (data["status"], data["limits"]["satisfied"]) == ("converged", True)
    assert data["final"]["eigenvalues"][0] > 10 * data["initial"]["eigenvalues"][0]


def test_design_json_is_the_file(home: Path, designed: Result) -> None:
    """Standard output holds the summary alone, which names the experiment and its model."""
    data = read(home / "out" / "design.json")
    assert loads(designed.stdout) == data
    assert (home / "out" / data["experiment"]).resolve() == home / "study.toml"
    assert (home / "out" / data["model"]).resolve() == home / "cart_pendulum.xml"
    assert "wrote" in designed.stderr


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
def test_design_that_misses_its_goal(
    tmp_path: Path, lines: str, status: str, satisfied: bool
) -> None:
    """The exit code is 1, and the summary says why."""
    path = write_experiment(tmp_path, max_iterations=lines)
    data = loads(done("design", path, "-o", tmp_path / "out", "--json", code=1).stdout)
    assert (data["status"], data["limits"]["satisfied"]) == (status, satisfied)
    assert bool(data["warnings"]) is not satisfied


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize("most", ["1", "3"])
def test_design_that_stops_at_its_budget(tmp_path: Path, most: str) -> None:
    """The exit code is 0 and the outcome names the budget: the trajectory is better than before."""
    path = write_experiment(tmp_path, tolerance="1e-12", max_iterations=most)
    result = done("design", path, "-o", tmp_path / "out", "--verbose")
    said = " ".join(result.stdout.split())
    assert "This motion can be played" in said and "Stopped at its budget" in said

    # How much a longer search may gain is said, too.
    assert re.search(r"still improving by [\d.]+ % per iteration", said)


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize("stated", [False, True])
def test_design_that_states_no_time_ends_at_the_default_time_and_says_so(
    stated: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert design_verb.DEFAULT_SECONDS == 120.0
    monkeypatch.setattr(design_verb, "DEFAULT_SECONDS", 1e-3)
    most = "100000\nseconds = 1e-3" if stated else "100000"
    path = write_experiment(tmp_path, tolerance="1e-12", max_iterations=most)
    result = run("design", path, "-o", tmp_path / "out")
    said = " ".join(result.stderr.split())
    sentence = "the design ended after 0.001 s, the default time; `seconds` in the table [descent]"
    assert (sentence in said) is not stated


@pytest.mark.usefixtures("no_files")
def test_a_force_that_is_clamped_breaks_its_limit(tmp_path: Path) -> None:
    """A trajectory that needs the clamp of a motor has to be looked at."""
    path = write_experiment(tmp_path, max_iterations="1")

    # The motor is clamped, because limits are only checked here.
    model = tmp_path / "cart_pendulum.xml"
    text, old = model.read_text(encoding="utf-8"), '<motor name="force" joint="slide"/>'
    assert old in text
    weak = old.replace("/>", ' forcelimited="true" forcerange="-0.2 0.2"/>')
    model.write_text(text.replace(old, weak), encoding="utf-8")
    with path.open("a", encoding="utf-8") as experiment:
        experiment.write("\n[limits]\nenforce = false\n")

    result = run("design", path, "-o", tmp_path / "out", "--json")
    assert (result.exit_code, loads(result.stdout)["status"]) == (1, "converged")


@pytest.mark.slow
@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(("prior", "code"), [("", 1), ("prior = 0.1\n", 0)])
def test_parameters_that_do_the_same_give_the_code_of_check(
    tmp_path: Path, prior: str, code: int
) -> None:
    """The mass of the cart and the armature of its slide add up; a prior separates them."""
    path = write_experiment(tmp_path, max_iterations="1")
    with path.open("a", encoding="utf-8") as experiment:
        experiment.write(
            '\n[parameters.cart]\ntarget = "body/cart:mass"\n\n[parameters.rotor]\n'
            f'target = "joint/slide:armature"\nguess = 0.5\n{prior}'
        )

    designed = run("design", path, "-o", tmp_path / "out")
    assert (designed.exit_code, run("check", path).exit_code) == (code, code)
    assert ("no control separates these parameters: cart" in designed.stderr) is bool(code)


@pytest.mark.parametrize(
    ("lines", "fragments"),
    [
        ({"horizon": "1.0\nhorizn = 2"}, ["study.toml", "horizn", "unknown key", "horizon"]),
        ({"rate": ""}, ["study.toml", "not valid TOML"]),
        ({"start": '"gone.csv"'}, ["gone.csv", "no such file"]),
        ({"tracking": "{ slid = 1 }"}, ["study.toml", "cost.tracking", "hinge, slide"]),
    ],
)
def test_bad_experiment(lines: dict[str, str], fragments: list[str], tmp_path: Path) -> None:
    """Exit code 2, one message, and nothing is written."""
    path = write_experiment(tmp_path, **lines)
    misused(run("design", path, "-o", tmp_path / "a" / "b"), *fragments)
    assert names(tmp_path) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


def test_unwritable_folder(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The message comes before the work. Root may write everywhere: the answer is made up."""
    asked = []

    def deny(path: Path, mode: int) -> bool:
        if mode == os.W_OK:
            asked.append(Path(path))
        return mode != os.W_OK

    monkeypatch.setattr(os, "access", deny)
    misused(
        run("design", study, "-o", tmp_path / "new" / "out"),
        f"{tmp_path}: no permission to write here",
    )
    assert asked == [tmp_path]
    assert names(tmp_path) == set()


def test_disk_full(study: Path, tmp_path: Path) -> None:
    """One message with the words of the operating system."""
    full = OSError(28, "No space left on device", "design.npz")
    with patch("numpy.savez_compressed", side_effect=full):
        result = run("design", study, "-o", tmp_path / "out")
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code in (1, 2)
    assert re.search(r"^mjfim: .*design\.npz.*No space left on device", result.stderr, re.MULTILINE)


def test_parameter_that_does_nothing(tmp_path: Path) -> None:
    """The message names this parameter alone."""
    path = write_experiment(tmp_path)
    more = '[parameters.paint]\ntarget = "geom/cart:size[0]"\n'
    path.write_text(path.read_text(encoding="utf-8") + more, encoding="utf-8")
    misused(
        run("design", path, "-o", tmp_path / "out"),
        "parameters.paint changes nothing in the measured outputs",
    )


def test_start_that_diverges(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One message of mjfim, none of MuJoCo, and no log file."""
    monkeypatch.chdir(tmp_path)
    path = write_experiment(tmp_path, start='{ kind = "sine", amplitude = 1e12 }')
    misused(run("design", path, "-o", tmp_path / "out"), "diverges under this control")
    assert capfd.readouterr() == ("", "")
    assert names(tmp_path) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


@pytest.mark.parametrize(
    ("verb", "place", "said"),
    [
        ("design", "local:0", "not a number"),
        ("design", "dask:no.json", "no such file"),
        *((verb, "cluster", "state local, local:N") for verb in ("design", "check", "compare")),
        *(
            (verb, "cluster", "state local, local:N")
            for verb in ("campaign", "montecarlo", "identify")
        ),
    ],
)
def test_an_executor_that_cannot_be_had_is_misuse(
    verb: str, place: str, said: str, study: Path, tmp_path: Path
) -> None:
    """All verbs with much work state where it is done."""
    # A file whose existence is checked before the options.
    names_of_files = {"montecarlo": ["design.npz"], "identify": ["log.csv"]}.get(verb, [])
    files = [tmp_path / name for name in names_of_files]
    for file in files:
        file.touch()
    misused(run(verb, study, *files, "-o", tmp_path / "out", "--executor", place), said)
    assert not (tmp_path / "out").exists()


def test_the_answer_is_printed_before_pictures_are_drawn(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is printed when all other files are written."""
    printed: list[set[str]] = []
    drawn: list[str] = []

    def print_result(*_: object, **__: object) -> None:
        assert not drawn
        printed.append(names(tmp_path / "out"))

    monkeypatch.setattr(common, "print_result", print_result)
    monkeypatch.setattr(draw, "save", lambda _, path: drawn.append(path.name))
    run("design", study, "-o", tmp_path / "out")
    (written,) = printed
    assert {"design.json", "design.csv", "design.rrd", "report.html"} <= written
    assert {"accuracy.png", "trajectories.png"} <= set(drawn)
