"""File names with brackets, streams that are not UTF-8, and those that are full or closed."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mjfim.cli import main as cli
from mjfim.cli.progress import errors, lose_what_cannot_be_written, out
from mjfim.output.page import Row, Table
from mjfim.output.terminal import laid_out
from tests.support.cli import MODELS, PROCESS, done, names, read, write_experiment
from tests.support.pages import page_with
from tests.support.paths import ROOT

# Name that a terminal library would take for markup, a closing tag without a begin, and an emoji.
NAME = "run [bold]1[/] [/red] :smile:"


def test_brackets_in_the_path_of_results(folder: Path) -> None:
    """The last line of a verb shows the path of the file that was written."""
    target = Path(NAME) / "run.csv"
    assert done("simulate study.toml out -o", target).stderr.strip() == f"wrote {target}"
    assert (folder / target).is_file()


def test_brackets_in_tables(capsys: pytest.CaptureFixture[str]) -> None:
    """Titles, headings, cells and notes of a table show brackets as they are."""
    shown = ("title [/a]", "heading [b]", NAME, "note [/c]")
    title, heading, cell, note = shown
    table = Table(title=title, columns=(heading,), rows=(Row((cell,)),), note=note)
    out.print(laid_out(page_with(table), out))
    printed = capsys.readouterr().out
    assert [text for text in shown if text not in printed] == []


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "latin-1"])
def test_streams_that_are_not_utf8(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A character that the encoding does not have is printed as a question mark."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stderr", stream)
    lose_what_cannot_be_written()
    errors.print("σ of [/é]: λ_min", highlight=False)
    stream.flush()
    printed = stream.buffer.getvalue().decode(encoding)
    assert printed == ("? of [/?]: ?_min\n" if encoding == "ascii" else "? of [/é]: ?_min\n")


def ended(command: list[object], folder: Path, **settings: str) -> subprocess.CompletedProcess[str]:
    """A process that ran in a folder, and that reported no fault of the program."""
    process = subprocess.run(
        command,
        capture_output=True,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONPATH": str(ROOT), **settings},
        cwd=folder,
        check=False,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    assert "Traceback" not in process.stdout + process.stderr
    return process


@pytest.mark.slow
def test_a_process_that_is_not_utf8(tmp_path: Path) -> None:
    """Results are printed, and the files are UTF-8."""
    experiment = write_experiment(tmp_path, horizon="0.4")
    text = experiment.read_text(encoding="utf-8")
    experiment.write_text(text.replace("[parameters.m]", '[parameters."µ"]'), encoding="utf-8")

    settings = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    ended([*PROCESS, "check", experiment, "-o", "out"], tmp_path, **settings)
    assert "µ" in str(read(tmp_path / "out" / "check.json"))


@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize(("name", "other"), [("stdout", "stderr"), ("stderr", "stdout")])
def test_a_full_stream_costs_its_text_alone(
    name: str, other: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = io.StringIO()
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, name, full)
        monkeypatch.setattr(sys, other, kept)
        lose_what_cannot_be_written()
        with pytest.raises(SystemExit) as end:
            cli.app(["check", "study.toml", "-o", "new"])
        monkeypatch.undo()
    assert end.value.code == 0
    assert {"check.json", "check.npz", "report.html"} <= names(folder / "new")
    told = kept.getvalue()
    assert ("mjfim: stdout: No space left on device" in told) is (name == "stdout")
    assert ("does not determine c" in told) is (name == "stderr")


@pytest.mark.slow
@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-", "| true"])
def test_streams_that_are_closed_or_full(streams: str, tmp_path: Path) -> None:
    """The exit code is that of the result, its file is there, and stdout is named."""
    call = f'"$@" {streams} ; exit "${{PIPESTATUS[0]}}"'
    words = [*PROCESS, "init", MODELS / "cart_pendulum.xml", "-o", "mine.toml"]
    said = ended(["bash", "-c", call, "bash", *words], tmp_path).stderr
    assert (tmp_path / "mine.toml").is_file()
    assert ("mjfim: stdout: " in said) is ("2>&-" not in streams)
