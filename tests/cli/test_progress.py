"""Progress on stderr: stages, the time that is left, and files that are written."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.progress import Progress

import mjfim
from mjfim.cli import common
from mjfim.cli.common import (
    VIDEO_WEIGHT,
    MessageConsole,
    ProgressDisplay,
    _TimeColumn,
    clock,
)
from mjfim.excitation.task import DesignTask
from mjfim.output.progress_text import design_stage, design_text
from mjfim.records.design import HistoryRow
from mjfim.records.events import DesignEvent, StudyEvent, begin_stage, stages_observed_by
from mjfim.studies.check import check_task
from tests.support.paths import MODELS


def an_iterate(**changes: float) -> DesignEvent:
    """An iterate of a design under limits."""
    numbers = {"cost": 2.0, "criterion": 1.0, "min_eigenvalue": 3.0, "slope": 0.1, "gamma": 1.0}
    numbers |= {"seconds": 1.0, "rate": 50.0, "mu": 0.01, **changes}
    return DesignEvent(start="initial", row=HistoryRow(iteration=7, steps=100, **numbers))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("seconds", "shown"), [(0.2, "0:00"), (59.6, "1:00"), (135.0, "2:15"), (3725.0, "1:02:05")]
)
def test_times_in_words(seconds: float, shown: str) -> None:
    assert clock(seconds) == shown


def test_the_stage_of_a_design_is_named() -> None:
    assert design_stage(an_iterate()) == "searching inside the limits at 50 Hz, barrier 0.01"
    assert design_stage(an_iterate(mu=np.inf)) == "steering into the limits at 50 Hz"
    assert design_stage(an_iterate(mu=0.0)) == "searching at 50 Hz"
    assert "inf" not in design_text(an_iterate(cost=np.inf, min_eigenvalue=0.0))


def test_the_time_that_is_left_is_shown() -> None:
    bar = Progress(disable=True)
    number = bar.add_task("a", total=None, part_began=0.0)
    task = bar.tasks[0]
    task.start_time, task.stop_time = 0.0, 30.0
    assert str(_TimeColumn(None).render(task)) == "0:30"
    assert str(_TimeColumn(120.0).render(task)) == "0:30 of at most 2:00"
    assert str(_TimeColumn(10.0).render(task)) == "0:30"
    bar.update(number, total=4, completed=1)
    assert str(_TimeColumn(None).render(task)).endswith("left")


def test_files_are_counted_by_the_work_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Data take no time, and the video of a report several times that of a picture."""
    monkeypatch.setattr(common, "_names", ["a.json", "b.png", "design.rrd", "report.html"])
    monkeypatch.setattr(common, "_written", [])
    bar = Progress(disable=True)
    display = ProgressDisplay(bar, "writing")
    total = 1.5 + VIDEO_WEIGHT
    for name, done in ((".mjfim.json", 0.0), ("report.html", 0.0), ("b.png", 1.0)):
        display.count_file(Path(name))
        (task,) = bar.tasks
        assert task.completed == done
    assert (task.description, task.total) == ("written: b.png", total)

    # A stage between two files keeps the bar.
    display.begin_stage("drawing", 0, 0)
    assert (task.description, task.total) == ("drawing", total)
    for name in ("design.rrd", "report.html"):
        display.count_file(Path(name))
    assert task.completed == task.total == total


def test_a_stage_without_parts_has_no_bar() -> None:
    """The number of parts of an earlier stage is forgotten."""
    bar = Progress(disable=True)
    display = ProgressDisplay(bar, "fitting")
    display.begin_stage("predicting", 1, 3)
    (task,) = bar.tasks
    assert (task.total, task.completed) == (3, 1)
    display.begin_stage("computing the intervals", 0, 0)
    assert task.total is None


def test_rounds_of_a_campaign_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bar is that of all rounds, and the time that is left follows from complete rounds."""
    now = 0.0
    monkeypatch.setattr(common.time, "monotonic", lambda: now)
    bar = Progress(disable=True)
    display = ProgressDisplay(bar, "designing")
    display.count_rounds(4)
    (task,) = bar.tasks
    display(an_iterate(mu=0.0))
    assert task.description.startswith("round 1 of at most 4\niteration   7")
    assert task.total is None

    now = 10.0
    ended = StudyEvent(
        study="campaign",
        part="round 1",
        index=0,
        count=4,
        share=1.0,
        result=SimpleNamespace(design="a design"),
    )
    display(ended)
    now = 15.0
    display.begin_stage("computing the intervals", 0, 0)
    assert task.description == "round 2 of at most 4\ncomputing the intervals"
    assert (task.completed, task.total) == (1.5, 4)
    task.start_time, task.stop_time = 0.0, 15.0
    assert str(_TimeColumn(None).render(task)) == "0:15, at most about 0:25 left"


def test_no_time_is_cut_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long descriptions are folded between words."""
    console = MessageConsole(file=io.StringIO(), force_terminal=True, width=60)
    monkeypatch.setattr(common, "errors", console)
    with common.progress("designing", at_most=4000.0) as display:
        display.describe("a description that is so long that it does not fit in one line")
    written = console.file.getvalue()  # type: ignore[attr-defined]
    assert "1:06:40" in written and "…" not in written


def test_a_report_is_named_only_where_it_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.html").write_text("of an earlier run")
    monkeypatch.setattr(common, "_written", [tmp_path / "design.json"])
    common.say_written(tmp_path)
    monkeypatch.setattr(common, "_written", [tmp_path / "report.html"])
    common.say_written(tmp_path)
    first, second = capsys.readouterr().err.replace("\n", " ").split("wrote ")[1:]
    assert "report.html" not in first and f"see {tmp_path / 'report.html'}" in second


def test_messages_are_broken_between_words_and_paths_stay_whole() -> None:
    path = "/folder/" + "long_name" * 12 + ".toml"
    stream = io.StringIO()
    console = MessageConsole(
        file=stream, force_terminal=True, width=40, soft_wrap=True, highlight=False
    )
    console.print(f"mjfim: {path}: this sentence is longer than a line", soft_wrap=True)
    lines = stream.getvalue().splitlines()
    assert any(line.strip() == f"{path}:" for line in lines)
    assert all(len(line) <= 40 for line in lines if path not in line)


def test_a_check_names_its_stages() -> None:
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    task = DesignTask.resolve(experiment.replace(horizon=0.2))
    begun: list[tuple[str, int, int]] = []
    with stages_observed_by(lambda *stage: begun.append(stage)):
        check_task(task)
    begin_stage("nobody observes this one")

    names = [name for name, _, _ in begun]
    assert names[0] == "simulating the motion and its sensitivities"
    assert ("testing the derivatives: slope", 2, 3) in begun
    assert not any("nobody" in name for name in names)
