"""Progress on stderr: stages, the time that is left, and files that are written."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

import mjfim
from mjfim.cli import common
from mjfim.cli.common import Duration, MessageConsole, ProgressDisplay, _TimeColumn, clock
from mjfim.excitation.task import DesignTask
from mjfim.output.progress_text import design_stage, design_text
from mjfim.records.design import HistoryRow
from mjfim.records.events import DesignEvent
from mjfim.records.progress import begin_stage, stages_observed_by
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
    most = Duration(seconds=120.0, word="at most")
    assert str(_TimeColumn(most).render(task)) == "0:30 of at most 2:00"
    assert str(_TimeColumn(Duration(seconds=10.0)).render(task)) == "0:30"
    bar.update(number, total=4, completed=1)
    assert str(_TimeColumn(None).render(task)).endswith("left")


def test_files_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "_names", ["a.json", "b.png"])
    monkeypatch.setattr(common, "_written", [])
    bar = Progress(disable=True)
    display = ProgressDisplay(bar, "writing")
    for name in (".mjfim.json", "a.json"):
        display.count_file(Path(name))
    (task,) = bar.tasks
    assert (task.description, task.completed, task.total) == ("written: a.json", 1, 2)


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
