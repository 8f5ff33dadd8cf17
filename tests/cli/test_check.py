"""`mjfim check` from the command line: the table, the files, exit codes."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from multiprocessing import synchronize
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.testing import assert_allclose
from typer.testing import Result

from mjfim.output.manifest import MANIFEST
from mjfim.parallel import pool
from tests.support.cli import done, loads, misused, names, read, run, write_experiment


@pytest.fixture(scope="module")
def checked(study: Path) -> Result:
    """Result of `mjfim check` without options."""
    before = names(study.parent)
    result = run("check", study)
    assert names(study.parent) == before
    return result


def test_a_table_and_a_conclusion_are_printed(study: Path, checked: Result) -> None:
    result = checked
    assert result.exit_code == 0
    for word in ("of more than 5 % of their", "relative σ", "repetitions", "best case"):
        assert word in result.stdout
    assert f"mjfim design {study}" in "".join(result.stdout.split("\n"))
    assert "self-test" not in result.stdout


LIMITED = """
import resource
import sys
resource.setrlimit(resource.RLIMIT_DATA, (4 * 2**30, int(sys.argv.pop())))
from mjfim.__main__ import main
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("hard", [4 * 2**30, -1])
def test_too_little_memory_for_the_engine_is_one_message(tmp_path: Path, hard: int) -> None:
    """The model compiles, but there is no memory for further copies of its state.

    A soft limit of the user is kept, also where the hard limit is infinite (-1).
    """
    pytest.importorskip("resource")
    # A model of its own: the one of `study` is shared by all tests.
    study = write_experiment(tmp_path)
    model = study.parent / "cart_pendulum.xml"
    text = model.read_text(encoding="utf-8")
    model.write_text(text.replace("<worldbody>", '<size memory="1700M"/><worldbody>', 1))
    # In a process of its own: threads of the tests do not start with too little memory.
    command = [sys.executable, "-c", LIMITED, "check", str(study), "--threads", "8", str(hard)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2 and "allocate memory" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_printed_json_equals_the_file(study: Path, tmp_path: Path) -> None:
    result = run("check", study, "--json", "-o", tmp_path / "out")
    found = loads(result.stdout)
    assert found == read(tmp_path / "out" / "check.json")
    assert names(tmp_path / "out") == {
        "check.json",
        "check.npz",
        "check.png",
        "report.html",
        "rehearsal.png",
        "worth.png",
        "valley.png",
        MANIFEST,
    }
    assert imread(tmp_path / "out" / "check.png").shape[0] > 300
    assert found["ok"] is True
    assert [row["name"] for row in found["parameters"]] == ["m", "l", "c"]
    assert np.shape(found["correlation"]) == (3, 3)
    assert found["self_test"]["passed"] is True


def test_combinations_of_parameters_are_named_and_the_exit_code_is_1(
    study: Path, tmp_path: Path
) -> None:
    """Of the mass of the cart and the armature of its joint, any motion shows the sum alone."""
    text = study.read_text(encoding="utf-8")
    text = text.replace('"cart_pendulum.', f'"{study.parent}/cart_pendulum.')
    text += '[parameters.M]\ntarget = "body/cart:mass"\n'
    text += '[parameters.a]\ntarget = "joint/slide:armature"\nguess = 0.1\n'
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")

    result = done("check", path, "--verbose", code=1)
    for word in ("M + a", "time", "σ without it", "derivative self-test passed"):
        assert word in result.stdout


def test_designs_and_recordings_are_checked(study: Path, archived: Path, recorded: Path) -> None:
    sigma = read(archived.parent / "design.json")["final"]["std"]

    design = loads(run("check", study, "--design", archived, "--json").stdout)
    assert design["source"] == "the given trajectory"
    assert_allclose([row["std"] for row in design["parameters"]], sigma, rtol=1e-4)

    recording = loads(run("check", study, recorded, "--json").stdout)
    assert recording["source"] == "1 recording"
    assert_allclose([row["std"] for row in recording["parameters"]], sigma, rtol=1e-4)


def test_without_locks_between_processes_one_process_does_the_work(
    study: Path, checked: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in a container whose /dev/shm is missing or read-only."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(synchronize.SemLock, "__init__", refuse)
    monkeypatch.setattr(pool, "cores", lambda: 2)
    result = run("check", study, "--executor", "local:2")
    assert (result.exit_code, result.stdout) == (0, checked.stdout)
    assert "Read-only file system); one does all the work" in result.stderr


def test_a_wrong_horizon_is_refused_with_its_file(tmp_path: Path) -> None:
    """The initial control is made before the check, and its faults name the file as well."""
    wrong = write_experiment(tmp_path, horizon="1.005", start='{ kind = "sine" }')
    misused(run("check", wrong), f"{wrong}: horizon: 1.005 s is not a whole number")
