"""`mjfim watch`: the table at the end, files, exit codes, faults of a stream, and its end."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.cli import PROCESS, done, loads, misused, names, read, run, write_experiment
from tests.support.paths import ROOT

HEADER = "t,ctrl:force,qpos:slide,qpos:hinge,qvel:slide,qvel:hinge"


@pytest.fixture(scope="module")
def lines() -> list[str]:
    """A header and the rows of a log of 4 s."""
    log = logs_of(cart_pendulum(), 1)[0]
    ctrl = np.concatenate([log.ctrl, log.ctrl[-1:]])
    rows = np.column_stack([log.t, ctrl, log.y]).tolist()
    return [HEADER, *(",".join(f"{value:.9g}" for value in row) for row in rows)]


def written(folder: Path, lines: list[str]) -> Path:
    """A file with these lines."""
    path = folder / "log.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def wanting(folder: Path, wanted: float) -> Path:
    """The experiment with a wanted σ of the friction."""
    path = write_experiment(folder)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[parameters.c]", f"[parameters.c]\nwanted = {wanted}"))
    return path


def test_the_stream_of_a_file(study: Path, lines: list[str], tmp_path: Path) -> None:
    log = written(tmp_path, lines)
    result = done("watch", study, "--stream", log, "-o", tmp_path / "out", "--json", code=1)
    found = loads(result.stdout)
    assert found == read(tmp_path / "out" / "watch.json")
    assert found["rows"] == 401 and not found["enough"]
    assert found["parameters"] == ["m", "l", "c"]
    assert found["reached"][0] < 2.0 and found["reached"][2] is None
    assert {"watch.json", "watch.npz", "watch.png", "report.html"} <= names(tmp_path / "out")
    assert "needs about" in result.stderr and "Enough" not in result.stderr


def test_enough(lines: list[str], tmp_path: Path) -> None:
    study = wanting(tmp_path, 0.5)
    result = done("watch", study, "--stream", written(tmp_path, lines), "--verbose")
    assert result.stderr.count("Enough after") == 1
    assert "every parameter reaches the wanted σ" in result.stdout and "best case" in result.stdout


def test_faulty_rows_are_said_and_left_out(study: Path, lines: list[str], tmp_path: Path) -> None:
    faulty = [*lines[:50], lines[50] + ",7", *lines[51:60], "0.1,0,0,0,0,0", *lines[61:]]
    result = done("watch", study, "--stream", written(tmp_path, faulty), code=1)
    assert "line 51: 7 cells, but line 1 has 6; the row is left out" in result.stderr
    assert "line 61: time 0.1 s after 0.58 s; it must increase" in result.stderr
    assert "399 rows; faulty rows, left out: 2" in result.stdout


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([HEADER.replace("qpos:hinge", "qpos:hing")], "did you mean 'qpos:hinge'"),
        ([HEADER, "0,0,0,0,0,0"], "too few rows (1)"),
    ],
)
def test_streams_that_cannot_be_used(
    content: list[str], said: str, study: Path, tmp_path: Path
) -> None:
    log, out = written(tmp_path, content), tmp_path / "out"
    misused(run("watch", study, "--stream", log, "-o", out), said)
    assert not out.exists()


def test_no_stream(study: Path, tmp_path: Path) -> None:
    misused(run("watch", study, "--stream", tmp_path / "none.csv"), "none.csv: no such file")
    empty = tmp_path / "empty.csv"
    empty.touch()
    misused(run("watch", study, "--stream", empty), "no line; the first one names the columns")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("wanted", "code"), [(0.5, 0), (1e-3, 1)])
def test_a_signal_ends_the_stream(
    number: signal.Signals, wanted: float, code: int, lines: list[str], tmp_path: Path
) -> None:
    """The verb prints the last table, and its exit code says whether all is enough."""
    words = [*PROCESS, "watch", str(wanting(tmp_path, wanted)), "--json", "-o", tmp_path / "out"]
    with subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    ) as verb:
        assert verb.stdin is not None and verb.stderr is not None and verb.stdout is not None
        # A faulty line behind the rows is answered when they have been read.
        verb.stdin.write("\n".join([*lines, "end"]) + "\n")
        verb.stdin.flush()
        assert any("line 403" in line for line in iter(verb.stderr.readline, ""))
        verb.send_signal(number)
        found, rest = verb.stdout.read(), verb.stderr.read()
        assert verb.wait() == code, rest
    assert loads(found)["rows"] == 401 and loads(found)["enough"] is not bool(code)
    assert (tmp_path / "out" / "watch.png").is_file()
