"""Progress and messages on stderr."""

from __future__ import annotations

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from rich.progress import Progress

from mjfim.cli import progress as module
from mjfim.cli.progress import ProgressDisplay, clock, progress, say
from mjfim.excitation.task import DesignTask
from mjfim.output.live import design_stage, design_text
from mjfim.records.design import HistoryRow
from mjfim.records.events import DesignEvent, StudyEvent, begin_stage, stages_observed_by
from mjfim.studies.check import check_task
from tests.support.cart_pendulum import cart_pendulum


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


def test_parts_are_counted_where_their_number_is_known() -> None:
    bar = Progress(disable=True)
    display = ProgressDisplay(bar, "playing")
    (task,) = bar.tasks
    display(StudyEvent(study="monte_carlo", part="robots", index=1, count=4, share=0.5))
    assert (task.completed, task.total) == (1.5, 4)
    display.heading = "round 2 of at most 4"
    display.begin_stage("computing the intervals", 0, 3)
    assert task.description == "round 2 of at most 4\ncomputing the intervals (1/3)"
    assert task.total is None


def test_texts_are_broken_between_words_and_times_and_paths_stay_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a narrow terminal."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=60, highlight=False)
    monkeypatch.setattr(module, "errors", console)
    path = "/folder/" + "long_name" * 12 + ".toml"
    say(f"mjfim: {path}: this sentence is longer than a line, because it has so many words")
    lines = stream.getvalue().splitlines()
    assert any(path in line for line in lines)
    assert all(len(line) <= 60 for line in lines if path not in line)

    with progress("designing", at_most=4000.0) as display:
        display.show("a description that is so long that it does not fit in one line")
    assert "1:06:40" in stream.getvalue() and "…" not in stream.getvalue()


def test_without_a_terminal_a_line_comes_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = [0.0]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with progress("designing") as display:
        for now[0] in np.arange(0.0, 32.0, 0.5):
            display(an_iterate(cost=now[0]))
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" J ")[2].split()[0] for line in lines] == ["10", "20", "30"]
    assert lines[0].startswith("searching inside the limits at 50 Hz, barrier")


def test_a_check_names_its_stages() -> None:
    experiment = cart_pendulum()
    task = DesignTask.resolve(experiment.replace(horizon=0.2))
    begun: list[tuple[str, int, int]] = []
    with stages_observed_by(lambda *stage: begun.append(stage)):
        check_task(task)
    begin_stage("nobody observes this one")

    names = [name for name, _, _ in begun]
    assert names[0] == "simulating the motion and its sensitivities"
    assert ("testing the derivatives: slope", 1, 2) in begun
    assert not any("nobody" in name for name in names)
