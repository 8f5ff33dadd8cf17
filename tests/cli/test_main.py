"""Behaviour that all verbs share: help, version, reports, exit code 2 for misuse."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import mjfim
from tests.support.cli import (
    PROCESS,
    done,
    misused,
    names,
    run,
    write_experiment,
)


def test_missing_inputs(study: Path, archived: Path, tmp_path: Path) -> None:
    """Files that do not exist or are of another kind are named."""
    gone, out, log = tmp_path / "gone", tmp_path / "out", tmp_path / "out" / "x.rrd"
    notes = tmp_path / "notes.txt"
    notes.touch()
    for words, said in (
        (("design", f"{gone}.toml", "-o", out), "gone.toml: no such file"),
        (("simulate", study, f"{gone}.npz", "-o", out / "r.csv"), "gone.npz: no such file"),
        (("montecarlo", study, f"{gone}.npz", "-o", out), "gone.npz: no such file"),
        (("identify", study, f"{gone}.csv", "-o", out), "gone.csv: no such file"),
        (("check", study, f"{gone}.csv"), "gone.csv"),
        (("check", study, "--design", f"{gone}.npz"), "gone.npz"),
        (("replay", gone, "--save", log), "no such file or folder"),
        (("replay", notes, "--save", log), "folder of results, an .rrd file or a design"),
        (("replay", notes, "--save", out / "x.txt"), "ends in .rrd"),
        (("replay", f"{gone}.rrd", "--save", log), "gone.rrd: no such file"),
        (("replay", tmp_path, "--save", log), "no design.rrd or estimate.rrd"),
    ):
        misused(run(*words), said)
    assert names(tmp_path) == {"notes.txt"}


@pytest.mark.parametrize(
    ("files", "proposed"),
    [
        (("arm.xml",), "mjfim init arm.xml -o arm.toml"),
        (("my arm.urdf", "pyproject.toml"), "mjfim init 'my arm.urdf' -o 'my arm.toml'"),
        (("arm.xml", "arm.toml"), "mjfim check arm.toml"),
        (("arm.xml", "leg.xml"), ""),
        ((), ""),
    ],
)
def test_without_a_verb_the_first_command_is_proposed(
    files: tuple[str, ...], proposed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the folder holds one experiment, or else one model."""
    for name in files:
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    result = run()
    assert result.exit_code == 2 and "Usage: " in result.stdout
    assert " ".join(result.stderr.split()) == (
        f"mjfim: in this folder: {proposed}" if proposed else ""
    )


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("design study.toml", "--help"),
        ("design study.toml -o x --starts 0", "--help"),
        ("simulate study.toml design.npz -o x --seed -1", "--help"),
        ("montecarlo study.toml design.npz -o x --trials 1", "--help"),
        ("identify study.toml -o x", "--help"),
        ("dessign study.toml -o x", "--help"),
        ("check study.toml --threads 1000000", "less than or equal to"),
        ("design study.toml -o x --starts 1000000000", "less than or equal to"),
        ("rehearse made -o x --robots 1000000000", "less than or equal to"),
    ],
)
def test_wrong_options(
    words: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exit code 2 and a message that names --help, or the bound of an amount."""
    monkeypatch.chdir(tmp_path)
    result = done(*words.split(), code=2)
    assert said in " ".join(result.stderr.replace("│", " ").split())
    assert "Traceback" not in result.stderr
    assert names(tmp_path) == set()


def test_output_is_a_file(study: Path, archived: Path, recorded: Path, tmp_path: Path) -> None:
    """The message comes before the work, and the file is not changed."""
    taken = tmp_path / "taken"
    taken.write_text("mine", encoding="utf-8")
    for verb, *inputs in (
        ("design", study),
        ("identify", study, recorded),
        ("montecarlo", study, archived, "--trials", 2),
    ):
        for place in (taken, taken / "below"):
            misused(run(verb, *inputs, "-o", place), "taken: is a file; -o needs a folder")
    assert taken.read_text(encoding="utf-8") == "mine"


def test_design_of_another_model(archived: Path, tmp_path: Path) -> None:
    """The verbs simulate and montecarlo refuse a design of another model."""
    path = write_experiment(tmp_path)
    xml = (tmp_path / "cart_pendulum.xml").read_text(encoding="utf-8")
    more = '<body name="rider"><joint name="ride"/><geom size=".1" mass="1"/></body></worldbody>'
    key = 'qpos="0 3.141592653589793 0"'
    xml = xml.replace("</worldbody>", more).replace('qpos="0 3.141592653589793"', key)
    (tmp_path / "cart_pendulum.xml").write_text(xml, encoding="utf-8")
    said = ("design.npz: made for (nq, nv, na, nu) = (2, 2, 0, 1)", "(3, 3, 0, 1)")
    misused(run("simulate", path, archived, "-o", tmp_path / "out" / "r.csv"), *said)
    misused(run("montecarlo", path, archived, "-o", tmp_path / "out"), *said)
    assert "out" not in names(tmp_path)


def test_misuse_as_a_process(tmp_path: Path) -> None:
    """A process ends with one message and exit code 2; warnings are errors there."""
    path = write_experiment(tmp_path, rate="33.0")
    words = [*PROCESS, "design", path, "-o", tmp_path / "out"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"mjfim: {path}: rate: at 33 Hz, a sample is not")
    assert len(done.stderr.splitlines()) == 1
    assert "out" not in names(tmp_path)


def test_version() -> None:
    """The version is that of the package."""
    result = run("--version")
    assert (result.exit_code, result.stdout) == (0, f"{mjfim.__version__}\n")
