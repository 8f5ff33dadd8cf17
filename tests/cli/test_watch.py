"""`mjfim watch`: the table at the end, files, exit codes, faults of a stream, and its end."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.cli import PROCESS, done, loads, misused, names, read, write_experiment
from tests.support.paths import ROOT

HEADER = "t,ctrl:force,qpos:slide,qpos:hinge,qvel:slide,qvel:hinge"


@pytest.fixture(scope="module")
def lines() -> list[str]:
    """A header and the rows of a log of 4 s."""
    log = logs_of(cart_pendulum(), 1)[0]
    ctrl = np.concatenate([log.ctrl, log.ctrl[-1:]])
    rows = np.column_stack([log.t, ctrl, log.y]).tolist()
    return [HEADER, *(",".join(f"{value:.9g}" for value in row) for row in rows)]


def wanting(wanted: float) -> str:
    """The experiment with a wanted σ of the friction."""
    path = write_experiment(Path())
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("[parameters.c]", f"[parameters.c]\nwanted = {wanted}"))
    return str(path)


def watched(lines: list[str], options: str = "", *, code: int = 0) -> Result:
    """The result of `mjfim watch` with a file of these lines."""
    Path("log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return done(f"watch study.toml --stream log.csv {options}", code=code)


def test_the_stream_of_a_file(folder: Path, lines: list[str]) -> None:
    result = watched(lines, "-o new --json", code=1)
    found = loads(result.stdout)
    assert found == read(folder / "new" / "watch.json")
    assert found["rows"] == 401 and not found["enough"]
    assert found["parameters"] == ["m", "l", "c"]
    assert found["reached"][0] < 2.0 and found["reached"][2] is None
    assert {"watch.json", "watch.npz", "watch.png", "report.html"} <= names(folder / "new")
    assert "needs about" in result.stderr and "Enough" not in result.stderr


@pytest.mark.usefixtures("here")
def test_enough(lines: list[str]) -> None:
    wanting(0.5)
    result = watched(lines, "--verbose")
    assert result.stderr.count("Enough after") == 1
    assert "every parameter reaches the wanted σ" in result.stdout and "best case" in result.stdout


@pytest.mark.usefixtures("folder")
def test_faulty_rows_are_said_and_left_out(lines: list[str]) -> None:
    faulty = [*lines[:50], lines[50] + ",7", *lines[51:60], "0.1,0,0,0,0,0", *lines[61:]]
    result = watched(faulty, code=1)
    assert "line 51: 7 cells, but line 1 has 6; the row is left out" in result.stderr
    assert "line 61: time 0.1 s after 0.58 s; it must increase" in result.stderr
    assert "399 rows; faulty rows, left out: 2" in result.stdout


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([HEADER.replace("qpos:hinge", "qpos:hing")], "did you mean 'qpos:hinge'"),
        ([HEADER, "0,0,0,0,0,0"], "too few rows (1)"),
        ([""], "no line; the first one names the columns"),
    ],
)
def test_streams_that_cannot_be_used(content: list[str], said: str, folder: Path) -> None:
    misused(watched(content, "-o new", code=2), said)
    assert not (folder / "new").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "wanted", "code"), [(signal.SIGINT, 0.5, 0), (signal.SIGTERM, 1e-3, 1)]
)
def test_a_signal_ends_the_stream(
    number: signal.Signals, wanted: float, code: int, lines: list[str], here: Path
) -> None:
    """The verb prints the last table, and its exit code says whether all is enough."""
    words = [*PROCESS, "watch", wanting(wanted), "--json", "-o", "out"]
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
    assert (here / "out" / "watch.png").is_file()
