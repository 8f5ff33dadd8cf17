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
from tests.support.cli import done, loads, names, read, run, write_experiment


@pytest.fixture(scope="module")
def checked(study: Path) -> Result:
    """Result of `mjfim check` without options."""
    before = names(study.parent)
    result = run("check", study)
    assert names(study.parent) == before
    return result


def test_a_table_and_a_conclusion_are_printed(study: Path, checked: Result) -> None:
    assert checked.exit_code == 0
    for word in ("of more than 5 % of their", "relative σ", "repetitions", "best case"):
        assert word in checked.stdout
    assert f"mjfim design {study}" in "".join(checked.stdout.split("\n"))
    assert "self-test" not in checked.stdout


LIMITED = """
import resource
import sys
resource.setrlimit(resource.RLIMIT_DATA, (4 * 2**30, int(sys.argv.pop())))
from mjfim.__main__ import main
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("hard", [4 * 2**30, -1])
def test_too_little_memory_for_the_engine_is_one_message(here: Path, hard: int) -> None:
    """The model compiles, but there is no memory for further copies of its state.

    A soft limit of the user is kept, also where the hard limit is infinite (-1).
    """
    pytest.importorskip("resource")
    write_experiment(here)
    model = here / "cart_pendulum.xml"
    text = model.read_text(encoding="utf-8")
    model.write_text(text.replace("<worldbody>", '<size memory="1700M"/><worldbody>', 1))
    # In a process of its own: threads of the tests do not start with too little memory.
    command = [sys.executable, "-c", LIMITED, "check", "study.toml", "--threads", "8", str(hard)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2 and "allocate memory" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_printed_json_equals_the_file(folder: Path) -> None:
    found = loads(done("check study.toml --json -o new").stdout)
    assert found == read(folder / "new" / "check.json")
    pictures = {"check.png", "rehearsal.png", "worth.png", "valley.png"}
    assert names(folder / "new") == {"check.json", "check.npz", "report.html", MANIFEST, *pictures}
    assert imread(folder / "new" / "check.png").shape[0] > 300
    assert found["ok"] is True
    assert [row["name"] for row in found["parameters"]] == ["m", "l", "c"]
    assert np.shape(found["correlation"]) == (3, 3)
    assert found["self_test"]["passed"] is True


def test_combinations_of_parameters_are_named_and_the_exit_code_is_1(here: Path) -> None:
    """Of the mass of the cart and the armature of its joint, any motion shows the sum alone."""
    more = '1\n[parameters.M]\ntarget = "body/cart:mass"\n[parameters.a]\nguess = 0.1\n'
    write_experiment(here, max_iterations=f'{more}target = "joint/slide:armature"')
    said = done("check study.toml --verbose", code=1).stdout
    for word in ("M + a", "time", "σ without it", "derivative self-test passed"):
        assert word in said


@pytest.mark.parametrize(
    ("given", "source"), [("--design out/design.npz", "the given trajectory"), ("run.csv", "1 rec")]
)
def test_designs_and_recordings_are_checked(given: str, source: str, folder: Path) -> None:
    sigma = read(folder / "out" / "design.json")["final"]["std"]
    found = loads(run(f"check study.toml {given} --json").stdout)
    assert found["source"].startswith(source)
    assert_allclose([row["std"] for row in found["parameters"]], sigma, rtol=1e-4)


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
